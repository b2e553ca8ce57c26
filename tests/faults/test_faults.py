# SPDX-License-Identifier: MIT
"""Workers that die or hang in the middle of a factorization cost iterations, never a step: the log says so.

The same stage as in `deploy/run bench faults`, for a few seconds each. No times are asserted, only what records hold.
"""

import signal
from collections.abc import Iterator

import numpy as np
import pytest

from tests.support.stage import Progress, Stage, measured

pytestmark = pytest.mark.system

LAG = 25  # steps that a busy server may be ahead of the status that it tells


@pytest.fixture
def stage() -> Iterator[Stage]:
    with Stage() as stage:
        yield stage


def every_step(data: dict[str, np.ndarray], seen: int) -> None:
    """All steps are there, in order, each solved to the tolerance; no factor is from a step to come or comes back."""
    assert data["step"].tolist() == list(range(1, len(data["step"]) + 1)) and len(data["step"]) >= seen
    assert set(data["status"]) == {"converged"}
    made = data["factor_step"]
    assert (made < data["step"]).all() and (np.diff(made[made >= 0]) >= 0).all()


def test_steps_go_on_without_the_worker_that_was_killed(stage: Stage) -> None:
    worker = stage.worker("w1")
    with stage.client() as client:
        progress = Progress(stage, client)
        progress.until(lambda: progress.factor_step > 0)
        progress.until(lambda: client.status().objects[0].in_flight)  # it factorizes nearly all the time
        worker.kill()
        worker.wait()
        dead = client.status(fresh=True).step
        progress.past(dead + 50)
        last = progress.factor_step
        assert last <= dead + LAG, "what was in its hands is lost"
        progress.past(dead + 100)
        assert progress.factor_step == last, "nobody makes factors"
        stage.worker("w2")
        progress.until(lambda: progress.factor_step > dead)
        data = stage.finish(client)
    every_step(data, progress.step)
    row = measured(data, progress.step, dead)
    assert row["missed"] == 0 and row["oldest factor"] > 100


def test_steps_go_on_while_the_worker_is_stopped_and_it_is_used_again(stage: Stage) -> None:
    worker = stage.worker("w1")
    with stage.client() as client:
        progress = Progress(stage, client)
        progress.until(lambda: progress.factor_step > 0)
        worker.send_signal(signal.SIGSTOP)
        stopped = client.status(fresh=True).step
        progress.past(stopped + 150)  # longer than a lease
        assert progress.factor_step <= stopped + LAG, "no more than what had left it already"
        worker.send_signal(signal.SIGCONT)
        begun = progress.step
        progress.until(lambda: progress.factor_step > begun)
        data = stage.finish(client)
    every_step(data, progress.step)


def test_with_no_worker_at_all_every_step_is_made(stage: Stage) -> None:
    with stage.client() as client:
        progress = Progress(stage, client)
        progress.past(100)
        data = stage.finish(client)
    every_step(data, progress.step)
    assert (data["factor_step"] == -1).all()
