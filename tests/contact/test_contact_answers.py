# SPDX-License-Identifier: MIT
"""Contact against known answers: rest, inclines, sliding, impacts, momentum, energy."""

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import D, block, floor, over

G = 9.81
STATUS = KINDS.enumeration("Status")


def weight(sim: Simulation) -> float:
    return float(sim.world.mass.sum()) * G


def mean_velocity(sim: Simulation) -> np.ndarray:
    mean: np.ndarray = sim.world.mass @ sim.world.v / sim.world.mass.sum()
    return mean


def reactions(sim: Simulation, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Records, and forces on the first obstacle, (steps, 6)."""
    sim.engine.run(steps)
    records, forces = sim.engine.records_and_reactions()
    return records, forces[:, 0]


def test_a_block_at_rest_weighs_what_it_weighs_and_stays_a_thickness_away():
    sim = over()
    Driver(sim).advance(150)
    records, forces = reactions(sim, 10)
    assert forces[-1, 1] == pytest.approx(-weight(sim), rel=1e-5)
    assert abs(forces[-1, [0, 2]]).max() <= 1e-5 * weight(sim)
    assert abs(sim.world.v).max() <= 1e-8
    rows = sim.contact.contact_input()
    closed = rows.force > 0
    assert records["contacts"][-1] == closed.sum() == 25
    assert rows.force[closed] @ np.ones(closed.sum()) == pytest.approx(weight(sim), rel=1e-5)
    low = sim.world.x[rows.corner[closed, 0], 1]
    assert np.allclose(low, D - rows.force[closed] / rows.stiffness[closed], rtol=0, atol=1e-12)
    assert (low >= 0.9 * D).all()


def test_torque_on_the_obstacle_is_that_of_the_weight():
    sim = over(floor(pose={"translate": [0.3, 0, 0]}))
    Driver(sim).advance(150)
    _, forces = reactions(sim, 1)
    centre = sim.world.mass @ sim.world.x / sim.world.mass.sum() - [0.3, 0, 0]
    expected = np.cross(centre, [0, -weight(sim), 0])
    assert np.allclose(forces[0, 3:], expected, rtol=0, atol=1e-4 * weight(sim) * 0.1)


@pytest.mark.parametrize("degrees", [-5.0, -0.5])
def test_it_does_not_creep_below_the_limit_of_friction(degrees):
    angle = np.arctan(0.5) + np.radians(degrees)
    sim = over(gravity=(G * np.sin(angle), -G * np.cos(angle), 0))
    Driver(sim).advance(90)
    before = sim.world.x.mean(axis=0)
    Driver(sim).advance(60)
    assert np.linalg.norm(sim.world.x.mean(axis=0) - before) <= 1e-6  # m in a second


@pytest.mark.parametrize("degrees", [0.5, 5.0])
def test_it_slides_beyond_the_limit_as_a_rigid_block_does(degrees):
    angle = np.arctan(0.5) + np.radians(degrees)
    sim = over(gravity=(G * np.sin(angle), -G * np.cos(angle), 0))
    Driver(sim).advance(30)
    before = mean_velocity(sim)
    Driver(sim).advance(60)
    expected = G * (np.sin(angle) - 0.5 * np.cos(angle))
    assert (mean_velocity(sim) - before)[0] == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_it_stops_where_a_rigid_block_stops(friction):
    """v^2 / (2 mu g), less half a step of v: the scheme's own first step."""
    dt, v = 1 / 60, 1.0
    sim = over(floor(friction), velocity=(v, 0, 0), friction=friction, dt=dt)
    start = sim.world.x.mean(axis=0)
    Driver(sim).advance(120)
    assert abs(sim.world.v).max() <= 1e-6
    assert (sim.world.x.mean(axis=0) - start)[0] == pytest.approx(v**2 / (2 * friction * G) - v * dt / 2, rel=5e-3)


@pytest.mark.parametrize("speed", [1.0, 10.0, 50.0])
def test_an_impact_without_friction_keeps_momentum_along_the_floor_and_tells_the_rest(speed):
    sim = over(floor(0.0), velocity=(0.3 * speed, -speed, 0), friction=0.0, at=(0, 0.02, 0))
    momentum = sim.world.mass @ sim.world.v
    records, forces = reactions(sim, 30)
    assert not records["status"].any() and not records["clipped"].any()
    after = sim.world.mass @ sim.world.v
    assert after[0] == pytest.approx(momentum[0], rel=1e-5)
    assert abs(after[2]) <= 1e-5 * momentum[0]
    impulse = -forces[:, 1].sum() * sim.world.dt
    fallen = -weight(sim) * 30 * sim.world.dt
    assert after[1] - momentum[1] == pytest.approx(impulse + fallen, rel=1e-5)
    assert sim.world.x[:, 1].min() > 0


STARTS = [
    {"velocity": (3, 0, 0)}, {"at": (0, 0.1, 0), "rotate": (30, 20, 40)}, {"velocity": (2, -5, 1)},
    {"velocity": (20, -20, 0), "at": (0, 0.1, 0), "rotate": (10, 0, 40)},
]  # fmt: skip


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("kappa", [1.0, 10.0])
def test_energy_never_passes_that_of_the_start(start, kappa):
    """Kinetic, elastic, gravity and what contacts store, of undamped blocks that slide, tumble and bounce."""
    sim = over(contact={"thickness": D, "stiffness": kappa}, **({"at": (0, 0.02, 0)} | start))
    sim.engine.loop.energy_every = 1
    driver, rows, energy = Driver(sim), sim.contact.contact_input(), []
    for _ in range(200):
        record = driver.advance(1)[0]
        assert record["status"] != STATUS["RUNAWAY"]
        stored = (rows.force**2 + (rows.traction**2).sum(axis=1)) @ (0.5 / rows.stiffness)
        energy.append(record["kinetic"] + record["elastic"] + record["gravity"] + stored)
    assert max(energy) <= energy[0] + 1e-9 * abs(energy[0])
    assert max(energy[100:]) <= energy[100] + 1e-6 * abs(energy[0])  # once it has come to rest


def test_a_moving_floor_carries_a_block_by_friction_and_its_work_is_counted():
    keys = [{"time": 0.5, "translate": [0, 0, 0]}, {"time": 2.5, "translate": [2, 0, 0]}]
    sim = over(floor(0.8, keyframes=keys), friction=0.8)
    records = Driver(sim).advance(120)
    assert mean_velocity(sim)[0] == pytest.approx(1.0, rel=1e-3)
    assert not (records["status"] == STATUS["RUNAWAY"]).any()
    kinetic, steps = 0.5 * sim.world.mass.sum(), 1 / (0.8 * G * sim.world.dt)  # until it moves along
    assert records["work"][-1] == pytest.approx(kinetic * (1 + 1 / steps), rel=0.02)  # of forces at the end of steps


def test_a_lift_raises_it():
    keys = [{"time": 0.5, "translate": [0, 0, 0]}, {"time": 1.5, "translate": [0, 1, 0]}]
    sim = over(floor(keyframes=keys))
    Driver(sim).advance(120)
    assert sim.world.x[:, 1].min() == pytest.approx(1 + D, abs=0.1 * D)


def test_two_blocks_of_different_friction_and_a_pair_named():
    pair = [{"between": ["b", "floor"], "value": 0.0}]
    sim = over(
        objects=[block(name="a"), block(name="b", at=(0, D, 0.3))], velocity=(1, 0, 0),
        contact={"thickness": D, "friction": pair},
    )  # fmt: skip
    Driver(sim).advance(60)
    a, b = (sim.world.v[body.nodes, 0].mean() for body in sim.world.bodies)
    assert abs(a) <= 1e-6
    assert b == pytest.approx(1.0, rel=1e-5)
