# SPDX-License-Identifier: MIT
"""Bodies that the passes would let through each other, begin inside each other, are held all over, or have no place."""

import logging
from typing import Any

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from tests.contact.scenes import D, block, floor, over
from tests.contact.test_contact_sweep import SMALL, plate
from tests.contact.test_contact_triangles import obstacle
from tests.state import put

STATUS = KINDS.enumeration("Status")
JACOBI = {"preconditioner": "block_jacobi"}
FAR = floor(pose={"translate": [0, -100, 0]})


def thrown(speed: float, device: str = "cpu", **contact: float) -> Simulation:
    """A block over a plate, both free."""
    plate = block(name="plate", cells=(4, 1, 4), size=(0.2, 0.02, 0.2), at=(-0.05, 0, -0.05), young=3e6)
    ball = block(name="ball", cells=(2, 2, 2), size=(0.06, 0.06, 0.06), at=(0.021, 0.03, 0.017), young=3e6)
    given = {"thickness": D} | contact
    sim = over(FAR, objects=[plate, ball], gravity=(0, 0, 0), solver=JACOBI, contact=given, device=device)
    v = np.zeros(sim.world.v.shape)
    v[sim.world.bodies[1].nodes] = (0, -speed, 0)
    put(sim, sim.world.v, v)
    return sim


@pytest.mark.parametrize("speed", [3.0, 6.0])
def test_what_passes_is_held_back_on_both_sides_and_counted_and_momentum_is_kept(speed):
    """With passes that are too few to stop it, and hardly any stiffness."""
    sim = thrown(speed, passes=1, stiffness=0.001)
    plate, ball = (b.nodes for b in sim.world.bodies)
    before = sim.world.mass @ sim.world.v
    for _ in range(3):
        sim.engine.run(1)
        assert sim.world.x[ball, 1].mean() > sim.world.x[plate, 1].mean() + 0.02
    records = sim.engine.records().reshape(-1, 2)
    assert records["clipped"].any() and np.array_equal(*records["clipped"].T)
    assert abs(sim.world.mass @ sim.world.v - before).max() <= 1e-9 * sim.world.mass.sum() * speed


def dropped_on(obstacle: dict, linearizations: int = 1) -> Simulation:
    options = {"contact": SOFT, "solver": JACOBI, "integrator": {"linearizations": linearizations}}
    return over(obstacle, velocity=(0, -30, 0), at=(0, 0.05, 0), **options, **SMALL)


SOFT = {"thickness": D, "stiffness": 1e-3, "passes": 3}
SET_BACK = {
    "bodies": lambda: thrown(3.0, stiffness=1e-4, passes=60),
    "nodes": lambda: dropped_on(plate(0.002)),
    "triangles": lambda: dropped_on(obstacle("rod")),
    "linearizations": lambda: dropped_on(plate(0.002), 20),
}


@pytest.mark.parametrize("what", SET_BACK)
def test_a_step_that_sets_nodes_back_has_not_converged(what):
    """It does not end where its solve did, also if the law holds there."""
    sim = SET_BACK[what]()
    sim.engine.run(8)
    records = sim.engine.records()
    moved = records[records["clipped"] > 0]
    assert (moved["contact_residual"] <= sim.scene.effects["contact"].tolerance).any()
    assert set(moved["status"]) == {STATUS["CONTACT"]}


def test_a_body_that_touches_nothing_any_more_has_no_nodes_set_back():
    sim = over(velocity=(0, -6, 0), at=(0, 2 * D, 0), solver=JACOBI, contact={**SOFT, "passes": 1, "tolerance": 0.9})
    sim.engine.run(1)
    record = sim.engine.records()[0]
    assert record["clipped"] > 0 and record["status"] == STATUS["CONTACT"]
    put(sim, sim.world.v, 0)
    put(sim, sim.world.x, sim.world.x + np.array((0, 1, 0)))
    sim.engine.run(1)
    record = sim.engine.records()[0]
    assert record["passes"] == 0 and record["clipped"] == 0 and record["status"] == STATUS["CONVERGED"]


def test_objects_that_begin_inside_each_other_are_told_with_the_depth(caplog):
    objects = [block(name="one", at=(0, 0, 0)), block(name="other", at=(0.01, 0.05, 0.01))]
    with caplog.at_level(logging.WARNING):
        over(FAR, objects=objects)
    said = [r.getMessage() for r in caplog.records if "begins inside object" in r.getMessage()]
    assert len(said) == 2 and "'other' begins inside object 'one': node 0 is 0.01 m deep (16 such nodes)" in said[0]
    assert "'one' begins inside object 'other'" in said[1]
    caplog.clear()
    over(FAR, objects=[block(name="one", at=(0, 0, 0)), block(name="other", at=(0, 0.06 + D, 0))])
    assert not [r for r in caplog.records if "begins inside object" in r.getMessage()]


def test_a_body_all_of_whose_surface_is_fixed_carries_another():
    """It has no rows of its own, but a thickness."""
    sides = "X < 0.01 or X > 0.09 or Y < 0.01 or Y > 0.05 or Z < 0.01 or Z > 0.09"
    held = block(name="held", fixed=sides, at=(0, 0, 0))
    sim = over(FAR, objects=[held, block(name="free", at=(0.003, 0.06 + D, 0.002))], solver=JACOBI)
    sim.engine.run(100)
    low = sim.world.x[sim.world.bodies[1].nodes, 1].min()
    assert low == pytest.approx(0.06 + D, abs=0.2 * D) and abs(sim.world.v).max() < 1e-4
    given = sim.contact.contact_input()
    assert (given.thickness[given.obstacle >= 0] == pytest.approx(D)) and (given.force > 0).any()


