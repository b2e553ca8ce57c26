# SPDX-License-Identifier: MIT
"""Target shapes: affine targets are reached, springs share with the material, energy, poses, and what is refused."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.scene import where
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, rotation, scene

SCHEMES: list[dict[str, Any]] = [
    {}, {"scheme": "ros2", "solve": "iterate"}, {"scheme": "newmark"}, {"scheme": "central_difference"},
]  # fmt: skip


def pulled(
    target: Any, integrator: dict | None = None, dt: float = 0.02, gravity: Any = None, **table: Any
) -> Simulation:
    solver, fixed = table.pop("solver", {}), table.pop("along", None)
    given = bar(density=1000, **table)
    given["effects"] |= {"target": target} | ({"fixed": fixed} if fixed else {})
    return Simulation(scene(given, integrator=integrator, dt=dt, gravity=gravity, **solver))


@pytest.mark.parametrize("integrator", SCHEMES)
def test_a_free_body_goes_to_a_rigid_target(integrator):
    """Which its material does not resist: turned and moved, in the frame of its pose."""
    solver = {} if integrator.get("scheme") == "central_difference" else {"tolerance": 1e-10}
    to = ["0.8 * X - 0.6 * Y + 0.3", "0.6 * X + 0.8 * Y", "Z - 0.2"]
    sim = pulled(
        {"to": to, "stiffness": 2e5}, integrator, damping=(8.0, 0.0), pose={"rotate": [0, 90, 0]}, solver=solver
    )
    records = Driver(sim).advance(300)
    rest, turn = sim.world.rest, rotation([0, 1, 0], np.pi / 2)
    goal = np.stack(
        [0.8 * rest[:, 0] - 0.6 * rest[:, 1] + 0.3, 0.6 * rest[:, 0] + 0.8 * rest[:, 1], rest[:, 2] - 0.2], 1
    )
    assert (records["status"] == 0).all()
    np.testing.assert_allclose(sim.fetch().x, goal @ turn.T, atol=1e-3)


def test_springs_sink_by_the_weight_over_their_stiffness():
    """As a whole m g / k, on any mesh, since each node has its part of both."""
    for cells in ((2, 1, 1), (4, 2, 3)):
        sim = pulled({"to": ["X", "Y", "Z"], "stiffness": 4e5}, None, 0.1, (0, -9.81, 0), cells=cells)
        sim.engine.run(300)
        u = sim.fetch().x - sim.world.rest
        np.testing.assert_allclose(u, np.broadcast_to([0, -2000 * 9.81 / 4e5, 0], u.shape), atol=1e-6)


def test_the_material_has_a_say():
    """A bar whose end is pulled by D: k_bar / (k_bar + k) of D is missing, by blend."""
    along = [{"where": "X < 0.01", "along": "x"}, {"where": "true", "along": ["y", "z"]}]
    target = {"to": ["X + 0.1", "Y", "Z"], "stiffness": 1e5, "where": "X > 1.99", "blend": 0.0}
    sim = pulled(target, {"scheme": "quasi_static", "linearizations": 20}, poisson=0.0, along=along,
                 solver={"tolerance": 1e-12})  # fmt: skip
    driver = Driver(sim)
    driver.advance(1)
    assert np.allclose(sim.fetch().x, sim.world.rest)
    for blend in (0.5, 1.0):
        sim.parameters.set({"bar.target.blend": str(blend)})
        assert driver.advance(1)["status"][-1] == 0
        end = sim.world.rest[:, 0] > 1.99
        share = sim.world.mass[end] / sim.world.mass[end].sum()
        moved = share @ (sim.fetch().x - sim.world.rest)[end, 0]
        assert moved == pytest.approx(blend * 0.1 * 1e5 / (1e5 + 1e5 / 2), rel=0.01)
        assert np.isfinite(sim.potential_energy())


@pytest.mark.parametrize("scheme", ["ros2", "central_difference"])
def test_energy_is_kept_and_what_changes_it_is_work(scheme):
    solver = {} if scheme == "central_difference" else {"tolerance": 1e-10}
    integrator = {"scheme": scheme} | ({"solve": "iterate"} if scheme == "ros2" else {})
    target = {"to": ["1.1 * X", "Y + 0.1 * X * X", "Z"], "stiffness": 1e5, "blend": 0.0}
    sim = pulled(target, integrator, 0.004, solver=solver)
    driver = Driver(sim)
    driver.advance(2)
    sim.parameters.set({"bar.target.blend": "1.0"})
    records = driver.advance(60)
    energy = sim.kinetic_energy() + sim.potential_energy()
    assert records["work"][-1] > 100 and energy == pytest.approx(records["work"][-1], rel=0.03)
    assert (records["status"] == 0).all()


def test_numbers_of_expressions():
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_allclose(where.values("X * Y - sqrt(Z) / 2", points), [2 - 3**0.5 / 2, 20 - 6**0.5 / 2])
    np.testing.assert_allclose(where.values("3", points), [3, 3])


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ({"to": ["X", "Y"], "stiffness": 1.0}, "Field required|tuple"),
        ({"to": ["X", "Y", "Z > 1"], "stiffness": 1.0}, "must be a number, not a comparison"),
        ({"to": ["X", "Y", "W"], "stiffness": 1.0}, "unknown name 'W'"),
        ({"to": ["X", "Y", "1 / X"], "stiffness": 1.0}, "is not a finite number"),
        ({"to": ["X", "Y", "Z"], "stiffness": 0.0}, "greater than 0"),
        ({"to": ["X", "Y", "Z"], "stiffness": 1.0, "where": "X > 9"}, "holds 0 of 45 nodes"),
    ],
)
def test_what_is_refused(target, said):
    with pytest.raises((InputError, ValidationError), match=said):
        pulled(target)
