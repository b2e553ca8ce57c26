# SPDX-License-Identifier: MIT
"""Bodies that touch each other: momentum, stacks, islands, preconditioners, replays to the bit."""

from typing import Any

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import LOCKSTEP, D, block, floor, over

STATUS = KINDS.enumeration("Status")
HEIGHT = 0.06
JACOBI = {"preconditioner": "block_jacobi"}
FAR = floor(pose={"translate": [0, -100, 0]})


def stack(count: int, **table) -> Simulation:
    """Blocks one over another, each a little aside."""
    blocks = [block(name=f"b{i}", at=(0.003 * (i % 2), D + i * (HEIGHT + D), 0.002 * (i % 2))) for i in range(count)]
    return over(objects=blocks, **table)


def collision(
    speed: float, friction: float = 0.5, solver: dict | None = None, contact: Any = True, **table: Any
) -> Simulation:
    """Two blocks that meet in free space, one turned."""
    one = block(name="one", friction=friction, at=(0, 0, 0))
    other = block(name="other", friction=friction, at=(0.03, 0.1, 0.02), rotate=(10, 30, 5))
    sim = over(FAR, objects=[one, other], gravity=(0, 0, 0), solver=solver, contact=contact, **table)
    first, second = sim.world.bodies
    sim.world.v[first.nodes], sim.world.v[second.nodes] = (0, speed, 0), (0.2 * speed, -speed, 0)
    return sim


