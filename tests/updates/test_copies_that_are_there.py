# SPDX-License-Identifier: MIT
"""Copies of matrices that the loop has made: in which order they are told, and what becomes of their memory."""

import numpy as np
import pytest

from sim_server.updates.body_state import on_sent
from sim_server.updates.driver import Driver
from sim_server.updates.jobs_together import JobsTogether
from sim_server.updates.update_table import NONE, UpdateTable
from tests.scenes import bar, simulation

BODIES = 5


@pytest.fixture
def driver() -> Driver:
    bodies = [bar(name=f"bar{k}", young=1e5, fixed="X < 0.01") for k in range(BODIES)]
    return Driver(simulation(*bodies, preconditioner="cholesky", update="async"))


def request(driver: Driver, bodies: list[int]) -> None:
    driver.snapshots.request_all(np.array(bodies), driver.bodies)


def there(driver: Driver) -> list[tuple[int, int]]:
    bodies, steps = driver.snapshots.completed()
    return list(zip(bodies.tolist(), steps.tolist(), strict=True))


def test_they_are_told_in_the_order_of_the_requests(driver):
    assert there(driver) == []
    request(driver, [3, 0])
    assert there(driver) == [], "no step was made since"
    driver.engine.run(1)
    request(driver, [4, 1])
    assert there(driver) == [(3, 0), (0, 0)]
    request(driver, [3])  # again: behind all others
    driver.engine.run(1)
    assert there(driver) == [(0, 0), (4, 1), (1, 1), (3, 1)]
    driver.snapshots.discard(driver.bodies[4])
    assert there(driver) == [(0, 0), (1, 1), (3, 1)]


def test_those_that_were_sent_are_kept_until_their_jobs_are_over(driver):
    request(driver, [2, 4, 1])
    driver.engine.run(1)
    bodies, steps = driver.snapshots.completed()
    jobs = driver.make_jobs(bodies, steps)
    assert isinstance(jobs, JobsTogether) and jobs.objects == ["bar2", "bar4", "bar1"] and jobs.steps == [0] * 3
    on_sent(driver.table, bodies[:2], steps[:2])
    assert there(driver) == [(1, 0)] and driver.table.matrix_steps.tolist() == [NONE, NONE, 0, NONE, 0]
    assert [state.job.matrix for state in driver.bodies[:2]] == [None, None]
    for k in (2, 4):
        step, matrix = driver.bodies[k].job.matrix
        assert step == 0 and matrix is jobs.values[jobs.objects.index(f"bar{k}")]
    assert not any(driver.snapshots.free.values())
    driver.snapshots.release_all(np.array([2, 4, 0]))
    assert driver.bodies[2].job.matrix is None and (driver.table.matrix_steps == NONE).all()
    ((_, free),) = driver.snapshots.free.items()
    assert {id(memory) for memory in free} == {id(values) for values in jobs.values[:2]}


def test_jobs_by_columns_are_those_of_each(driver):
    request(driver, list(range(BODIES)))
    driver.engine.run(1)
    together = driver.make_jobs(*driver.snapshots.completed())
    assert isinstance(together, JobsTogether)
    assert together.at.tolist() == [values.ctypes.data for values in together.values]
    assert [72 * blocks for blocks in together.blocks] == [values.nbytes for values in together.values]
    for k, job in enumerate(together):
        alone = driver.make_job(driver.bodies[k], 0)
        assert alone is not None and alone.values is job.values
        for name in ("object", "epoch", "step", "warp", "dtype", "method", "on_device"):
            assert getattr(job, name) == getattr(alone, name), name
    assert [job.object for job in together[1:3]] == together.objects[1:3] == ["bar1", "bar2"]


def test_many_requests_are_put_in_order():
    table, rng = UpdateTable(700), np.random.default_rng(0)
    table.request[:] = rng.permutation(700)
    table.copying[:] = rng.random(700) < 0.4
    expected = sorted(np.flatnonzero(table.copying), key=lambda body: table.request[body])
    assert table.in_order_of_requests().tolist() == expected and len(expected) > 100
