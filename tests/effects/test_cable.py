# SPDX-License-Identifier: MIT
"""Cables: forces, a straight pull, drawing in, bending, the tangent, energy, and what is refused."""

from typing import Any

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.parameters import BadParameter
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, scene

STATIC = {"scheme": "quasi_static", "linearizations": 20}
AXIS = [[x, 0.5, 0.5] for x in (0.0, 0.5, 1.0, 1.5, 2.0)]
ZIGZAG = [[0, 0, 0], [0.5, 0.5, 0.5], [1, 0, 1], [1.5, 1, 0.5], [2, 1, 1]]
PLANES = [{"where": "X < 0.01", "along": "x"}, {"where": "true", "along": ["y", "z"]}]


def tied(cable: Any, integrator: dict | None = None, fixed: Any = None, dt: float = 0.02, **table: Any) -> Simulation:
    solver = table.pop("solver", {})
    given = bar(density=1000, **table)
    given["effects"] |= {"cable": cable} | ({"fixed": fixed} if fixed else {})
    return Simulation(scene(given, integrator=integrator, dt=dt, **solver))


def forces(sim: Simulation) -> np.ndarray:
    """On the nodes in the present state [N]."""
    sim.engine.assemble()
    return np.asarray(sim.effects["cable"].load.copy())  # type: ignore[attr-defined]


def reading(sim: Simulation) -> Any:
    sim.engine.assemble()
    return sim.effects["cable"].readings()[0]  # type: ignore[attr-defined]


def test_a_straight_cable_pulls_at_its_ends_alone():
    sim = tied({"path": AXIS, "tension": 30.0})
    force = forces(sim)
    assert reading(sim).length == pytest.approx(2)
    ends = {0.0: [30, 0, 0], 2.0: [-30, 0, 0]}
    for x, expected in ends.items():
        np.testing.assert_allclose(force[sim.world.rest[:, 0] == x].sum(axis=0), expected, rtol=1e-12)
    assert np.abs(force).sum() == pytest.approx(60)


def test_forces_have_neither_sum_nor_torque():
    sim = tied([{"path": ZIGZAG, "tension": 30.0}, {"path": AXIS, "tension": 5.0}])
    sim.world.x[:] += 0.1 * np.random.default_rng(0).normal(size=sim.world.x.shape)
    force = forces(sim)
    assert np.abs(force).max() > 20
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(sim.world.x, force).sum(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("integrator", "dt", "steps"),
    [(STATIC, 1.0, 2), ({}, 1.0, 30), ({"scheme": "ros2", "solve": "iterate"}, 1.0, 60)],
)
def test_a_bar_shortens_by_tension_over_stiffness(integrator, dt, steps):
    """The section in the middle, where the tension of one node is spread over it."""
    sim = tied({"path": [AXIS[0], AXIS[-1]], "tension": 100.0}, integrator, PLANES, dt, poisson=0.0,
               solver={"tolerance": 1e-12})  # fmt: skip
    Driver(sim).advance(steps)
    rest, u = sim.world.rest, sim.fetch().x - sim.world.rest
    section = abs(rest[:, 0] - 1) < 1e-9
    share = np.where(np.isin(rest[section, 1], [0, 1]), 0.5, 1) * np.where(np.isin(rest[section, 2], [0, 1]), 0.5, 1)
    assert (u[section, 0] * share).sum() / share.sum() == pytest.approx(-100 / 1e5, rel=0.05)


def test_a_cable_that_is_drawn_in_shares_its_shortening_with_the_bar():
    """In series: the cable takes k_bar / (k_bar + k) of it; it does not push when it is let out."""
    sim = tied({"path": AXIS, "stiffness": 5e4, "shortening": 0.0}, STATIC, PLANES, 1.0, poisson=0.0,
               solver={"tolerance": 1e-12})  # fmt: skip
    driver, length, force = Driver(sim), [], []
    for shortening in (0.02, 0.04, -0.05):
        sim.parameters.set({"bar.cable.shortening": str(shortening)})
        assert driver.advance(1)["status"][-1] == 0
        length.append(reading(sim).length)
        force.append(reading(sim).tension)
        assert force[-1] == pytest.approx(5e4 * max(0.0, length[-1] - 2 + shortening), rel=1e-9)
    assert force[0] == pytest.approx((2 - length[0]) * stiffness_between_ends(), rel=0.01)
    assert force[1] == pytest.approx(2 * force[0], rel=0.02) and force[2] == 0
    assert length[2] == pytest.approx(2, abs=1e-9)


def stiffness_between_ends() -> float:
    """Of the same bar against forces on the two nodes [N/m]."""
    sim = tied({"path": [AXIS[0], AXIS[-1]], "tension": 10.0}, STATIC, PLANES, 1.0, poisson=0.0,
               solver={"tolerance": 1e-12})  # fmt: skip
    Driver(sim).advance(1)
    return 10 / (2 - reading(sim).length)


def test_a_finger_bends_by_the_moment_of_its_tendon():
    """A cable at a distance d from the axis of a slender bar makes the moment T d: a turn of T d L / (E I)."""
    height, arm, tension = 0.1, 0.05, 4.0
    path = [[0.05 * k, 0.05, 0.1] for k in range(21)]
    sim = tied({"path": path, "tension": tension}, STATIC | {"linearizations": 40}, [{"where": "X < 0.001"}], 1.0,
               cells=(20, 2, 4), size=(1.0, 0.1, height), poisson=0.0, tangent="exact", elements="smoothed",
               solver={"preconditioner": "cholesky", "update": "every-1", "tolerance": 1e-10})  # fmt: skip
    Driver(sim).advance(3)
    rest, x = sim.world.rest, sim.fetch().x
    low, high = (x[(rest[:, 0] > 0.999) & (abs(rest[:, 2] - z) < 1e-6)].mean(axis=0) for z in (0, height))
    turn = np.arctan2(-(high - low)[0], (high - low)[2])
    assert turn == pytest.approx(tension * arm / (1e5 * height**4 / 12), rel=0.05) and turn > 0.2


