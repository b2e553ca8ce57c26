# SPDX-License-Identifier: MIT
"""Bodies that touch each other on a GPU beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import LOCKSTEP, D, block, floor, over
from tests.contact.test_contact_edges import crossed
from tests.contact.test_contact_held_apart import thrown
from tests.contact.test_contact_triangles import SMALL, obstacle
from tests.state import put

pytestmark = pytest.mark.gpu

HEIGHT = 0.06
JACOBI: dict[str, Any] = {"preconditioner": "block_jacobi"}
TIGHT: dict[str, Any] = JACOBI | {"tolerance": 1e-10, "max_iterations": 3000}
EXACT: dict[str, Any] = {"thickness": D, "tolerance": 1e-8, "passes": 200}
FAR = floor(pose={"translate": [0, -100, 0]})


def stack(count: int, **table: Any) -> Simulation:
    """Blocks one over another, each a little aside."""
    blocks = [block(name=f"b{i}", at=(0.003 * (i % 2), D + i * (HEIGHT + D), 0.002 * (i % 2))) for i in range(count)]
    return over(objects=blocks, **table)


def heap(count: int = 6, **table: Any) -> Simulation:
    """Blocks that fall on each other, turned in various ways."""
    blocks = [
        block(name=f"b{i}", at=(0.06 * (i % 2), 0.05 + 0.15 * i, 0.05 * (i // 2 % 2)), rotate=(7 * i, 11 * i, 5 * i))
        for i in range(count)
    ]
    return over(objects=blocks, **table)


def collision(speed: float = 3.0, friction: float = 0.5, **table: Any) -> Simulation:
    """Two blocks that meet in free space, one turned, and a third one alone."""
    one = block(name="one", friction=friction, at=(0, 0, 0))
    other = block(name="other", friction=friction, at=(0.03, 0.1, 0.02), rotate=(10, 30, 5))
    sim = over(FAR, objects=[one, other, block(name="alone", at=(5, 0, 0))], gravity=(0, 0, 0), **table)
    v = np.zeros(sim.world.v.shape)
    v[sim.world.bodies[0].nodes], v[sim.world.bodies[1].nodes] = (0, speed, 0), (0.2 * speed, -speed, 0)
    put(sim, sim.world.v, v)
    return sim


def on_a_spike(**table: Any) -> Simulation:
    """A block that comes down on the corner of a box between its nodes, and carries another one."""
    blocks = [
        block(name=f"b{k}", **SMALL | {"at": (0.01 * k, 0.5 * D + k * (0.1 + 0.5 * D), 0.004 * k)}) for k in range(2)
    ]
    return over(obstacle("corner"), objects=blocks, velocity=(0.2, -1, 0), **table)


def both(make: Callable[..., Simulation], steps: int, **table: Any) -> tuple[NDArray[Any], NDArray[Any], list[float]]:
    """Returns records (steps, bodies) of a GPU and a CPU, and the largest difference of x in each step [m]."""
    sims = [make(device=device, **table) for device in ("gpu", "cpu")]
    drivers, found, apart = [Driver(sim) for sim in sims], [], []
    for _ in range(steps):
        found.append([driver.advance(1) for driver in drivers])
        sims[0].fetch()
        apart.append(float(np.abs(sims[0].world.x - sims[1].world.x).max()))
    return np.array([g for g, _ in found]), np.array([c for _, c in found]), apart


CASES: dict[str, Callable[..., Simulation]] = {
    "stack of 2": lambda **table: stack(2, **table),
    "stack of 4": lambda **table: stack(4, **table),
    "collision": lambda **table: collision(**table),
    "edge on edge": lambda **table: crossed(1.0, apart=0.5 * D, **table),
    "on a spike": lambda **table: on_a_spike(**table),
}


@pytest.mark.parametrize("case", CASES)
def test_tight_tolerances_leave_no_difference(case):
    g, c, apart = both(CASES[case], 12, solver=TIGHT, contact=EXACT)
    assert max(apart) < 1e-8, apart
    assert (g["contacts"] == c["contacts"]).all() and g["contacts"].max() > 0
    assert (g["status"] == c["status"]).all()
    assert g["work"] == pytest.approx(c["work"], rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("case", ["stack of 2", "stack of 4", "collision"])
def test_steps_with_factors_are_those_of_the_cpu(case):
    """To the tolerance of contact, factors made in the step as on the CPU."""
    make = (lambda **table: collision(1.0, **table)) if case == "collision" else CASES[case]  # faster: out of passes
    g, c, apart = both(make, 30, solver=LOCKSTEP)
    assert max(apart[:15]) < 2e-4 and max(apart) < 2e-3, apart
    assert (np.abs(g["contacts"] - c["contacts"]) <= 4).all()
    assert (g["factor_step"] == c["factor_step"]).all()
    assert g["iterations"].sum() <= 1.5 * c["iterations"].sum() + 20


def test_a_heap_stays_near_that_of_the_cpu():
    """Its motion differs more and more where blocks tumble; nothing passes through anything."""
    g, c, apart = both(heap, 40, solver=LOCKSTEP)
    assert max(apart[:8]) < 1e-4, apart
    assert np.isfinite(apart).all() and g["contacts"][-1].sum() > 20
    assert 0.5 <= g["contacts"][-10:].sum() / c["contacts"][-10:].sum() <= 2


@pytest.mark.parametrize("what", ["vertices", "edges"])
def test_what_still_passes_is_held_apart(what):
    """Contacts with hardly any stiffness; momentum is kept. How many vertices are held apart depends on rounding."""
    soft = {"thickness": D, "tolerance": 1e-8, "passes": 30, "stiffness": 1e-6}
    sims = []
    for device in ("gpu", "cpu"):
        if what == "vertices":
            sim = thrown(6.0, device=device, **soft)
        else:
            sim = crossed(3.0, contact=soft, solver=TIGHT, device=device)
        sims.append(sim)
    before = sims[0].world.mass @ sims[0].world.v
    for sim in sims:
        sim.engine.run(2)
        sim.fetch()
    g, c = (sim.engine.records() for sim in sims)
    assert g["clipped"].any() and c["clipped"].any()
    if what == "edges":
        assert (g["clipped"] == c["clipped"]).all() and np.abs(sims[0].world.x - sims[1].world.x).max() < 1e-5
    world = sims[0].world
    assert abs(world.mass @ world.v - before).max() <= 1e-8 * world.mass.sum()


def test_what_bodies_exert_on_each_other_is_that_of_the_cpu():
    told = {}
    for device in ("gpu", "cpu"):
        sim = stack(3, solver=TIGHT, contact=EXACT, device=device)
        sim.engine.run(8)
        sim.engine.records()
        told[device] = np.sort(sim.engine.other_reactions(), order=("step", "body", "number"))
    g, c = told["gpu"], told["cpu"]
    assert len(c) > 8
    for name in ("step", "body", "number", "kind"):
        assert (g[name] == c[name]).all(), name
    for name in ("force", "torque", "point"):
        np.testing.assert_allclose(g[name], c[name], atol=1e-5 * np.abs(c[name]).max())


@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_bodies_that_collide_keep_their_momentum(speed):
    sim = collision(speed, solver=JACOBI | {"tolerance": 1e-12, "max_iterations": 3000},
                    contact={"thickness": D, "tolerance": 1e-6, "passes": 200}, device="gpu")  # fmt: skip
    before = sim.world.mass @ sim.world.v
    for _ in range(int(0.3 / speed / sim.world.dt) + 4):
        sim.engine.run(1)
    sim.fetch()
    assert sim.engine.records()["contacts"].any()
    size = sim.world.mass.sum() * speed
    assert abs(sim.world.mass @ sim.world.v - before).max() <= 1e-9 * size


def test_a_stack_stands_and_each_body_carries_those_above():
    sim = stack(4, device="gpu")
    driver = Driver(sim)
    records = driver.advance(200).reshape(-1, 4)
    sim.engine.run(1)
    _, forces = sim.engine.records_and_reactions()
    sim.fetch()
    weight = sim.world.mass.sum() * 9.81
    assert -forces[:, 0, 1].sum() == pytest.approx(weight, rel=1e-5)
    assert records["iterations"][-20:, 0].mean() <= 6 and not records["status"][-20:].any()
    low = [sim.world.x[b.nodes, 1].min() for b in sim.world.bodies]
    assert np.allclose(np.diff(low), HEIGHT + D, rtol=0, atol=0.5 * D)
    assert abs(sim.world.v).max() <= 1e-4


def test_a_factor_learns_of_contact():
    """A copy of a matrix has the blocks of rows between bodies in it, as on a CPU."""
    copies = []
    for device in ("gpu", "cpu"):
        sim = stack(2, solver=TIGHT, contact=EXACT, device=device)
        sim.engine.run(4)
        sim.engine.assemble()
        copies.append([sim.engine.factor_matrix(k).copy() for k in range(2)])
        sim.engine.solve()
    for ours, theirs in zip(*copies, strict=True):
        assert np.abs(ours - theirs).max() <= 1e-6 * np.abs(theirs).max()


@pytest.mark.parametrize("case", [*CASES, "heap"])
def test_runs_repeat_to_the_bit(case):
    """Also in batches, whose steps are one graph, and by halves of a step."""

    def run(advance: Callable[[Simulation], None]) -> Sequence[bytes]:
        sim = (CASES | {"heap": heap})[case](device="gpu", solver=JACOBI)
        advance(sim)
        records, forces = sim.engine.records_and_reactions()
        sim.fetch()
        names = ("residual", "contact_residual", "iterations", "passes", "contacts", "work", "status")
        return [sim.world.x.tobytes(), sim.world.v.tobytes(), forces.tobytes(), *(records[n].tobytes() for n in names)]

    def singly(sim: Simulation) -> None:
        for _ in range(25):
            sim.engine.run(1)

    def by_halves(sim: Simulation) -> None:
        for _ in range(25):
            sim.engine.assemble()
            sim.engine.solve()

    first, *others = [run(lambda sim: sim.engine.run(25)), run(singly), run(by_halves)]
    for other in others:
        assert other == first


def test_runs_with_factors_repeat_to_the_bit():
    ends = []
    for _ in range(2):
        sim = heap(device="gpu", solver=LOCKSTEP)
        Driver(sim).advance(30)
        sim.fetch()
        ends.append(sim.world.x.tobytes())
    assert ends[0] == ends[1]


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_other_precisions_come_near(precision):
    sims = [stack(2, device=d, solver={**LOCKSTEP, **s}) for d, s in (("gpu", {"precision": precision}), ("cpu", {}))]
    for sim in sims:
        Driver(sim).advance(30)
    sims[0].fetch()
    assert np.abs(sims[0].world.x - sims[1].world.x).max() < 1e-3


def test_many_bodies():
    """More than thread blocks, in pairs: islands side by side."""
    objects = [
        block(cells=(2, 1, 1), at=(0.2 * (k // 2), D + (HEIGHT + D) * (k % 2), 0), name=f"b{k}") for k in range(300)
    ]
    made = {d: over(objects=objects, device=d, solver=TIGHT, contact=EXACT) for d in ("gpu", "cpu")}
    for sim in made.values():
        sim.engine.run(5)
    g, c = (sim.engine.records() for sim in made.values())
    made["gpu"].fetch()
    assert np.abs(made["gpu"].world.x - made["cpu"].world.x).max() < 1e-7
    assert (g["contacts"] == c["contacts"]).all() and (g["contacts"] > 0).all()
