# SPDX-License-Identifier: MIT
"""A run on a GPU with pushes, a grab and a worker, recorded by real processes and repeated bit for bit from its log."""

from pathlib import Path

import pytest

from tests.system.server_process import run
from tests.system.test_replay_of_a_server import STEPS, messages, recorded, replayed

pytestmark = pytest.mark.gpu


@pytest.mark.timeout(600)  # where other tests keep the GPU busy, whose steps take turns
@pytest.mark.parametrize("worker", ["cpu", "gpu"])
@pytest.mark.parametrize("pace", ["--realtime", "--free-run"])
def test_the_same_bit_for_bit(worker: str, pace: str, tmp_path: Path) -> None:
    """As fast as it goes many steps are launched together, and what comes in waits for the next batch.

    A worker on the GPU makes a factor every few steps, and a replay makes each of them again.
    """
    steps = STEPS if pace == "--realtime" else 30_000 if worker == "cpu" else 8_000
    options = ("--device", "gpu", "--worker-device", worker, pace, "--steps", str(steps))
    log = recorded(tmp_path, 'first_factor = "wait"', "cholesky", *options, patience=240)
    touched = messages(log, "touch")
    assert len(touched) > 3 and touched[-1].step > touched[0].step, "the log says when the loop took them up"
    assert len({s.factor_step for s in messages(log, "step")}) > 10, "factors came from the worker all along"
    found = replayed(log, 0, timeout=240)
    assert found["same"] and found["other_factor"] is None and not found["notes"], found
    assert (found["steps"], found["solves"]) == (steps, steps)


def test_steps_by_the_factor_alone(tmp_path: Path) -> None:
    """Matrices are copied between steps, when and for whom does not matter; a grab goes on by iterations."""
    log = recorded(tmp_path, '[integrator]\nscheme = "ros2"', "cholesky", "--device", "gpu", "--realtime")
    iterations = [s.iterations for s in messages(log, "step")]
    assert 0 in iterations and max(iterations) > 2
    assert replayed(log, 0, timeout=240)["same"]


def test_a_run_in_lockstep(tmp_path: Path) -> None:
    log = recorded(tmp_path, 'update = "lockstep-3"', "cholesky", "--device", "gpu")
    assert replayed(log, 0)["same"]


def test_where_no_gpu_is_left_it_is_refused(tmp_path: Path) -> None:
    log = recorded(tmp_path, "", "block_jacobi", "--device", "gpu")
    result = run("clients", "replay", str(log), "--simulate", CUDA_VISIBLE_DEVICES="")
    assert result.returncode == 2 and "recorded on a GPU" in result.stderr and "no GPU: " in result.stderr
