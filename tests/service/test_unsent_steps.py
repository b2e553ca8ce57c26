# SPDX-License-Identifier: MIT
"""Records that wait for subscribers: the newest are kept, and those left out are counted."""

import numpy as np
import pytest

from sim_server.backends.cpu.structs import REACTION, RECORD
from sim_server.recording.object_steps import Reactions, Readings
from sim_server.service.unsent_steps import UnsentSteps


def told(numbers: range) -> tuple[np.ndarray, Reactions, Readings]:
    records = np.zeros(len(numbers), RECORD)
    records["step"] = numbers
    on = np.array(numbers, float)[:, None, None] * np.ones((1, 1, 6))
    return records, Reactions(on, np.zeros(0, REACTION), ["floor"], ["a"]), Readings(on[:, 0, :1], {})


@pytest.mark.parametrize("sizes", [[3], [10], [4, 4, 4], [1] * 30, [25], [9, 2], [10, 10], [2, 30, 2]])
def test_the_newest_are_kept_with_what_belongs_to_them(sizes):
    unsent, at = UnsentSteps(10), 0
    for size in sizes:
        unsent.add(*told(range(at, at + size)))
        at += size
    batches, left_out = unsent.take()
    steps = [step for each in batches for step in each.records["step"].tolist()]
    assert steps == list(range(max(at - 10, 0), at)) and left_out == max(at - 10, 0)
    for records, reactions, readings in batches:
        assert reactions.on_obstacles[:, 0, 0].tolist() == records["step"].tolist()
        assert readings is not None and readings.values[:, 0].tolist() == records["step"].tolist()
    assert unsent.take() == ([], 0)
