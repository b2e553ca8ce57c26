# SPDX-License-Identifier: MIT
"""A fluid in the pores of a body: consolidation, its mass, and what it adds to the stiffness."""

import numpy as np
import pytest

from sim_server.effects.poroelasticity import Poroelasticity
from sim_server.errors import InputError
from sim_server.simulation import Simulation
from tests.scenes import bar, simulation
from tests.support.consolidation import LOAD, STORAGE, YOUNG, column, consolidation, settlement


def fluid_of(sim: Simulation) -> Poroelasticity:
    found = sim.effects["poroelasticity"]
    assert isinstance(found, Poroelasticity)
    return found


@pytest.mark.parametrize("split", ["mirrored", "kuhn"])
def test_a_column_consolidates_as_terzaghi_says(split: str) -> None:
    sim = column(20, 2000, split)
    sim.engine.run(1)
    first, last = LOAD / (YOUNG + STORAGE), LOAD / YOUNG
    assert settlement(sim) == pytest.approx(first, rel=1e-4)
    for steps, time in ((199, 0.1), (400, 0.3)):
        sim.engine.run(steps)
        degree = (settlement(sim) - first) / (last - first)
        assert degree == pytest.approx(consolidation(time), abs=0.02)


def test_large_steps_are_stable_and_end_at_the_drained_column() -> None:
    sim = column(8, 10)
    for _ in range(30):
        sim.engine.run(10)
        assert 0 < settlement(sim) < 1.001 * LOAD / YOUNG
    assert settlement(sim) == pytest.approx(LOAD / YOUNG, rel=1e-4)
    assert np.abs(fluid_of(sim).memory["inner"]).max() < 1e-3 * LOAD


@pytest.mark.parametrize(
    ("cells", "drained", "ways"),
    [(4, "min(min(X, Y), Z) < 1e-6 or max(max(X, Y), Z) > 0.999", 3), (1, "Z < 1e-6 or Z > 0.999", 1)],
    ids=["cube", "plate one cell thick"],
)
def test_a_body_drains_through_all_of_its_drained_faces(cells: int, drained: str, ways: int) -> None:
    body = bar((cells, cells, cells), (1, 1, 1), young=1e4, poisson=0, fixed="Z < 0.99 or X > 0.01")
    body["effects"]["poroelasticity"] = {"mobility": 1e-6, "storage": 1e4, "drained": drained}
    sim = simulation(body, dt=0.5, preconditioner="block_jacobi")
    inner = fluid_of(sim).memory["inner"]
    inner[...] = 1
    sim.engine.run(20)
    odd = 2 * np.arange(50) + 1
    series = np.sum(8 / (np.pi * odd) ** 2 * np.exp(-((np.pi * odd) ** 2) * 1e-2 * 10))
    assert inner.mean() == pytest.approx(series**ways, rel=0.25)


def test_nothing_flows_in_a_frozen_body() -> None:
    body = bar((2, 1, 1), (0.2, 0.1, 0.1), fixed="X < 0.01")
    body["effects"]["poroelasticity"] = {"mobility": 1e-7, "storage": 1e6, "drained": "X > 0.19"}
    sim = simulation(body)
    inner = fluid_of(sim).memory["inner"]
    inner[...] = np.arange(inner.size)
    sim.world.free[...] = 0
    sim.engine.run(3)
    np.testing.assert_array_equal(inner[0], np.arange(inner.size))


def test_the_fluid_of_a_sealed_body_stays_and_takes_no_momentum() -> None:
    body = bar((3, 2, 2), (0.3, 0.2, 0.2), young=1e4, density=1000)
    body["effects"]["poroelasticity"] = {"mobility": 1e-7, "storage": 2e4, "biot": 0.8}
    sim = simulation(body, dt=0.005, tolerance=1e-12, max_iterations=2000)
    fluid, world = fluid_of(sim), sim.world
    world.x[...] = world.rest * [1.15, 0.9, 1] + 0.002 * np.random.default_rng(3).normal(size=world.x.shape)
    spread = []
    for _ in range(30):
        sim.engine.run(1)
        spread.append(np.ptp(fluid.memory["inner"]))
    assert stored(fluid) == pytest.approx(0, abs=1e-12 * fluid.volume.sum()) and max(spread) > 100
    momentum = world.mass[:, None] * sim.fetch().v
    assert np.abs(momentum.sum(axis=0)).max() < 1e-9 * np.abs(momentum).sum()


def stored(fluid: Poroelasticity) -> float:
    """Returns the volume of fluid beyond that at rest [m3], at the J of which the pressures are."""
    jacobian, inner = fluid.memory["jacobian"][0], fluid.memory["inner"][0]
    return float(fluid.volume @ (inner / fluid.storage + fluid.biot * (jacobian - 1)))


def test_forces_are_the_slope_of_the_energy() -> None:
    body = bar((2, 1, 1), (0.2, 0.1, 0.1), young=1e4)
    body["effects"]["poroelasticity"] = {"mobility": 1e-9, "storage": 5e4}
    sim, plain = simulation(body), simulation(bar((2, 1, 1), (0.2, 0.1, 0.1), young=1e4))
    fluid, rng = fluid_of(sim), np.random.default_rng(0)
    fluid.memory["inner"][...] = rng.normal(scale=500, size=fluid.memory["inner"].shape)
    at = sim.world.rest + 0.005 * rng.normal(size=sim.world.x.shape)
    for each in (sim, plain):
        each.world.x[...] = at
        each.engine.assemble()
    added = (sim.system.b - plain.system.b) / sim.world.force_coefficient
    slope = np.empty_like(at)
    for i in np.ndindex(*at.shape):
        ends = []
        for step in (1e-6, -1e-6):
            sim.world.x[...] = at
            sim.world.x[i] += step
            ends.append(fluid.energy())
        slope[i] = (ends[0] - ends[1]) / 2e-6
    largest = np.abs(slope).max()
    np.testing.assert_allclose(added, -slope, atol=1e-6 * largest)
    assert np.abs(added.sum(axis=0)).max() < 1e-10 * largest
    assert np.abs(np.cross(at, added).sum(axis=0)).max() < 1e-11 * largest


def test_a_body_at_rest_stays_there_to_the_bit() -> None:
    body = bar((3, 2, 2), fixed="X < 0.01")
    body["effects"]["poroelasticity"] = {"mobility": 1e-7, "storage": 1e6}
    sim = simulation(body)
    sim.engine.run(5)
    np.testing.assert_array_equal(sim.fetch().x, sim.world.rest)
    assert not fluid_of(sim).pressure.any()


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="drained = 'Z > 5' holds 0 of"):
        column(4, 100, drained="Z > 5")
    with pytest.raises(InputError, match=r"'column'.*flows too fast.*allowed here: a mobility 0.0"):
        column(12, 400, mobility=1e-4)
