# SPDX-License-Identifier: MIT
"""Memory that is used again once nothing refers to its array."""

import threading

import numpy as np
import pytest

from sim_server.backends.reused_memory import MOST, SMALL, ReusedMemory

COUNT = SMALL  # numbers of eight bytes: well above what is left to the heap


def place(array: np.ndarray) -> int:
    return int(array.ctypes.data)


@pytest.mark.parametrize("view", [lambda a: a["a"][3:], lambda a: a.view(np.uint8)[8:16], lambda a: a[::7].data])
def test_memory_is_used_again_only_after_the_last_view_of_it(view):
    memory, dtype = ReusedMemory(), np.dtype([("a", "i8"), ("b", "f8")])
    first = memory.empty((COUNT,), dtype)
    first["a"], where = 7, place(first)
    kept = view(first)
    seen = bytes(kept)
    del first
    other = memory.empty((COUNT,), dtype)
    other["a"] = 9
    assert place(other) != where and bytes(kept) == seen
    del kept
    assert place(memory.empty((COUNT,), dtype)) == where


def test_arrays_have_the_shape_and_type_asked_for_and_may_be_written():
    memory = ReusedMemory()
    for shape in ((COUNT,), (COUNT, 3), (3, COUNT, 2), (0, 4), (5,)):
        for dtype in (np.float64, np.int32):
            array = memory.empty(shape, dtype)
            array[...] = 3
            assert array.shape == shape and array.dtype == dtype and (array == 3).all() and array.flags.c_contiguous


def test_smaller_arrays_take_the_memory_of_larger_ones_and_larger_ones_get_more():
    memory = ReusedMemory()
    large = place(memory.empty((4 * COUNT,), np.float64))
    assert place(memory.empty((COUNT,), np.float64)) == large
    grown = memory.empty((16 * COUNT,), np.float64)
    grown[:] = 1
    assert (grown == 1).all()


def test_more_arrays_than_it_keeps_are_arrays_of_their_own():
    memory = ReusedMemory()
    arrays = [memory.empty((COUNT,), np.float64) for _ in range(3 * MOST)]
    for number, array in enumerate(arrays):
        array[:] = number
    assert all((array == number).all() for number, array in enumerate(arrays))
    again = {place(array) for array in arrays[:MOST]}
    del arrays, array
    assert {place(each) for each in [memory.empty((COUNT,), np.float64) for _ in range(MOST)]} == again


def test_another_thread_may_be_the_last_to_have_it():
    memory = ReusedMemory()
    array, go = memory.empty((COUNT,), np.float64), threading.Event()
    array[:], where = 5, place(array)
    sums = []

    def reader(view: np.ndarray) -> None:
        go.wait(30)
        sums.append(view.sum())

    thread = threading.Thread(target=reader, args=(array[10:],))
    thread.start()
    del array
    while_read = memory.empty((COUNT,), np.float64)
    while_read[:] = 0
    go.set()
    thread.join()
    del thread
    assert sums == [5.0 * (COUNT - 10)] and place(while_read) != where
    assert place(memory.empty((COUNT,), np.float64)) == where