def matrix(sim: Simulation) -> np.ndarray:
    sim.engine.assemble()
    return sim.matrix().toarray()


@pytest.mark.parametrize("given", [{"tension": 500.0}, {"stiffness": 3e3, "shortening": 0.3}])
def test_the_tangent_is_the_slope_of_the_forces(given):
    """All of it; A has h^2 times its negative, and b the forces."""
    path = [[0, 0, 0], [1, 0, 1], [2, 1, 1]]
    off = {key: 1e-9 if key == "stiffness" else 0.0 for key in given}
    sims = [tied({"path": path} | each, cells=(2, 1, 1), solver={"warp": False}) for each in (given, off)]
    shake = 0.05 * np.random.default_rng(1).normal(size=sims[0].world.x.shape)
    for sim in sims:
        sim.world.x[:] += shake
    dt = sims[0].world.dt
    found = (matrix(sims[0]) - matrix(sims[1])) / dt**2
    x, slopes = sims[0].world.x.copy(), []
    for k in range(x.size):
        each = []
        for sign in (1, -1):
            impulse = []
            for sim in sims:
                sim.world.x[:] = x
                sim.world.x.ravel()[k] += sign * 1e-5
                sim.engine.assemble()
                impulse.append(sim.system.b.copy().ravel() / dt)
            each.append(impulse[0] - impulse[1])
        slopes.append((each[1] - each[0]) / 2e-5)
    np.testing.assert_allclose(found, np.array(slopes), atol=1e-6 * np.abs(found).max())
    assert np.linalg.eigvalsh(found).min() > -1e-9 * np.abs(found).max()


@pytest.mark.parametrize("scheme", ["ros2", "central_difference", "generalized_alpha"])
@pytest.mark.parametrize("given", [{"tension": 500.0}, {"stiffness": 3e4, "shortening": 0.05}])
def test_energy_is_that_of_the_start_and_of_work(scheme, given):
    solver = {} if scheme == "central_difference" else {"tolerance": 1e-10}
    integrator = {"scheme": scheme} | ({"solve": "iterate"} if scheme == "ros2" else {})
    sim = tied({"path": ZIGZAG} | given, integrator, dt=0.002, cells=(4, 2, 2), solver=solver)
    start = sim.potential_energy()
    records = Driver(sim).advance(60)
    energy = sim.kinetic_energy() + sim.potential_energy()
    assert (records["status"] == 0).all() and energy > 1
    assert energy == pytest.approx(start + records["work"][-1], rel=0.03)
    assert (start > 0) == ("stiffness" in given)


def test_what_draws_it_in_is_work():
    sim = tied({"path": AXIS, "stiffness": 3e4, "shortening": 0.0}, fixed=[{"where": "X < 0.01"}])
    driver = Driver(sim)
    driver.advance(2)
    sim.parameters.set({"bar.cable.shortening": "0.05"})
    records = driver.advance(10)
    assert records["work"][-1] == pytest.approx(0.5 * 3e4 * 0.05**2, rel=1e-6) and (records["status"] == 0).all()


def test_a_cable_holds_no_part_of_a_body():
    corners = [[2.0 * (k & 1), k >> 1 & 1, k >> 2] for k in range(8)]
    cable = {"path": corners, "stiffness": 1e3}
    with pytest.raises(InputError, match="leave 4 of 8 nodes loose"):
        tied(cable, STATIC, {"where": "X < 0.01"}, cells=(1, 1, 1), young=None)


def test_cables_of_a_list_are_live():
    tables = [{"path": AXIS, "tension": 5.0}, {"path": ZIGZAG, "stiffness": 100.0}]
    sim = tied(tables, fixed=[{"where": "X < 0.01"}])

    def text(path: Any, tension: float) -> str:
        return f"[{{ path = {path}, tension = {tension} }}, {{ path = {ZIGZAG}, stiffness = 100.0, shortening = 0.1 }}]"

    sim.parameters.set({"bar.cable.tables": text(AXIS, 7.0)})
    sim.engine.run(1)
    assert reading(sim).tension == 7.0
    with pytest.raises(BadParameter, match="only tension and shortening"):
        sim.parameters.set({"bar.cable.tables": text(ZIGZAG, 7.0)})


@pytest.mark.parametrize(
    ("cable", "said"),
    [
        ({"path": AXIS}, "needs either tension"),
        ({"path": AXIS, "tension": 1.0, "stiffness": 1.0}, "needs either tension"),
        ({"path": AXIS, "tension": 1.0, "shortening": 1.0}, "shortening needs the stiffness"),
        ({"path": AXIS, "tension": -1.0}, "greater than or equal to 0"),
        ({"path": AXIS[:1], "tension": 1.0}, "has 1 points: must have 2 to 64"),
        ({"path": [[0, 0, 0], [0.1, 0, 0]], "tension": 1.0}, "points 1 and 2 have the same nearest node"),
        ({"tension": 1.0}, "needs path = ..., or a list of tables"),
    ],
)
def test_what_is_refused(cable, said):
    with pytest.raises((InputError, ValueError), match=said):
        tied(cable)
