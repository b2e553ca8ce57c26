# SPDX-License-Identifier: MIT
"""Growth: free expansion without stress, clamped bars, a bending strip, work, and what is refused."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.parameters import BadParameter
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, scene

STATIC = {"scheme": "quasi_static", "linearizations": 20}
PLANES = [{"where": f"{axis.upper()} < 0.01", "along": axis} for axis in "xyz"]
USUAL = {"young": 1e5, "poisson": 0.3}
LAWS: dict[str, dict[str, Any]] = {
    "corotational": {"corotational": USUAL},
    "corotational, exact": {"corotational": USUAL | {"tangent": "exact"}},
    "neo_hookean": {"neo_hookean": USUAL},
    "costa": {"costa": {"a": 2e4, "bulk": 1e5, "fibre": [1, 1, 0], "sheet": [1, -1, 0]}},
    "fibres": {"stable_neo_hookean": USUAL, "fibres": {"stiffness": 1e5, "direction": [1, 0, 0]}},
}  # fmt: skip


def growing(growth: Any, effects: Any = None, integrator: dict | None = None, fixed: Any = None, **table: Any) -> Any:
    solver, dt = table.pop("solver", {}), table.pop("dt", 0.02)
    given = bar(density=1000, young=None, **table)
    given["effects"] = (effects or LAWS["corotational"]) | {"growth": growth} | ({"fixed": fixed} if fixed else {})
    return Simulation(scene(given, integrator=integrator, dt=dt, **solver))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("expansion", [0.2, [0.3, -0.1, 0.05]])
def test_a_free_body_grows_without_stress(law, expansion):
    stretch = 1 + np.broadcast_to(expansion, 3)
    sim = growing({"expansion": expansion}, LAWS[law], STATIC, PLANES, solver={"tolerance": 1e-12})
    sim.world.x[:] = sim.world.rest * stretch
    assert sim.potential_energy() == pytest.approx(0, abs=1e-9)
    sim.world.x[:] = sim.world.rest
    before = sim.potential_energy()
    assert before > 10
    Driver(sim).advance(2)
    np.testing.assert_allclose(sim.fetch().x, sim.world.rest * stretch, atol=1e-6)


@pytest.mark.parametrize("integrator", [{}, {"scheme": "ros2", "solve": "iterate"}])
def test_a_free_body_grows_while_it_runs(integrator):
    """And the energy that a change brings is work, so that nothing runs away."""
    sim = growing({"expansion": 1e-3, "amount": 0.0}, None, integrator, PLANES, dt=1.0, solver={"tolerance": 1e-12})
    driver = Driver(sim)
    driver.advance(2)
    sim.parameters.set({"bar.growth.amount": "80.0"})
    records = driver.advance(60)
    assert (records["status"] == 0).all()
    np.testing.assert_allclose(sim.fetch().x, sim.world.rest * 1.08, atol=1e-5)
    start = growing({"expansion": 1e-3, "amount": 80.0}).potential_energy()
    assert records["work"][-1] == pytest.approx(start, rel=1e-9)


def test_a_clamped_bar_has_the_stress_young_times_strain():
    """sigma = -E alpha dT along the bar, free across; the force is on the grown section."""
    given = bar(density=1000, poisson=0.3, fixed="X < 0.01")
    strain = 1e-4 * 50
    fixed = [{"where": "X < 0.01 or X > 1.99", "along": "x"}, *PLANES[1:]]
    given["effects"] |= {"growth": {"expansion": 1e-4, "amount": 50.0}, "fixed": fixed}
    sim = Simulation(scene(given, integrator=STATIC, tolerance=1e-12))
    Driver(sim).advance(2)
    energy = sim.potential_energy()  # E e^2 / 2 V, e the elastic strain of the grown bar
    elastic = 1 - 1 / (1 + strain)
    assert energy == pytest.approx(0.5 * 1e5 * elastic**2 * 2 * (1 + strain) ** 3, rel=1e-6)
    across = sim.fetch().x[:, 1].max()
    assert across == pytest.approx((1 + strain) * (1 + 0.3 * elastic), rel=1e-9)


def test_a_holder_feels_the_stress_of_a_clamped_bar():
    given = bar(density=1000, poisson=0.0, fixed="X < 0.01")
    given["effects"]["growth"] = {"expansion": [1e-3, 0, 0], "amount": 10.0}
    table = {"name": "held", "dt": 0.02, "object": [given], "integrator": {"scheme": "quasi_static"},
             "holder": [{"name": "grip", "object": "bar", "where": "X > 1.99"}]}  # fmt: skip
    sim = Simulation(Scene.model_validate(table, context={"folder": "."}))
    sim.engine.run(3)
    force = sim.engine.records_and_reactions()[1][-1, 0, :3]
    np.testing.assert_allclose(force, [1e5 * (1 - 1 / 1.01), 0, 0], rtol=1e-4, atol=1e-3)


def test_a_strip_of_two_materials_bends_as_timoshenko_says():
    """Curvature 3 e / (2 h) of two equal layers of the whole height h whose expansions differ by e."""
    regions = [{"where": "Z > 0.05", "expansion": [0.0, 0.0, 0.0]}, {"expansion": [0.02, 0.0, 0.0]}]
    fixed = [{"where": "X < 0.001", "along": "x"}, {"where": "true", "along": "y"},
             {"where": "X < 0.001 and abs(Z - 0.05) < 0.001", "along": "z"}]  # fmt: skip
    turns = []
    for layers in (4, 8):
        size = (1.0, 0.1 / layers, 0.1)
        sim = growing({"expansion": regions}, {"corotational": {"young": 1e5, "poisson": 0.0, "tangent": "exact"}},
                      STATIC | {"linearizations": 40}, fixed, cells=(10 * layers, 1, layers), size=size,
                      solver={"preconditioner": "cholesky", "update": "every-1", "tolerance": 1e-10})  # fmt: skip
        Driver(sim).advance(3)
        rest, x = sim.world.rest, sim.fetch().x
        low, high = (x[(rest[:, 0] > 0.999) & (abs(rest[:, 2] - z) < 1e-6)].mean(axis=0) for z in (0, 0.1))
        turns.append(abs(np.arctan2((high - low)[0], (high - low)[2])))
    expected = 1.5 * 0.02 / 0.1
    assert turns[0] < turns[1] < expected
    assert (4 * turns[1] - turns[0]) / 3 == pytest.approx(expected, rel=0.03)


def test_bodies_beside_one_that_grows_stay_as_they_are():
    """To the bit, though they share the elements of a law."""
    objects = [bar(name=name, pose={"translate": [0, 3 * k, 0]}, fixed="X < 0.01") for k, name in enumerate("ab")]
    runs = []
    for growth in (False, True):
        grown = objects[0] | {"effects": objects[0]["effects"] | {"growth": {"expansion": 0.1}}}
        sim = Simulation(scene(grown if growth else objects[0], objects[1], gravity=(0, -9.81, 0)))
        sim.engine.run(5)
        runs.append(sim.fetch().x.copy())
    half = len(runs[0]) // 2
    assert np.array_equal(runs[0][half:], runs[1][half:]) and not np.allclose(runs[0][:half], runs[1][:half])


def test_too_much_shrinking_is_refused():
    with pytest.raises(InputError, match=r"expansion amount is 0\.04: must be from 0\.05 to 100"):
        growing({"expansion": -0.96})
    sim = growing({"expansion": -0.5})
    with pytest.raises(BadParameter, match=r"must be from 0\.05 to 100"):
        sim.parameters.set({"bar.growth.amount": "3.0"})


def test_what_is_refused():
    with pytest.raises(InputError, match="list corotational or a hyperelastic law beside it"):
        growing({"expansion": 0.1}, {"mass_spring": {"young": 1e5}})
    with pytest.raises(ValidationError, match="which linear elements alone have"):
        growing({"expansion": 0.1}, elements="smoothed")
    sim = growing({"expansion": 0.1}, elements="auto")
    assert sim.world.bodies[0].elements == "linear"
