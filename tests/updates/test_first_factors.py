# SPDX-License-Identifier: MIT
"""The first step waits for the factors of its own matrices, for a bounded time, and is then as any such step."""

import numpy as np
import pytest

from protocol.factor import Factor
from sim_server.backends.base import Due
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.first_factors import MAX_FAILURES, TIMEOUT, WORKER_TIMEOUT, FirstFactors, few
from tests.scenes import bar, simulation

GRAVITY = (0.0, -9.81, 0.0)
BODIES = [bar((6, 2, 2), fixed="X < 0.01", name="a"), bar((4, 3, 3), fixed="X < 0.01", name="b")]
SCENES = {
    "cholesky": {"preconditioner": "cholesky"},
    "auto": {},
    "incomplete": {"preconditioner": "incomplete_cholesky"},
    "adaptive": {"preconditioner": "cholesky", "update": "adaptive"},
    "positions": {"preconditioner": "cholesky", "build": "worker", "extrapolate": 1.0},
    "ros2": {"preconditioner": "cholesky", "integrator": {"scheme": "ros2"}},
    "newton": {"preconditioner": "cholesky", "integrator": {"scheme": "newmark", "linearizations": 4}},
}


class Workers(Inline):
    """Workers that answer when a test says so. count: how many; bad: jobs that fail."""

    def __init__(self, sim: Simulation, count: int = 1, bad: int = 0):
        bodies = sim.world.bodies
        super().__init__({b.name: sim.system.body_pattern(b.first, b.last) for b in bodies})
        self.count, self.bad, self.held = count, bad, False
        self.jobs: list[Job] = []

    def worker_count(self) -> int:
        return self.count

    def ready(self) -> int:
        return 0 if self.held and self.jobs else self.count

    def submit(self, job: Job) -> bool:
        self.jobs.append(job)
        if len(self.jobs) > self.bad:
            return super().submit(job)
        self._failed.append((job.object, "the worker is ill"))
        return True

    def poll(self) -> list[Factor]:
        return [] if self.held else super().poll()


class Time:
    """A clock that only sleep moves."""

    def __init__(self) -> None:
        self.now = 5.0

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += 100 * seconds


def first_factors(driver: Driver) -> tuple[FirstFactors, Time]:
    time = Time()
    return FirstFactors(driver, time.clock, time.sleep), time


@pytest.mark.parametrize("options", SCENES.values(), ids=SCENES)
def test_the_first_step_is_solved_by_the_factors_of_its_own_matrices(options: dict) -> None:
    sim, twin = (simulation(*BODIES, gravity=GRAVITY, **options) for _ in range(2))
    driver, other = Driver(sim, Workers(sim)), Driver(twin)
    first, time = first_factors(driver)
    assert first.missing == ["a", "b"]
    assert first.run() and first.done and first.missing == []
    assert time.now - 5 < 1 and sim.engine.loop.deadline == 0
    records, expected = driver.advance(1), other.step_with_fresh_factors()
    expected = np.concatenate([expected, other.advance(1)])
    assert records["factor_step"].tolist() == [0, 0, 0, 0]
    assert records["iterations"].tolist() == expected["iterations"].tolist()
    assert sim.world.x.tobytes() == twin.world.x.tobytes()


def test_bodies_that_touch_each_other_and_an_obstacle() -> None:
    from sim_server.scene.model import Scene

    upper = bar((3, 2, 2), (1, 1, 1), name="upper", pose={"translate": [0, 1.0, 0]})
    table = {
        "name": "t", "dt": 0.02, "effects": {"gravity": {"g": list(GRAVITY)}, "contact": {}},
        "solver": {"preconditioner": "cholesky"}, "object": [bar((3, 2, 2), (1, 1, 1), name="lower"), upper],
        "obstacle": [{"name": "floor", "shape": "plane"}],
    }  # fmt: skip
    sim, twin = (Simulation(Scene.model_validate(table)) for _ in range(2))
    driver, other = Driver(sim, Workers(sim)), Driver(twin)
    assert first_factors(driver)[0].run()
    records, expected = driver.advance(0), other.step_with_fresh_factors()
    assert records["factor_step"].tolist() == [0, 0] and records["contacts"].tolist() == expected["contacts"].tolist()
    assert sim.world.x.tobytes() == twin.world.x.tobytes()


