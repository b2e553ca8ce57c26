# SPDX-License-Identifier: MIT
"""How settings of the frames reach a GPU: one mailbox with the flags of all bodies, posted when one changes; and when a
driver makes use of them."""

import numpy as np
import pytest

from sim_server.driver import Driver
from sim_server.engine import ADOPTED, HELD, MOVED, NOTED, Engine
from sim_server.gpu.engine import Settings, Warping
from sim_server.gpu.solver import BODY
from tests.scenes import bar, simulation


class Box:
    """A mailbox that only notes what was posted."""

    def __init__(self) -> None:
        self.posts: list[list[int]] = []

    def post(self, data: bytes) -> None:
        self.posts.append(np.frombuffer(data, np.int32).tolist())


def test_flags_of_all_bodies_are_posted_when_one_changes():
    warping, others = Warping(np.zeros(3, np.int32)), Box()
    warping.mailbox = Box()  # type: ignore[assignment]
    rows = np.zeros(3, BODY)
    bodies = [Settings(rows[k : k + 1].reshape(()), others, k, warping) for k in range(3)]  # type: ignore[arg-type]
    bodies[1].note = 1
    bodies[1].note = True
    bodies[2].hold = 1
    bodies[2].hold = 0
    bodies[1].adopt, bodies[1].note = 1, 0
    posts = [[0, NOTED, 0], [0, NOTED, HELD | MOVED], [0, NOTED, MOVED]]
    assert warping.mailbox.posts == [*posts, [0, NOTED | ADOPTED, MOVED], [0, ADOPTED, MOVED]]  # type: ignore[union-attr]
    assert [(s.hold, s.note, s.adopt) for s in bodies] == [(0, 0, 0), (0, 0, 1), (0, 0, 0)]
    assert not others.posts and rows["kind"].tolist() == [0, 0, 0]
    bodies[0].probe = 4
    assert len(others.posts) == 1 and len(warping.mailbox.posts) == 5  # type: ignore[union-attr]


@pytest.mark.parametrize(("update", "tried"), [("async", False), ("lockstep-3", True), ("every-4", True)])
def test_where_steps_are_not_told_apart_frames_follow(update, tried, monkeypatch):
    """What is noted of a batch of steps is not what the factor of one of them was made from."""
    monkeypatch.setattr(Engine, "exact", False)
    driver = Driver(simulation(bar(), preconditioner="cholesky", update=update, warp="auto"))
    assert [t.warping is not None for t in driver.tracks] == [tried]
