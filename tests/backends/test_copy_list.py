# SPDX-License-Identifier: MIT
"""Copies that a GPU makes in one launch (copy_list.cu), run by threads of the processor."""

import ctypes as c

import numpy as np
import pytest

from sim_server.backends.gpu.structs import COPIES, COPY_LIST, DEVICE_COPY
from tests.backends.fake_cuda import on_threads

EMPTY = 0xEE


def make_copies(copies: list[tuple[int, int, int]], blocks: int, count: int | None = None) -> None:
    """Makes copies (target, source, bytes); the list says that it has `count`. They come behind other contents."""
    first = COPY_LIST.itemsize + 48
    begin = np.array([(len(copies) if count is None else count, first)], COPY_LIST)
    memory = np.frombuffer(begin.tobytes() + bytes(48) + np.array(copies, DEVICE_COPY).tobytes(), np.int64)
    on_threads(COPIES, "make_copies(a)", "CopyList").run(blocks, c.c_void_p(memory.ctypes.data))


@pytest.mark.parametrize("blocks", [1, 3, 7, 40])
@pytest.mark.parametrize("count", [1, 2, 3, 20])
def test_each_copy_arrives_whole_and_nothing_else_is_written(blocks, count):
    """More copies than thread blocks, and fewer; of few and many words; at addresses of four bytes and of eight."""
    rng = np.random.default_rng(blocks + 100 * count)
    source = rng.integers(0, 200, 1 << 20, np.uint8)
    memory = np.full(1 << 20, EMPTY, np.uint8)
    expected, copies, at = memory.copy(), [], 4
    for _ in range(count):
        size, begin = 4 * int(rng.choice([1, 2, 9, 255, 256, 257, 5000])), 4 * int(rng.integers(0, 1 << 17))
        copies.append((memory.ctypes.data + at, source.ctypes.data + begin, size))
        expected[at : at + size] = source[begin : begin + size]
        at += size + 4 * int(rng.integers(0, 4))
    make_copies(copies, blocks)
    assert np.array_equal(memory, expected)


def test_only_so_many_are_made_as_the_list_says():
    source, memory = np.arange(8, dtype=np.int64), np.zeros(8, np.int64)
    copies = [(memory.ctypes.data + 8 * k, source.ctypes.data + 8 * k, 8) for k in range(1, 8)]
    make_copies(copies, 4, 3)
    assert memory.tolist() == [0, 1, 2, 3, 0, 0, 0, 0]
    make_copies(copies, 4, 0)
    assert memory.tolist() == [0, 1, 2, 3, 0, 0, 0, 0]