def test_a_frozen_body_that_has_no_place_leaves_those_beside_it_alone():
    objects = [block(name="lost", at=(0, 0, 0)), block(name="well", at=(0.003, 0.06 + D, 0.002))]
    sim = over(FAR, objects=objects, solver=JACOBI)
    sim.engine.run(2)
    lost = sim.world.bodies[0].nodes
    sim.world.free[lost], sim.world.v[lost], sim.world.x[lost] = 0, 0, np.nan
    sim.engine.run(2)
    records = sim.engine.records().reshape(-1, 2)
    assert (records["status"][-1:, 1] != STATUS["NOT_FINITE"]).all()
    assert np.isfinite(sim.world.x[sim.world.bodies[1].nodes]).all()


def test_what_is_held_apart_is_told_of_all_bodies_that_are_solved_together():
    """Also of the first one, which only touches."""
    under = block(name="under", cells=(2, 1, 2), size=(0.06, 0.02, 0.06), at=(0.1, -0.02 - 0.5 * D, 0.1))
    plate = block(name="plate", cells=(4, 1, 4), size=(0.2, 0.02, 0.2), at=(-0.05, 0, -0.05), young=3e6)
    ball = block(name="ball", cells=(2, 2, 2), size=(0.06, 0.06, 0.06), at=(0.021, 0.03, 0.017), young=3e6)
    sim = over(
        FAR, objects=[under, plate, ball], gravity=(0, 0, 0), solver=JACOBI,
        contact={"thickness": D, "passes": 1, "stiffness": 0.001},
    )  # fmt: skip
    sim.world.v[sim.world.bodies[2].nodes] = (0, -3.0, 0)
    sim.engine.run(1)
    clipped = sim.engine.records()["clipped"]
    assert clipped[0] == clipped[1] == clipped[2] > 0


def stacked(speed: float, gap: float, linearizations: int = 1, **contact: float) -> Simulation:
    """Two blocks over each other that fall on a floor; the upper one has a speed of its own."""
    size, cells = (0.08, 0.04, 0.08), (2, 1, 2)
    low = block(name="low", cells=cells, size=size, at=(0, 2 * D, 0))
    high = block(name="high", cells=cells, size=size, at=(0.01, 0.04 + gap, 0.005))
    given = {"thickness": D, "passes": 1, "tolerance": 0.9} | contact
    sim = over(objects=[low, high], solver=JACOBI, integrator={"linearizations": linearizations}, contact=given)
    for body, v in zip(sim.world.bodies, (-6.0, -speed), strict=True):
        sim.world.v[body.nodes] = (0, v, 0)
    return sim


def test_nodes_that_are_set_back_at_an_obstacle_are_told_of_their_own_body():
    """And so is the status: the other one, solved with it, ends where the solve did."""
    sim = stacked(0, 2.5 * D, stiffness=1e-4)
    sim.engine.run(1)
    records = sim.engine.records()
    assert records["contact_residual"][0] == records["contact_residual"][1], "they are solved together"
    assert records["clipped"][0] > 0 and records["clipped"][1] == 0
    assert records["status"].tolist() == [STATUS["CONTACT"], STATUS["CONVERGED"]]


def crushed(linearizations: int = 1, solver: Any = JACOBI, passes: int = 3, stiffness: float = 0.01) -> Simulation:
    """A thin block between the floor and a heavy one that comes at 30 m/s."""
    low = block(name="low", cells=(2, 1, 2), size=(0.08, 0.02, 0.08), at=(0, 1.2 * D, 0))
    high = block(name="high", cells=(2, 1, 2), size=(0.06, 0.04, 0.06), at=(0.01, 0.02 + 4.2 * D, 0.005), density=2e4)
    contact = {"thickness": D, "passes": passes, "stiffness": stiffness, "tolerance": 1e-8}
    integrator = {"linearizations": linearizations}
    sim = over(objects=[low, high], contact=contact, solver=solver, integrator=integrator)
    sim.world.v[sim.world.bodies[1].nodes] = (0, -30, 0)
    return sim


@pytest.mark.parametrize("linearizations", [1, 4])
def test_what_is_held_apart_does_not_enter_an_obstacle_by_that(linearizations):
    """The floor does not give way, the block may."""
    sim = crushed(linearizations)
    apart = 0
    for _ in range(4):
        sim.engine.run(1)
        assert sim.world.x[:, 1].min() > 0
        apart += sim.engine.records()["clipped"].min()
    assert apart > 0


@pytest.mark.parametrize("linearizations", [1, 4])
def test_those_set_back_once_bodies_are_held_apart_count_beside_the_places(linearizations):
    if linearizations == 1:
        sim, steps = stacked(6.0, 4 * D, stiffness=0.003), 1
    else:
        sim, steps = stacked(0.0, 2.5 * D, linearizations, stiffness=1e-4), 2
    sim.engine.run(steps)
    low, high = sim.engine.records()["clipped"][-2:]
    assert low > high > 0, "more of the lower one are, and places are told of both"
