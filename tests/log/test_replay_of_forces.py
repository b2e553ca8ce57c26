# SPDX-License-Identifier: MIT
"""A replay tells where forces differ from those of the log, of the kinds that the log has."""

from types import SimpleNamespace
from typing import Any

import pytest

from protocol import messages_pb2 as pb
from sim_server.replay.log import RecordedObject, reaction_digests
from sim_server.replay.report import Comparison


def step(number: int, **forces: float) -> pb.ObjectStep:
    """Of the object beam; forces along x by what they are on."""
    found = pb.ObjectStep(header=pb.Header(object="beam"), step=number)
    for name, x in forces.items():
        reaction = found.reactions.add(force=pb.Vector(x=x))
        setattr(reaction, name, 3 if name == "grab" else "floor")
    return found


def comparison(*steps: pb.ObjectStep) -> Comparison:
    """With a log of these steps."""
    reactions = {(s.step, kind): digest for s in steps for kind, digest in reaction_digests(s).items()}
    recording: Any = SimpleNamespace(notes=[], objects={"beam": RecordedObject(reactions=reactions)})
    return Comparison(recording)


def test_the_same_forces_are_the_same() -> None:
    found = comparison(step(1), step(2, grab=0.1, obstacle=0.2))
    found.reactions([step(1), step(2, grab=0.1, obstacle=0.2)])
    assert found.same and found.kinds == {"grab", "obstacle"}


@pytest.mark.parametrize(
    ("now", "kind"),
    [
        (step(2, grab=0.1 * (1 + 2e-16), obstacle=0.2), "grab"),
        (step(2, grab=0.1, obstacle=0.3), "obstacle"),
        (step(2, grab=0.1), "obstacle"),
        (step(3, grab=0.1), "grab"),
    ],
)
def test_the_last_bit_of_a_force_counts(now: pb.ObjectStep, kind: str) -> None:
    found = comparison(step(1), step(2, grab=0.1, obstacle=0.2))
    found.reactions([now])
    assert found.first is not None and found.first["what"] == "reaction"
    assert found.first["detail"] == f"other forces on {kind}s than recorded"


def test_kinds_that_a_log_of_an_older_version_lacks_are_not_looked_at() -> None:
    found = comparison(step(1, obstacle=0.2))
    found.reactions([step(1, obstacle=0.2, grab=5.0, object=1.0)])
    assert found.same
