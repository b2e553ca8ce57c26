# SPDX-License-Identifier: MIT
"""The scenes of contact that come along do what they say, from a start outside of all obstacles."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver

SCENES = Path(__file__).resolve().parents[2] / "deploy" / "scenes"
NAMES = ("floor_drop", "incline", "stairs", "gripper", "tool_on_organ", "two_organs", "heap", "pile")
STATUS = KINDS.enumeration("Status")


def loaded(name: str, *overrides: str) -> Simulation:
    return Simulation.load(
        SCENES / f"{name}.toml", ["solver.preconditioner=cholesky", "solver.update=lockstep-3", *overrides]
    )


def middle(sim: Simulation, body: int = 0) -> np.ndarray:
    x: np.ndarray = sim.world.x[sim.world.bodies[body].nodes].mean(axis=0)
    return x


def weight(sim: Simulation) -> float:
    return float(sim.world.mass.sum()) * 9.81


@pytest.mark.parametrize("name", NAMES)
def test_it_starts_outside_all_obstacles(name):
    sim = loaded(name)
    sim.engine.run(1)
    rows = sim.contact.contact_input()
    used = rows.obstacle >= 0
    assert (rows.gap[used] > 0).all()
    assert sim.engine.records()["status"].tolist() == [STATUS["CONVERGED"]] * len(sim.world.bodies)


def test_the_block_that_falls_comes_to_rest_on_a_face():
    sim = loaded("floor_drop")
    records = Driver(sim).advance(130)
    assert not records["status"].any()
    assert records["contacts"][-1] == 9 * 9
    assert abs(sim.world.v).max() <= 1e-3
    assert sim.contact.contact_input().force.sum() == pytest.approx(weight(sim), rel=1e-3)


def test_on_the_slope_one_stays_and_the_other_slides():
    sim = loaded("incline")
    driver = Driver(sim)
    driver.advance(60)
    before, along = [middle(sim, k) for k in range(2)], sim.world.v[sim.world.bodies[1].nodes].mean(axis=0)
    driver.advance(60)
    assert np.linalg.norm(middle(sim, 0) - before[0]) <= 1e-7
    faster = np.linalg.norm(sim.world.v[sim.world.bodies[1].nodes].mean(axis=0)) - np.linalg.norm(along)
    angle = np.radians(25)
    rigid = 9.81 * (np.sin(angle) - np.sqrt(0.25 * 0.5) * np.cos(angle)) * 0.6
    assert faster == pytest.approx(rigid, rel=0.01)


def test_the_block_tumbles_down_all_stairs():
    sim = loaded("stairs")
    driver, touched = Driver(sim), set()
    rows = sim.contact.contact_input()
    for _ in range(240):
        assert driver.advance(1)["status"][0] == STATUS["CONVERGED"]
        touched |= set(rows.obstacle[rows.force > 0].tolist())
    names = [o.name for o in sim.contact.obstacles]
    assert {"step0", "step1", "step2", "floor"} <= {names[k] for k in touched}
    assert sim.world.x[:, 1].min() > -0.6 and sim.world.x[:, 1].max() < -0.45  # on the floor
    assert abs(sim.world.v).max() <= 1e-2


def test_the_gripper_lifts_holds_and_sets_down():
    sim = loaded("gripper")
    driver, start = Driver(sim), middle(sim)
    driver.advance(200)
    held = middle(sim)
    assert held[1] - start[1] == pytest.approx(0.2, abs=2e-3)
    driver.advance(75)
    assert np.linalg.norm(middle(sim) - held) <= 1e-6
    rows = sim.contact.contact_input()
    assert set(rows.obstacle[rows.force > 0]) == {1, 2}
    assert rows.traction[:, 1].sum() == pytest.approx(weight(sim), rel=1e-4)
    assert 0.5 * rows.force.sum() == pytest.approx(25, rel=0.1)  # as the scene says
    records = driver.advance(165)
    assert not records["status"].any()
    assert middle(sim)[1] == pytest.approx(start[1], abs=1e-3)
    assert set(rows.obstacle[rows.force > 0]) == {0}


def test_without_friction_the_gripper_lifts_nothing():
    sim = loaded("gripper", "object.cube.friction=0")
    Driver(sim).advance(200)
    assert middle(sim)[1] == pytest.approx(0.031, abs=2e-3)


def test_the_tool_presses_in_feels_it_and_leaves():
    sim = loaded("tool_on_organ")
    driver, rest = Driver(sim), sim.world.x.copy()
    driver.advance(79)
    sim.engine.run(1)
    force = sim.engine.records_and_reactions()[1][0, 0, :3]
    rows = sim.contact.contact_input()
    assert force[1] > 1 and force[1] == pytest.approx(rows.force @ rows.normal[:, 1] * -1 - rows.traction[:, 1].sum())
    assert (rest - sim.world.x)[:, 1].max() > 0.005
    records = driver.advance(160)
    assert not records["status"].any() and not records["clipped"].any()
    assert not rows.force.any() and abs(sim.world.x - rest).max() <= 1e-3


def test_the_tool_presses_one_organ_into_the_other():
    """What the tool gives goes through the kidney into the tissue, and through that into the table."""
    sim = loaded("two_organs")
    driver, rest = Driver(sim), sim.world.x.copy()
    tissue, kidney = sim.world.bodies
    surface = np.arange(tissue.first, tissue.last)
    surface = surface[rest[surface, 1] > rest[surface, 1].max() - 1e-6]
    records = driver.advance(139)
    low = sim.world.x[surface, 1].min()
    pressed = driver.advance(1)
    table, tool = driver.reactions.sum(axis=0)[:, :3]
    assert tool[1] > 3 and -table[1] == pytest.approx(weight(sim) + tool[1], rel=1e-3)
    assert abs(table + tool)[[0, 2]].max() <= 2e-3 * tool[1], "all else is at rest"
    assert rest[surface, 1].min() - low > 0.002, "the kidney dents the tissue"
    assert sim.world.x[kidney.nodes, 1].min() > low, "and stays above it"
    stroked = driver.advance(80)
    x = sim.world.x[kidney.nodes].mean(axis=0) - rest[kidney.nodes].mean(axis=0)
    assert 1e-3 < x[0] < 5e-3, "friction takes it along a little"
    left = driver.advance(80)
    every = np.concatenate([records, pressed, stroked, left])
    assert not every["clipped"].any()
    assert (every["status"] == STATUS["CONTACT"]).sum() == (every["status"] != 0).sum() <= 4
    assert not driver.reactions[-2:, 1].any(), "the tool is away"
    assert -driver.reactions[-2:, 0, 1].sum() == pytest.approx(weight(sim), rel=1e-3)
    assert abs(sim.world.v).max() <= 1e-3
    assert abs(middle(sim, 1) - rest[kidney.nodes].mean(axis=0))[[0, 2]].max() <= 1e-3


def test_the_heap_comes_to_rest_within_its_walls():
    sim = loaded("heap")
    records = Driver(sim).advance(170)
    count = len(sim.world.bodies)
    assert not records["status"][100 * count :].any() and not records["clipped"].any()
    assert abs(sim.world.v).max() <= 5e-3
    sim.engine.run(1)
    forces = sim.engine.records_and_reactions()[1].sum(axis=0)
    assert -forces[:, 1].sum() == pytest.approx(weight(sim), rel=0.01)  # walls carry some by friction
    low, high = sim.world.x.min(axis=0), sim.world.x.max(axis=0)
    assert (low > [-0.06, 0, -0.06]).all() and (high[[0, 2]] < [0.3, 0.28]).all()
    lowest = sorted(sim.world.x[b.nodes, 1].min() for b in sim.world.bodies)
    assert lowest[-1] > 0.05, "some lie on others"
