# SPDX-License-Identifier: MIT
"""Rows of many dense matrices shared out over thread blocks: whole tiles, and few matrices per block.

A block that works on a matrix must first bring its vector into shared memory, so cutting matrices anywhere for the
sake of balance costs more than it gains. Either every matrix gets a number of blocks of its own (small ones share a
block), or, where that leaves blocks idle for too long, a block goes on with the next matrix.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Reals = NDArray[np.float64]
WORTH = 1.1  # matrices are cut anywhere only if everything else takes this many times as long
MANY = 8  # matrices per block from which whole ones balance well enough


class PhaseWork(NamedTuple):
    """Matrices of one phase: rows of tiles, time of one tile and of bringing the vector [ns]; (matrices,) each."""

    tiles: Ints
    tile: Reals
    bring: Reals


class TilePartition(NamedTuple):
    """Tiles first..first + tiles of a matrix belong to a block; sorted by block. (pieces,) each."""

    block: Ints
    matrix: Ints
    first: Ints
    tiles: Ints


def share(work: PhaseWork, blocks: int) -> TilePartition:
    """The pieces of every block; every tile is in one."""
    whole = _least(work, blocks, lambda time: _whole(work, blocks, time))
    if len(work.tiles) > MANY * blocks or blocks == 1:
        return _sorted(_whole(work, blocks, whole))
    cut = _least(work, blocks, lambda time: _cut(work, blocks, time))
    return _sorted(_cut(work, blocks, cut) if whole > WORTH * cut else _whole(work, blocks, whole))


def _sorted(pieces: TilePartition | None) -> TilePartition:
    assert pieces is not None
    order = np.lexsort((pieces.first, pieces.matrix, pieces.block))
    return TilePartition(*(field[order] for field in pieces))


def _least(work: PhaseWork, blocks: int, attempt) -> float:
    """Least time, to 1 %, in which the attempt succeeds."""
    total = float((work.tiles * work.tile + work.bring).sum())
    low, high = total / blocks, 1.001 * total
    if attempt(low) is not None:
        return low
    while high > 1.01 * low:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if attempt(middle) is not None else (middle, high)
    return high


def _whole(work: PhaseWork, blocks: int, time: float) -> TilePartition | None:
    """Blocks of their own for matrices that take longer than `time`, the others packed; None if blocks run out."""
    cost = work.tiles * work.tile + work.bring
    large, small = np.flatnonzero(cost > time), np.flatnonzero(cost <= time)
    each = ((time - work.bring[large]) // work.tile[large]).astype(np.int64)  # tiles that a block has time for
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


def _packed(cost: Reals, time: float, bins: int) -> Ints | None:
    """A bin for each, none above `time` (next fit, the largest first); None if bins run out."""
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
    """One matrix after another, a block full before the next begins; None if blocks run out."""
    tiles, tile, bring = work.tiles.tolist(), work.tile.tolist(), work.bring.tolist()
    found: list[tuple[int, int, int, int]] = []
    block, left = 0, time
    for m, rest in enumerate(tiles):
        while rest:
            fits = min(rest, int((left - bring[m]) // tile[m]))
            if fits > 0:
                found.append((block, m, tiles[m] - rest, fits))
                rest -= fits
                left -= bring[m] + fits * tile[m]
            if rest:
                if left == time or block == blocks - 1:
                    return None
                block, left = block + 1, time
    return TilePartition(*np.array(found, np.int64).reshape(-1, 4).T)
