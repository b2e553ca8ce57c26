# SPDX-License-Identifier: MIT
"""Factors that are too old for what happened (backends/cpu/native/local_refresh.h)."""

from typing import Any

import numpy as np
import pytest

from sim_server.checkpoint.content import capture, restore, restore_driver, saved_factors
from sim_server.checkpoint.file import from_bytes
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, factor_of, simulation

AFTER = 6  # REFRESH_AFTER


def falling(**table: Any) -> Simulation:
    """A beam of 612 nodes, held at its stiff end, whose soft end is let go."""
    body = bar((16, 5, 5), (3.2, 1, 1), fixed="X < 0.01", damping=(0.1, 0.0))
    body["effects"]["corotational"]["young"] = [{"where": "X < 1.6", "young": 5e6}, {"young": 2e4}]
    return simulation(body, gravity=(0, -9.81, 0), dt=0.03, preconditioner="cholesky", max_iterations=2000, **table)


def soft_end(**table: Any) -> Simulation:
    """It has made a step, with a factor of the matrix of that step."""
    sim = falling(**table)
    sim.engine.assemble()
    sim.engine.factor_matrix(0)
    sim.engine.post_factor(0, *factor_of(sim), step=sim.engine.step)
    sim.engine.solve()
    return sim


def fallen(known: bool, steps: int = 16, threads: int = 1, **table: Any) -> tuple[Simulation, Any, list[int]]:
    """Simulation, records and nodes refreshed of so many steps."""
    sim = soft_end(**table)
    sim.engine.loop.threads = threads
    if not known:
        sim.engine.forget_matrices(0)
    sim.engine.records()
    nodes, records = [], []
    for _ in range(steps):
        sim.engine.run(1)
        nodes.append(sim.engine.refreshed(0))
        records.append(sim.engine.records())
    return sim, np.concatenate(records), nodes


def test_it_saves_iterations_where_the_body_changed_most_and_never_changes_the_answer():
    refreshed, records, nodes = fallen(True)
    plain, others, none = fallen(False)
    assert not any(none) and max(nodes) > 3
    assert (records["status"] == 0).all() and (records["residual"] <= 1e-6).all()
    late = np.array(nodes) > 0
    assert records["iterations"][late][1:].max() < 0.8 * others["iterations"].max()
    assert records["iterations"].sum() < others["iterations"].sum()
    first = int(np.argmax(late))
    assert late[first:].all() and records["iterations"][first] > AFTER  # once, the factor was tried alone
    assert records["iterations"][first + 1] < records["iterations"][first]
    np.testing.assert_allclose(refreshed.world.x, plain.world.x, atol=1e-4)


def test_solves_that_need_few_iterations_have_the_same_bits_with_and_without():
    tables = {"tolerance": 0.3}
    refreshed, records, nodes = fallen(True, 6, **tables)
    plain, _, _ = fallen(False, 6, **tables)
    assert not any(nodes) and records["iterations"].max() <= AFTER
    assert refreshed.world.x.tobytes() == plain.world.x.tobytes()


def test_any_number_of_threads_gives_the_same_bits():
    one, records, nodes = fallen(True, 12)
    three, others, _ = fallen(True, 12, threads=3)
    assert any(nodes) and (records["iterations"] == others["iterations"]).all()
    assert one.world.x.tobytes() == three.world.x.tobytes()


def test_a_factor_of_a_matrix_that_was_not_noted_stays_as_it_is():
    sim = soft_end()
    sim.engine.post_factor(0, *factor_of(sim), step=10_000)
    sim.engine.run(12)
    assert sim.engine.refreshed(0) == 0 and (sim.engine.records()["status"] == 0).all()


@pytest.mark.parametrize("preconditioner", ["block_jacobi", "cholesky"])
def test_small_bodies_and_other_preconditioners_keep_nothing(preconditioner):
    body = bar((3, 3, 3) if preconditioner == "cholesky" else (16, 5, 5))
    sim = simulation(body, preconditioner=preconditioner)
    assert not [array.name for array in sim.engine.state() if "known" in array.name]
    assert sim.engine.refreshed(0) == 0


def driven(steps: int = 0) -> tuple[Simulation, Driver]:
    """A beam that falls, with a factor of each sixteenth matrix."""
    sim = falling(update="every-16")
    driver = Driver(sim)
    if steps:
        driver.advance(steps)
    return sim, driver


@pytest.mark.parametrize("earlier", [False, True])
def test_a_run_that_is_saved_goes_on(earlier):
    """To the bit, as what the matrix of its factor had is part of the state; with that of a version that did not know
    it the factor stays as it is until the next one."""
    sim, driver = driven(12)
    checkpoint = from_bytes(capture(sim, driver, "test").to_bytes())
    expected = driver.advance(3)
    assert sim.engine.refreshed(0)
    if earlier:
        for name in [name for name in checkpoint.arrays if name.startswith("state/engine.known")]:
            del checkpoint.arrays[name]
    other = Simulation(sim.scene)
    manifest = restore(other, checkpoint)
    resumed = Driver(other)
    restore_driver(resumed, manifest, saved_factors(other, checkpoint, manifest))
    records = resumed.advance(3)
    assert (records["iterations"] == expected["iterations"]).all() != earlier
    assert (other.world.x.tobytes() == sim.world.x.tobytes()) != earlier
    assert bool(other.engine.refreshed(0)) != earlier
    np.testing.assert_allclose(other.world.x, sim.world.x, atol=1e-4)
