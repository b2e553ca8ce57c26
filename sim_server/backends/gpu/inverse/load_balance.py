# SPDX-License-Identifier: MIT
"""Load balance: partition of the rows of many dense matrices into whole tiles over thread blocks.

A block must load the vector of each matrix that it has rows of into shared memory, so it gets rows of few matrices.
Either every matrix has a number of blocks of its own (small ones share a block), or, if that leaves blocks idle for too
long, a block that is full is followed by the next one anywhere in a matrix.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sim_server.arrays import Float64, Int64

CUT_GAIN = 1.1  # matrices are cut anywhere only if whole ones take this many times as long
MANY = 8  # matrices per block above which whole ones balance well enough


class PhaseWork(NamedTuple):
    """Work of one phase, per matrix: number of tiles, time of one tile [ns], time of loading the vector [ns]."""

    tiles: Int64
    tile: Float64
    load: Float64


class TilePartition(NamedTuple):
    """Pieces of matrices, sorted by block, (pieces,): tiles [first, first + tiles) of a matrix belong to a block."""

    block: Int64
    matrix: Int64
    first: Int64
    tiles: Int64


def balance(work: PhaseWork, blocks: int) -> TilePartition:
    """Assigns each tile to one of the blocks so that the longest time of a block is short."""
    whole = _least(work, blocks, lambda time: _whole(work, blocks, time))
    if len(work.tiles) > MANY * blocks or blocks == 1:
        return _sorted(_whole(work, blocks, whole))
    cut = _least(work, blocks, lambda time: _cut(work, blocks, time))
    return _sorted(_cut(work, blocks, cut) if whole > CUT_GAIN * cut else _whole(work, blocks, whole))


def _sorted(pieces: TilePartition | None) -> TilePartition:
    assert pieces is not None
    order = np.lexsort((pieces.first, pieces.matrix, pieces.block))
    return TilePartition(*(field[order] for field in pieces))


def _least(work: PhaseWork, blocks: int, attempt: Callable[[float], TilePartition | None]) -> float:
    """Returns the least time [ns], to 1 %, for which `attempt` finds a partition."""
    total = float((work.tiles * work.tile + work.load).sum())
    low, high = total / blocks, 1.001 * total
    if attempt(low) is not None:
        return low
    while high > 1.01 * low:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if attempt(middle) is not None else (middle, high)
    return high


def _whole(work: PhaseWork, blocks: int, time: float) -> TilePartition | None:
    """Gives matrices that take longer than `time` blocks of their own and packs the others; None if blocks run out."""
    cost = work.tiles * work.tile + work.load
    large, small = np.flatnonzero(cost > time), np.flatnonzero(cost <= time)
    each = ((time - work.load[large]) // work.tile[large]).astype(np.int64)  # tiles that a block has time for
    if (each < 1).any():
        return None
    count = -(-work.tiles[large] // each)
    used = int(count.sum())
    if used > blocks:
        return None
    bins = _packed(cost[small], time, blocks - used)
    if bins is None:
        return None
    # Of a matrix with `count` blocks, block k takes the tiles k * tiles / count .. (k + 1) * tiles / count.
    matrix = np.repeat(large, count)
    k = np.arange(used) - np.repeat(np.cumsum(count) - count, count)
    tiles, of = work.tiles[matrix], np.repeat(count, count)
    first, last = k * tiles // of, (k + 1) * tiles // of
    return TilePartition(
        np.concatenate([np.arange(used), used + bins]),
        np.concatenate([matrix, small]),
        np.concatenate([first, np.zeros(len(small), np.int64)]),
        np.concatenate([last - first, work.tiles[small]]),
    )


def _packed(cost: Float64, time: float, bins: int) -> Int64 | None:
    """Returns a bin for each cost, none above `time` (next fit, the largest first); None if bins run out."""
    order = np.argsort(-cost, kind="stable")
    total = np.concatenate([[0], np.cumsum(cost[order])])
    home, at = np.zeros(len(cost), np.int64), 0
    for k in range(bins):
        if at == len(cost):
            break
        end = max(at + 1, int(np.searchsorted(total, total[at] + time * (1 + 1e-9), side="right")) - 1)
        home[order[at:end]] = k
        at = end
    return home if at == len(cost) else None


def _cut(work: PhaseWork, blocks: int, time: float) -> TilePartition | None:
    """Fills one block after another with the tiles of one matrix after another; None if blocks run out."""
    tiles, tile, load = work.tiles.tolist(), work.tile.tolist(), work.load.tolist()
    found: list[tuple[int, int, int, int]] = []
    block, left = 0, time
    for m, rest in enumerate(tiles):
        while rest:
            fits = min(rest, int((left - load[m]) // tile[m]))
            if fits > 0:
                found.append((block, m, tiles[m] - rest, fits))
                rest -= fits
                left -= load[m] + fits * tile[m]
            if rest:
                if left == time or block == blocks - 1:
                    return None
                block, left = block + 1, time
    return TilePartition(*np.array(found, np.int64).reshape(-1, 4).T)
