# SPDX-License-Identifier: MIT
"""Load balance: partition of the rows of many dense matrices into whole tiles over thread blocks.

A block must load the vector of each matrix that it has rows of into shared memory, so it gets rows of few matrices.
Either every matrix has a number of blocks of its own (small ones share a block), or, if that leaves blocks idle for too
long, a block that is full is followed by the next one anywhere in a matrix. The code is in tree_cuts.cpp.
"""

from typing import NamedTuple

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.backends.gpu.inverse.partition import library


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
    count = len(work.tiles)
    pieces = np.empty((count + blocks, 4), np.int64)
    tiles, tile, load = np.ascontiguousarray(work.tiles, np.int64), *map(np.ascontiguousarray, work[1:])
    found = library().balance_tiles(count, *(a.ctypes.data for a in (tiles, tile, load)), blocks, pieces.ctypes.data)
    return TilePartition(*np.ascontiguousarray(pieces[:found].T))