def momenta(sim: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Linear, and angular about the origin."""
    w = sim.world
    return w.mass @ w.v, (w.mass[:, None] * np.cross(w.x, w.v)).sum(axis=0)


def inside(sim: Simulation, one: int, other: int) -> int:
    """Number of nodes of a body within elements of another."""
    corners = sim.world.x[sim.world.bodies[other].tets]
    edges = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    from_first = sim.world.x[sim.world.bodies[one].nodes][:, None] - corners[None, :, 0]
    weights = np.einsum("tij,ntj->nti", edges, from_first)
    return int(((weights > 1e-9).all(axis=2) & (weights.sum(axis=2) < 1 - 1e-9)).any(axis=1).sum())


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_bodies_that_collide_keep_their_momentum_and_stay_out_of_each_other(speed, friction):
    """Off centre, so that they turn and pass each other."""
    contact = {"thickness": D, "tolerance": 1e-6, "passes": 200}
    sim = collision(speed, friction, JACOBI | {"tolerance": 1e-12, "max_iterations": 3000}, contact)
    linear, angular = momenta(sim)
    size = sim.world.mass.sum() * speed
    for _ in range(int(0.3 / speed / sim.world.dt) + 4):
        sim.engine.run(1)
        assert inside(sim, 0, 1) == inside(sim, 1, 0) == 0
    records = sim.engine.records()
    assert records["contacts"].any() and (not records["clipped"].any() or speed > 1)  # what is held back keeps momentum
    after, turned = momenta(sim)
    assert abs(after - linear).max() <= 1e-9 * size
    assert abs(turned - angular).max() <= 0.1 * size * 0.1  # as much as backward Euler keeps of it
    relative = [np.diff([m[b.nodes].mean(axis=0) for b in sim.world.bodies], axis=0) for m in (sim.world.v,)]
    assert np.linalg.norm(relative) < 1.9 * speed  # it was a collision


@pytest.mark.parametrize("count", [2, 4])
def test_a_stack_stands_and_each_body_carries_those_above(count):
    sim = stack(count)
    Driver(sim).advance(200)
    sim.engine.run(1)
    _, forces = sim.engine.records_and_reactions()
    weight = sim.world.mass.sum() * 9.81
    assert -forces[:, 0, 1].sum() == pytest.approx(weight, rel=1e-5)
    assert abs(forces[:, 0, [0, 2]].sum(axis=0)).max() <= 1e-4 * weight
    rows = sim.contact.contact_input()
    site = np.repeat(rows.surfaces.site_body, 2)
    of_pairs = slice(rows.surfaces.edge_start[0] - rows.body_start[-1], rows.surfaces.edge_start[0])
    force = rows.force[of_pairs, None] * rows.normal[of_pairs] + rows.traction[of_pairs]
    other = rows.obstacle[of_pairs]
    for level in range(1, count):  # what passes from body `level` down to the next one
        down = force[(site == level - 1) & (other == level)].sum(axis=0) - force[
            (site == level) & (other == level - 1)
        ].sum(axis=0)
        assert -down[1] == pytest.approx(weight * (count - level) / count, rel=1e-3)
    low = [sim.world.x[b.nodes, 1].min() for b in sim.world.bodies]
    assert np.allclose(np.diff(low), HEIGHT + D, rtol=0, atol=0.5 * D)
    assert abs(sim.world.v).max() <= 1e-4


def test_it_costs_few_iterations_at_rest():
    """Rigid motions in the preconditioner: a stack of four costs little more than a block."""
    sim = stack(4)
    records = Driver(sim).advance(200)
    assert records["iterations"][-80:].mean() <= 4
    assert not records["status"].any()


def test_preconditioners_do_not_change_the_motion():
    def end(solver: dict) -> np.ndarray:
        contact = {"thickness": D, "tolerance": 1e-8, "passes": 300}
        sim = collision(1.0, 0.3, solver | {"tolerance": 1e-10, "max_iterations": 3000}, contact)
        assert not Driver(sim).advance(25)["status"].any()
        return sim.world.x.copy()

    ends = [end(JACOBI), end({"preconditioner": "cholesky", "update": "lockstep-2"})]
    ends.append(end({"preconditioner": "cholesky", "update": "never"}))
    for other in ends[1:]:
        assert abs(other - ends[0]).max() <= 1e-6


def test_bodies_that_do_not_touch_others_are_left_alone_to_the_bit():
    """A block on the floor moves the same whether or not a stack stands far away."""
    alone = over(objects=[block(name="a"), block(name="b", at=(9, 30, 0))], velocity=(1, 0, 0))
    beside = over(
        objects=[block(name="a"), block(name="b", at=(9, D, 0)), block(name="c", at=(9, 2 * D + HEIGHT, 0))],
        velocity=(1, 0, 0),
    )  # fmt: skip
    Driver(alone).advance(60)
    Driver(beside).advance(60)
    nodes = alone.world.bodies[0].nodes
    assert np.array_equal(alone.world.x[nodes], beside.world.x[nodes])


def test_between_false_lets_them_pass():
    sim = collision(1.0, contact={"thickness": D, "between": False})
    records = Driver(sim).advance(30)
    assert not records["contacts"].any()
    first = sim.world.bodies[0]
    assert sim.world.v[first.nodes, 1].mean() == pytest.approx(1.0)


def test_friction_of_two_objects_by_name():
    pair = [{"between": ["a", "b"], "value": 0.0}]
    sim = over(
        objects=[block(name="a"), block(name="b", at=(0, 2 * D + HEIGHT, 0))],
        contact={"thickness": D, "friction": pair},
    )  # fmt: skip
    sim.world.v[sim.world.bodies[1].nodes] = (0.3, 0, 0)
    Driver(sim).advance(4)
    assert sim.world.v[sim.world.bodies[1].nodes, 0].mean() == pytest.approx(0.3, rel=0.01)


def test_one_that_is_held_carries_another():
    """The lower block is fixed at its base and has no rigid motions of its own."""
    held = block(name="held", fixed="Y < 0.001", at=(0, 1, 0))
    sim = over(objects=[held, block(name="free", at=(0, 1 + HEIGHT + D, 0))])
    Driver(sim).advance(150)
    assert abs(sim.world.v).max() <= 1e-5
    low = sim.world.x[sim.world.bodies[1].nodes, 1].min()
    assert low == pytest.approx(1 + HEIGHT + D, abs=0.5 * D)


def test_it_repeats_to_the_bit_with_any_number_of_threads():
    ends = []
    for threads in (1, 2, 2):
        sim = collision(3.0, solver=JACOBI | {"threads": threads})
        Driver(sim).advance(30)
        ends.append(sim.world.x.copy())
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[1], ends[2])


def test_energy_does_not_pass_that_of_the_start():
    sim = collision(1.0)
    sim.engine.loop.energy_every = 1
    start = sim.kinetic_energy()
    records = Driver(sim).advance(60)
    energy = (records["kinetic"] + records["elastic"]).reshape(-1, 2).sum(axis=1)
    assert energy.max() <= start * (1 + 1e-6)
    assert not (records["status"] == STATUS["RUNAWAY"]).any()


def test_a_body_thrown_fast_does_not_pass_another():
    """Its vertices meet the other's triangles on their way, however fast."""
    wall = block(
        name="wall", cells=(4, 2, 4), size=(0.2, 0.02, 0.2), fixed="X < 0.001", at=(-0.05, 0, -0.05), young=1e7
    )
    ball = block(name="ball", at=(0, 0.05, 0))
    for speed in (1.0, 10.0, 40.0):
        sim = over(FAR, objects=[wall, ball], gravity=(0, 0, 0), solver=JACOBI)
        sim.world.v[sim.world.bodies[1].nodes] = (0, -speed, 0)
        Driver(sim).advance(3)
        assert sim.world.x[sim.world.bodies[1].nodes, 1].mean() > 0.02, speed


def test_rows_that_a_sweep_has_found_end_when_the_bodies_part():
    """A ram drives one block into another that gravity would not bring it near to; then both are put far apart."""
    keys = [{"time": t, "translate": [x, 0, 0]} for t, x in ((0, -0.1), (0.02, 0.1))]
    ram = {"name": "ram", "shape": "box", "size": [0.02, 1, 1], "keyframes": keys}
    blocks = [block(name=name, at=(x, 0, 0)) for name, x in (("one", -0.05), ("other", 0.09))]
    sim = over(ram, objects=blocks, gravity=(0, 0, 0), dt=0.02, solver=JACOBI)
    rows = sim.contact.contact_input()
    first = rows.faces.start[-1]
    of_pairs = rows.obstacle[first:]
    sim.engine.run(1)
    assert (of_pairs >= 0).any()
    one, other = sim.world.bodies
    sim.world.x[one.nodes, 1] += 10
    sim.world.x[other.nodes, 1] -= 10
    sim.world.v[:] = 0
    sim.engine.run(1)
    assert (of_pairs < 0).all()
    assert not rows.force[first:].any()


@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_a_step_that_the_budget_ended_repeats_to_the_bit(speed):
    """A block comes down on the floor with one above it; other solves follow the one that was ended."""

    def fall(spent: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """spent: iterations of each step and body, at which it ends; empty: it ends by time."""
        blocks = [block(name=f"b{i}", at=(0.003 * i, 0.01 + i * (HEIGHT + D), 0)) for i in range(2)]
        sim = over(objects=blocks, velocity=(0, -speed, 0), solver=JACOBI | {"budget": 1e-9, "on_runaway": "go_on"})
        used, x = [], []
        for k in range(4):
            for i in range(2 if spent else 0):
                sim.engine.settings(i).budget = -float(spent[k][i] + 1)
            sim.engine.run(1)
            records = sim.engine.records()
            used.append(records["iterations"].copy())
            x.append(sim.world.x.copy())
            assert records["passes"].any()
        return used, x

    used, expected = fall([])
    assert np.array_equal(fall(used)[1], expected)


def falling(solver: dict | None = None) -> Simulation:
    """Four blocks that land on each other, turned."""
    blocks = []
    for k in range(4):
        at, turn = (0.01 * (k % 2), 0.02 + 0.09 * k, 0.008 * (k % 3)), (6 * (-1) ** k, 10 * k, 5)
        blocks.append(block(name=f"b{k}", at=at, rotate=turn, young=1e5))
    return over(objects=blocks, solver=solver)


def test_blocks_that_fall_on_each_other_take_few_iterations():
    """With the derivative of friction in place of its dual variable 115 in the mean, and passes run out."""
    records = Driver(falling(JACOBI)).advance(30)
    assert not records["status"].any()
    assert records["iterations"].reshape(30, 4).max(axis=1).mean() <= 95


def test_islands_choose_between_factors_and_block_jacobi():
    """Compact blocks that land go over to block Jacobi; slender beams that lie on each other keep their factors."""
    kinds = KINDS.enumeration("Kind")
    records = Driver(falling()).advance(30)
    assert not records["status"].any() and (records["kind"][-4:] == kinds["BLOCK_JACOBI"]).all()
    table = {"cells": (20, 2, 2), "size": (0.4, 0.02, 0.02), "young": 1e6, "fixed": "X < 0.001"}
    beams = [block(name=f"beam{k}", at=(0.005 * k, 0.021 * k, 0), **table) for k in range(2)]
    enough = LOCKSTEP | {"max_iterations": 1000}  # the first step, without a factor, takes up to 500 in a pass
    records = Driver(over(FAR, objects=beams, solver=enough)).advance(20)
    assert not records["status"].any() and (records["passes"][-2:] > 0).all()
    assert (records["kind"] == kinds["CHOLESKY"]).mean() > 0.5
