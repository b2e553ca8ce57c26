# SPDX-License-Identifier: MIT
"""The blocks of A on and above its diagonal, by which one thread block multiplies (spmv.cuh), and their window."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_server.arrays import Int32
from sim_server.backends.gpu.row_partition import AHEAD, COLUMN_BITS, halo, mirrored, warp_rows

SEEDS = st.integers(0, 2**32 - 1)


def pattern(rng: np.random.Generator, nodes: list[int], reach: int) -> tuple[np.ndarray, Int32, Int32]:
    """Ranges, row starts and columns of bodies whose nodes are coupled with random others up to `reach` further on."""
    ranges = np.stack([np.cumsum(nodes) - nodes, np.cumsum(nodes)], axis=1)
    pairs = [(i, i) for i in range(ranges[-1, 1])]
    for first, last in ranges.tolist():
        for i in range(first, last):
            others = rng.integers(i + 1, min(i + 1 + reach, last), 4) if i + 1 < last else []
            pairs += [pair for j in others for pair in ((i, int(j)), (int(j), i))]
    rows, columns = np.array(sorted(set(pairs)), np.int32).T
    row_start = np.searchsorted(rows, np.arange(ranges[-1, 1] + 1)).astype(np.int32)
    return ranges, row_start, np.ascontiguousarray(columns)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, reach=st.sampled_from([2, 9, 200]), warps=st.sampled_from([1, 4, 16]))
def test_each_block_is_found_in_the_window(seed, reach, warps):
    """A window is filled as the kernel fills it; each word of a slab must find its block there."""
    rng = np.random.default_rng(seed)
    nodes = rng.integers(1, 120, 3).tolist()
    ranges, row_start, columns = pattern(rng, nodes, reach)
    partition = halo(ranges, np.ones(3, np.int64), row_start, columns)
    lists = mirrored(partition, row_start, columns, warps)
    words = lists["local_column"].view(np.uint32)
    slab = warp_rows(warps) * warps
    for body, (first, last) in enumerate(ranges.tolist()):
        own, size = last - first, int(partition.ranges["window"][body])
        upper = lists["upper_start"][first + body : last + body + 1]
        assert upper[0] == 0 and upper[-1] == partition.ranges["upper"][body]
        window = np.full((size, 2), -1)  # row and column of the block at each place

        def ask(k: int, origin: int, at: int, window=window, first=first, own=own, upper=upper, size=size) -> None:
            for i in range(k * slab, min((k + 1) * slab, own)):
                above = [j for j in columns[row_start[first + i] : row_start[first + i + 1]] - first if j >= i]
                for n, j in enumerate(above):
                    place = int(upper[i]) + n - origin + at
                    window[place - size * (place >= size)] = i, j

        for k in range(AHEAD):
            ask(k, 0, 0)
        for k in range(-(-own // slab)):
            origin = int(upper[lists["lowest_row"][first + k * slab]])
            at = origin % size
            ask(k + AHEAD, origin, at)
            for i in range(k * slab, min((k + 1) * slab, own)):
                for n in range(row_start[first + i], row_start[first + i + 1]):
                    j, transposed = int(words[n]) & (1 << COLUMN_BITS) - 1, words[n] >> COLUMN_BITS & 1
                    place = int(words[n] >> COLUMN_BITS + 1) - origin + at
                    assert j == columns[n] - first and transposed == (j < i)
                    assert tuple(window[place - size * (place >= size)]) == (min(i, j), max(i, j))


def test_a_row_with_many_blocks_has_no_window():
    """A body one of whose slabs has more blocks than there is room for passes through shared memory as a whole."""
    n = 200
    pairs = sorted({(i, i) for i in range(n)} | {(0, i) for i in range(n)} | {(i, 0) for i in range(n)})
    rows, columns = np.array(pairs, np.int32).T
    row_start = np.searchsorted(rows, np.arange(n + 1)).astype(np.int32)
    partition = halo(np.array([[0, n]]), np.ones(1, np.int64), row_start, columns)
    mirrored(partition, row_start, columns, 1)
    assert partition.ranges["window"].tolist() == [0] and partition.ranges["upper"].tolist() == [2 * n - 1]
