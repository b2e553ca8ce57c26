# SPDX-License-Identifier: MIT
"""A run of the scheme ros2 with a worker, pushes and a grab, recorded by real processes and repeated bit for bit."""

from collections import Counter
from pathlib import Path

import pytest

from protocol import messages_pb2 as pb
from tests.system.test_replay_of_a_server import STEPS, messages, recorded, replayed

pytestmark = pytest.mark.system

ROS2 = '\n[integrator]\nscheme = "ros2"\n'


def forms(log: Path) -> Counter[str]:
    """How the steps of a log were made."""
    return Counter(pb.StepForm.Name(step.form) for step in messages(log, "step"))


@pytest.mark.parametrize(("build", "preconditioner"), [("server", "cholesky"), ("worker", "auto")])
def test_the_same_bit_for_bit(build: str, preconditioner: str, tmp_path: Path) -> None:
    """Nearly all steps are made by the factor alone: only the first ones have none, and a few of those with a new grab
    are not corrected for it."""
    log = recorded(tmp_path, f'build = "{build}"{ROS2}', preconditioner)
    made = forms(log)
    assert made["FACTOR"] > 0.5 * STEPS and made["ONE_SOLVE"] == 0, made
    assert all(step.HasField("estimate") and step.estimate < 0.05 for step in messages(log, "step"))
    assert all(0 <= s.residual < 0.05 for s in messages(log, "step") if s.form == pb.FACTOR)
    found = replayed(log, 0)
    assert found["same"] and found["other_factor"] is None and not found["notes"], found
    assert (found["steps"], found["solves"], found["frames"]) == (STEPS, STEPS, STEPS + 1)


def test_in_lockstep(tmp_path: Path) -> None:
    log = recorded(tmp_path, f'update = "lockstep-3"{ROS2}')
    assert forms(log)["FACTOR"] > 0.5 * STEPS
    assert replayed(log, 0)["same"]
