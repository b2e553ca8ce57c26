# SPDX-License-Identifier: MIT
"""Arrays in page-locked memory, of a pool that uses memory again for exactly as many bytes and keeps all of it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu.pinned import PinnedArray, is_pinned, pinned_array


class Full(RuntimeError):
    """As the driver raises it."""


class Pool:
    """Memory for arrays. asked: bytes of each"""

    def __init__(self, room: int = 1 << 24):
        self.asked: list[int] = []
        self.cp: Any = SimpleNamespace(
            cuda=SimpleNamespace(alloc_pinned_memory=self.alloc, runtime=SimpleNamespace(CUDARuntimeError=Full))
        )
        self._room = room

    def alloc(self, size: int) -> bytearray:
        if size > self._room:
            raise Full
        self.asked.append(size)
        return bytearray(size)


@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 4095, 4096, 1 << 20, (1 << 20) + 1])
def test_an_array_has_its_length_in_little_more_memory(count):
    pool = Pool()
    made = pinned_array(pool.cp, count, np.dtype(np.float32))
    made[:] = 7
    assert isinstance(made, PinnedArray) and made.shape == (count,) and made.dtype == np.float32
    assert 4 * count <= pool.asked[0] <= max(512 * -(-4 * count // 512), 4.5 * count, 512)


def test_arrays_of_nearly_one_size_use_the_same_memory():
    """As of a body that is cut again and again: else the pool would grow with each cut."""
    pool, size = Pool(), 1_000_000
    for cuts in range(200):
        pinned_array(pool.cp, size + 97 * cuts, np.dtype(np.float32))
    assert len(set(pool.asked)) <= 2


def test_without_such_memory_it_is_an_ordinary_one():
    made = pinned_array(Pool(room=1 << 12).cp, 5000, np.dtype(np.float64))
    assert made.shape == (5000,) and made.dtype == np.float64 and not isinstance(made, PinnedArray)


def test_the_device_reads_rows_of_page_locked_memory_by_itself():
    memory = pinned_array(Pool().cp, 100, np.dtype(np.float32))
    assert is_pinned(memory[10:20]) and not is_pinned(memory[::2]) and not is_pinned(np.zeros(70, np.float32))