def test_after_the_time_out_the_step_goes_on_and_the_late_factor_is_taken_up() -> None:
    sim = simulation(*BODIES, gravity=GRAVITY, preconditioner="cholesky")
    workers = Workers(sim)
    driver, workers.held = Driver(sim, workers), True
    first, time = first_factors(driver)
    assert first.run() and first.missing == ["a", "b"]
    assert time.now - 5 == pytest.approx(TIMEOUT, abs=0.2) and first.seconds == pytest.approx(TIMEOUT, abs=0.2)
    assert [job.object for job in workers.jobs] == ["b"], "the larger one first"
    assert driver.by_name["b"].job.in_flight and not driver.by_name["a"].job.in_flight
    driver.advance(2)
    workers.held = False
    records = driver.advance(3)
    assert 0 in records["factor_step"][records["body"] == 1].tolist(), "made from the first matrix and checked with it"
    assert driver.by_name["b"].failures.refused == 0
    assert driver.by_name["a"].factors.used > 0


def test_a_job_that_is_still_read_after_the_time_out_is_of_the_first_matrix() -> None:
    """Those that share a message are read when it leaves, by another thread."""
    sim = simulation(*BODIES, gravity=GRAVITY, preconditioner="cholesky")
    workers = Workers(sim)
    driver, workers.held = Driver(sim, workers), True
    first, _ = first_factors(driver)
    assert first.run()
    (job,), (step, matrix) = workers.jobs, driver.by_name["b"].job.matrix
    before = job.values.copy()
    driver.advance(3)
    assert step == 0 and np.array_equal(job.values, before) and np.array_equal(matrix, before)
    assert not np.array_equal(driver.engine.factor_matrix(1), before), "or it shows nothing"


def test_without_a_worker_the_wait_is_short() -> None:
    sim = simulation(*BODIES, preconditioner="cholesky")
    first, time = first_factors(Driver(sim, Workers(sim, count=0)))
    assert first.run() and time.now - 5 == pytest.approx(WORKER_TIMEOUT, abs=0.2)


@pytest.mark.parametrize(("bad", "used"), [(1, True), (MAX_FAILURES, False)])
def test_a_job_that_fails_is_given_once_more(bad: int, used: bool) -> None:
    sim = simulation(BODIES[0], gravity=GRAVITY, preconditioner="cholesky")
    workers = Workers(sim, bad=bad)
    driver = Driver(sim, workers)
    first, time = first_factors(driver)
    assert first.run() and time.now - 5 < 1 and len(workers.jobs) == 2
    assert driver.advance(0)["factor_step"].tolist() == [0 if used else -1]


def test_a_stop_ends_the_wait_within_the_step() -> None:
    sim = simulation(*BODIES, preconditioner="cholesky")
    workers = Workers(sim)
    workers.held = True
    first = FirstFactors(Driver(sim, workers), sleep=lambda seconds: setattr(sim.engine.loop, "stop", 1))
    assert not first.run() and not first.done and sim.engine.step == 0


def test_single_steps_in_a_pause_from_before_the_first_one() -> None:
    """The loop is not said to stand still before the first of them is over, and none is lost."""
    sim = simulation(*BODIES, preconditioner="cholesky")
    workers, loop = Workers(sim), sim.engine.loop
    driver, workers.held = Driver(sim, workers), True
    seen: list[tuple[int, int, int]] = []

    def sleep(seconds: float) -> None:
        seen.append((loop.halted, loop.single, sim.engine.step))
        workers.held = False

    loop.pause, loop.single = 1, 3
    due = sim.engine.wait()
    assert due is Due.SINGLE and loop.single == 2
    assert FirstFactors(driver, sleep=sleep).run(due)
    assert seen[0] == (0, 3, 0) and (loop.single, sim.engine.step) == (2, 1)
    assert (sim.engine.wait(), loop.single) == (Due.SINGLE, 1)
    loop.pause = 0
    assert sim.engine.wait() is Due.NEXT
    loop.stop = 1
    assert sim.engine.wait() is Due.STOP


def test_few_names() -> None:
    assert few(["a", "b"]) == "a, b" and few(["a", "b", "c", "d", "e"]) == "a, b, c and 2 more"
