# SPDX-License-Identifier: MIT
"""Arrays that know their address tell it right, whatever is made of them."""

import copy
import pickle
import sys

import numpy as np
import pytest

from protocol.shared_memory.located import Located, address, rows
from protocol.shared_memory.pool import Slot


def true(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", [np.ndarray, Located])
def test_rows_lie_one_behind_the_other_in_their_memory(kind, dtype):
    memory = np.arange(20, dtype=dtype).view(kind)
    found = rows(memory, [3, 0, 7, 10])
    assert [len(each) for each in found] == [3, 0, 7, 10] and np.concatenate(found).tolist() == list(range(20))
    assert [each.address for each in found if len(each)] == [true(each) for each in found if len(each)]
    found[2][0] = -1
    assert memory[3] == -1 and all(isinstance(each, Located) for each in found)


def test_rows_of_rows_begin_where_these_do():
    row = rows(np.arange(20.0), [4, 16])[1]
    assert [address(each) for each in rows(row, [8, 8])] == [true(row), true(row) + 64]


@pytest.mark.parametrize(
    "made",
    [lambda a: a[2:], lambda a: a.copy(), lambda a: a + 1, lambda a: a.view(np.uint8)[8:], lambda a: a.reshape(2, 4)[1],
     lambda a: copy.copy(a), lambda a: copy.deepcopy(a), lambda a: pickle.loads(pickle.dumps(a)),
     lambda a: np.ascontiguousarray(a[::2]), lambda a: a[::-1], lambda a: np.asarray(a), lambda a: a.astype("f4")],
)  # fmt: skip
def test_what_is_made_of_one_tells_its_own_address(made):
    row = rows(np.arange(12.0), [4, 8])[1]
    derived = made(row)
    assert address(derived) == true(derived) and address(row) == true(row)


def test_parts_of_a_slot_lie_where_they_tell():
    slot = Slot(1 << 14)
    slot.array(np.uint8, 64)[:] = np.arange(64)
    for first, dtype, count in [(0, np.uint8, 64), (16, np.float32, 8), (8, np.float64, 0), (64, np.float64, 2040)]:
        part = slot.part(first, dtype, count)
        assert part.size == count and address(part) == true(slot.array(np.uint8, 1)) + first
        assert part.size == 0 or address(part) == true(part)
    assert slot.part(16, np.uint8, 4).tolist() == [16, 17, 18, 19]


def test_a_signal_that_comes_while_records_tell_their_address_is_not_lost():
    """NumPy drops exceptions of the code by which it describes fields: a server lost the signal to end there."""

    def interrupt(frame, event, _):
        if event == "call" and "numpy" in frame.f_code.co_filename:
            sys.setprofile(None)
            raise KeyboardInterrupt

    records = np.zeros(3, [("body", "i4"), ("step", "i8")])
    assert address(records) == true(records)
    before = sys.getprofile()
    sys.setprofile(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            address(records)
    finally:
        sys.setprofile(before)
