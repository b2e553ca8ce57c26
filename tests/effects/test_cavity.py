# SPDX-License-Identifier: MIT
"""Cavities: forces and volumes, a thick sphere, gases, liquids, energy, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.parameters import BadParameter
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.effects.hollow import INSIDE, TUBE, VOLUMES, box, hollow, loaded, sphere

STATIC = {"scheme": "quasi_static", "linearizations": 20, "tolerance": 1e-10}
FOOT = {"where": "X < 0.01"}
OUTSIDE = "max(max(abs(X - 0.5), abs(Y - 0.5)), abs(Z - 0.5)) > 0.49"


def forces(sim: Simulation) -> np.ndarray:
    """On the nodes in the present state [N]."""
    sim.engine.assemble()
    return np.asarray(sim.effects["cavity"].load.copy())  # type: ignore[attr-defined]


def reading(sim: Simulation) -> Any:
    sim.engine.assemble()
    return sim.effects["cavity"].readings()[0]  # type: ignore[attr-defined]


def moved(sim: Simulation) -> Simulation:
    sim.world.x[:] += 0.03 * np.random.default_rng(0).normal(size=sim.world.x.shape) + [3, 4, 5]
    return sim


@pytest.mark.parametrize("where", [INSIDE, TUBE])
def test_forces_are_pressure_times_the_slope_of_the_volume(tmp_path, where):
    """With neither sum nor torque, also with a lid, which hands what it gets to the nodes around it."""
    sim = loaded(hollow(tmp_path, {"where": where, "pressure": 7.0, "lids": True}, box(opened=where == TUBE)))
    assert reading(sim).volume == pytest.approx(VOLUMES[where], rel=1e-12)
    force = forces(moved(sim))
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(sim.world.x, force).sum(axis=0), 0, atol=1e-11)
    x = sim.world.x.copy()
    nodes = np.flatnonzero(np.abs(force).max(axis=1))
    assert len(nodes) == (26 if where == INSIDE else 33)
    for node in nodes[::3]:
        for c in range(3):
            volumes = []
            for sign in (1, -1):
                sim.world.x[:] = x
                sim.world.x[node, c] += sign * 1e-4
                volumes.append(reading(sim).volume)
            assert force[node, c] == pytest.approx(7 * (volumes[0] - volumes[1]) / 2e-4, abs=1e-8)


def test_a_thick_sphere_widens_as_lame_says(tmp_path):
    inner, outer, young, poisson, pressure = 0.6, 1.0, 1e5, 0.3, 100.0
    planes = [{"where": f"abs({axis}) < 1e-6", "along": axis.lower()} for axis in "XYZ"]
    given = hollow(tmp_path, {"where": "X**2 + Y**2 + Z**2 < 0.37", "pressure": pressure}, sphere(12, inner, outer),
                   fixed=planes) | {"elements": "smoothed"}  # fmt: skip
    sim = loaded(given, STATIC, tolerance=1e-9)
    assert (Driver(sim).advance(1)["status"] == 0).all()
    rest, u = sim.world.rest, sim.fetch().x - sim.world.rest
    r = np.linalg.norm(rest, axis=1)
    radial = (u * rest).sum(axis=1) / r
    factor = pressure * inner**3 / (young * (outer**3 - inner**3))
    for radius in (inner, outer):
        expected = factor * radius * ((1 - 2 * poisson) + (1 + poisson) * outer**3 / (2 * radius**3))
        assert radial[np.abs(r - radius) < 1e-6].mean() == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_a_gas_keeps_its_law_and_balances_what_squeezes_it(tmp_path, exponent):
    """p V^n = const at every state; in a wall much softer than the gas it takes nearly all of the pressure outside."""
    squeeze = {"traction": {"where": OUTSIDE, "pressure": 0.0}, "fixed": FOOT}
    cavity = {"where": INSIDE, "amount": 1.0, "exponent": exponent, "ambient": 1e4}
    given = hollow(tmp_path, cavity, **squeeze)
    given["effects"]["corotational"]["young"] = 1e4
    sim = loaded(given, STATIC, tolerance=1e-10)
    driver = Driver(sim)
    for outside in (200.0, 400.0):
        sim.parameters.set({"box.traction.pressure": str(outside)})
        assert driver.advance(2)["status"][-1] == 0
        found = reading(sim)
        assert found.pressure > 20
        assert (found.pressure + 1e4) * found.volume**exponent == pytest.approx(1e4 * 0.125**exponent, rel=1e-9)
    sim.parameters.set({"box.traction.pressure": "0.0", "box.cavity.amount": "1.1"})
    assert driver.advance(3)["status"][-1] == 0
    found = reading(sim)
    assert found.pressure > 100 and (found.pressure + 1e4) * found.volume**exponent == pytest.approx(
        1.1e4 * 0.125**exponent, rel=1e-9
    )


@pytest.mark.parametrize("integrator", [{}, {"scheme": "ros2", "solve": "iterate"}, {"linearizations": 4}])
def test_schemes_come_to_the_same_equilibrium(tmp_path, integrator):
    """Of a liquid a hundred times stiffer than the wall: how its pressure changes is in the matrix of each solve."""
    cavity = {"where": INSIDE, "volume": 0.1255, "bulk": 1e7}
    given = hollow(tmp_path, cavity, fixed=FOOT, rayleigh={"mass": 20.0, "stiffness": 0.02})
    expected = loaded(given, STATIC, tolerance=1e-10)
    assert Driver(expected).advance(1)["status"][-1] == 0
    sim = loaded(given, integrator, tolerance=1e-10)
    records = Driver(sim).advance(150)
    assert (records["status"] == 0).all()
    assert reading(sim).pressure == pytest.approx(reading(expected).pressure, rel=1e-3)
    assert reading(sim).volume == pytest.approx(0.1255, rel=1e-3)
    np.testing.assert_allclose(sim.fetch().x, expected.fetch().x, atol=1e-5)


def test_newton_converges_at_once(tmp_path):
    """Since A has all of the gas but how the areas turn."""
    sim = loaded(hollow(tmp_path, {"where": INSIDE, "amount": 1.05}, fixed=FOOT), STATIC, tolerance=1e-10)
    records = Driver(sim).advance(1)
    assert records["status"][0] == 0 and records["linearizations"][0] <= 8


@pytest.mark.parametrize("preconditioner", ["cholesky", "ssor", "none"])
def test_a_free_body_with_a_gas_moves_on(tmp_path, preconditioner):
    """Its momentum is kept, and so is a velocity, though the gas is much stiffer than the wall."""
    given = hollow(tmp_path, {"where": INSIDE, "amount": 1.01})
    sim = loaded(given, tolerance=1e-10, preconditioner=preconditioner, update="every-1", max_iterations=2000)
    sim.world.v[:] = [1, -2, 0.5]
    assert (Driver(sim).advance(10)["status"] == 0).all()
    np.testing.assert_allclose(sim.world.mass @ sim.fetch().v / sim.world.mass.sum(), [1, -2, 0.5], atol=1e-7)


@pytest.mark.parametrize("law", [{"amount": 1.2}, {"volume": 0.2, "bulk": 1e5}])
def test_walls_that_are_fixed_stay(tmp_path, law):
    """Half of the chamber is clamped: its nodes keep their places to the bit, and the rest is blown up."""
    sim = loaded(hollow(tmp_path, {"where": INSIDE} | law, fixed={"where": "X < 0.3"}))
    held, wall = sim.world.free == 0, np.zeros(sim.world.nodes, bool)
    wall[sim.effects["cavity"].node] = True  # type: ignore[attr-defined]
    assert (held & wall).any() and (wall & ~held).any()
    x = sim.world.x.copy()
    sim.engine.run(20)
    assert np.array_equal(sim.world.x[held], x[held]) and not sim.world.v[held].any()
    assert np.abs(sim.world.x - x).max() > 1e-4


def test_a_gas_between_walls_that_slide_is_refused(tmp_path):
    with pytest.raises(InputError, match="fixed along some directions only"):
        loaded(hollow(tmp_path, {"where": INSIDE, "amount": 1.2}, fixed={"where": "X < 0.3", "along": "x"}))


@pytest.mark.parametrize("cavity", [{"amount": 1.05}, {"volume": 0.127, "bulk": 1e6}, {"pressure": 500.0}])
def test_energy_is_kept(tmp_path, cavity):
    """By explicit substeps: of gas and liquid, or the work of a given pressure; the balance has the same."""
    sim = loaded(hollow(tmp_path, {"where": INSIDE} | cavity), {"scheme": "central_difference"}, dt=0.002)
    start = sim.kinetic_energy() + sim.potential_energy()
    records = Driver(sim).advance(60)
    energy = sim.kinetic_energy() + sim.potential_energy()
    assert energy == pytest.approx(start + records["work"][-1], rel=0.05) and energy > 0.5
    assert (records["work"][-1] != 0) == ("pressure" in cavity)


def test_chambers_of_a_list_change_their_pressures(tmp_path):
    """And nothing else of them; the outer one of two takes no part in the volume of the inner one."""
    tables = [{"where": INSIDE, "pressure": 5.0}]
    sim = loaded(hollow(tmp_path, tables, fixed=FOOT))
    sim.parameters.set({"box.cavity.tables": f'[{{ where = "{INSIDE}", pressure = 9.0 }}]'})
    sim.engine.run(1)
    assert sim.effects["cavity"].readings()[0].pressure == 9.0  # type: ignore[attr-defined]
    with pytest.raises(BadParameter, match="only pressure, amount and volume"):
        sim.parameters.set({"box.cavity.tables": '[{ where = "X > 0.5", pressure = 9.0 }]'})


SOFT = {"scheme": "ros2"}


@pytest.mark.parametrize(
    ("cavity", "integrator", "said"),
    [
        ({"where": "X > 3", "pressure": 1.0}, None, "holds all nodes of 0 of"),
        ({"where": f"{INSIDE} and X > 0.3", "pressure": 1.0}, None, "is not closed: .* 1 openings"),
        ({"where": OUTSIDE, "pressure": 1.0}, None, "must enclose what is not the object"),
        ({"where": INSIDE}, None, "needs one of pressure, amount and volume; has none"),
        ({"where": INSIDE, "pressure": 1.0, "amount": 1.0}, None, "has pressure and amount"),
        ({"where": INSIDE, "volume": 1.0}, None, "needs bulk"),
        ({"where": INSIDE, "pressure": 1.0, "bulk": 1.0}, None, "needs bulk"),
        ({"where": INSIDE, "amount": 1.0}, SOFT, "needs integrator.solve = 'iterate'"),
        ({"pressure": 1.0}, None, "needs where = ..., or a list of tables"),
        ({"tables": [{"where": INSIDE, "amount": 1.0}], "exponent": 1.4}, None, "exponent: stands in the tables"),
        ({"tables": [{"where": INSIDE, "pressure": 1.0}], "lids": True}, None, "lids: stands in the tables"),
    ],
)
def test_what_is_refused(tmp_path: Path, cavity: Any, integrator: Any, said: str) -> None:
    with pytest.raises((InputError, ValueError), match=said):
        loaded(hollow(tmp_path, cavity), integrator, **({"preconditioner": "cholesky"} if integrator else {}))
