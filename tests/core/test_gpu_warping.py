# SPDX-License-Identifier: MIT
"""How settings of the frames reach a GPU: one mailbox with the flags of all bodies, posted when one changes; and what a
driver does with them where settings hold for batches of steps."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_server.driver import Driver
from sim_server.engine import ADOPTED, HELD, MOVED, NOTED, Engine, Kind
from sim_server.gpu.engine import Settings, Warping
from sim_server.gpu.solver import BODY
from sim_server.layouts import RECORD
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


@pytest.mark.parametrize("delay", [1, 5])
def test_where_steps_are_not_told_apart_frames_are_noted_before_they_are_held(delay, monkeypatch):
    """Records come some steps after the settings that they were made with."""
    monkeypatch.setattr(Engine, "exact", False)
    sim = simulation(bar(), preconditioner="cholesky", update="async")
    settings = SimpleNamespace(hold=0, note=0, adopt=0)
    sim.engine.settings = lambda body: settings  # type: ignore[method-assign, assignment]
    driver = Driver(sim)
    monkeypatch.setattr(Engine, "step", property(lambda engine: max(0, len(past) - delay)))
    assert (settings.hold, settings.note, settings.adopt) == (0, 0, 0)
    past: list[int] = []
    for step in range(300):
        flags = settings.hold * HELD | settings.note * NOTED | settings.adopt * ADOPTED
        if flags & HELD:
            assert past[-1] & NOTED and flags == HELD | NOTED | ADOPTED
        past.append(flags)
        if step >= delay:
            made = past[step - delay]
            record = np.zeros(1, RECORD)
            record["step"], record["factor_step"] = step - delay + 1, max(0, (step - delay) // 4 * 4 - 4)
            record["kind"] = record["asked"] = Kind.CHOLESKY
            record["iterations"], record["warping"] = 8 if made & HELD else 10, made
            driver.observe(record)
    held = [flags & HELD for flags in past]
    assert sum(held[-100:]) > 60, "holding was found to be better"
    noted = [flags & NOTED for flags in past]
    assert not any(noted[: 2 * delay + 5]), "nothing is written while nobody asks"
    assert all(n or not h for n, h in zip(noted, held, strict=True))
