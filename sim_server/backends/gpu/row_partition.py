# SPDX-License-Identifier: MIT
"""Partition of A over thread blocks: the thread blocks of each body, the rows of each, and the nodes that rows read."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64
from sim_server.backends.gpu.structs import PCG

SPARED = 8  # multiprocessors left to the building of inverses; a solve that needs all would wait until that ends
NODES_A_BLOCK = 8  # smallest number of nodes for which a body gets one more thread block


class BlockAssignment(NamedTuple):
    """Thread blocks of each body.

    first (bodies,): first thread block; -1: the body is in the pool, and any free thread block takes it
    blocks (bodies,): number of thread blocks
    order: bodies with thread blocks of their own, then those in the pool, largest first
    pooled: number of bodies in the pool
    """

    first: Int64
    blocks: Int64
    order: Int64
    pooled: int


def assign_blocks(nodes: Int64, grid: int) -> BlockAssignment:
    """Assigns `grid` thread blocks to bodies of so many nodes, (bodies,), by size.

    If there are more bodies than thread blocks, small bodies form a pool that shares what the large ones leave.
    """
    bodies = len(nodes)
    wanted = nodes / nodes.sum() * grid
    own = np.ones(bodies, bool) if bodies <= grid else wanted >= 2
    pooled = int((~own).sum())
    free = grid - max(1, round(wanted[~own].sum())) if pooled else grid
    count = np.ones(bodies, np.int64)
    if own.any():
        count[own] = _spread(nodes[own], free)
    first = np.full(bodies, -1)
    first[own] = np.cumsum(count[own]) - count[own]
    rest = np.flatnonzero(~own)
    order = np.concatenate([np.flatnonzero(own), rest[np.argsort(-nodes[rest], kind="stable")]])
    return BlockAssignment(first, count, order, pooled)


def _spread(nodes: Int64, blocks: int) -> Int64:
    """Returns the thread blocks of each body that minimize the nodes of the busiest one, and no more than help."""
    low, high = nodes.sum() / blocks, float(nodes.max())
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if np.ceil(nodes / middle).sum() <= blocks else (middle, high)
    return np.minimum(np.ceil(nodes / high).astype(np.int64), -(-nodes // NODES_A_BLOCK))


def busiest(nodes: Int64, assigned: BlockAssignment, grid: int) -> float:
    """Returns the number of nodes of the busiest thread block, over all its rounds of the pool."""
    own, rest = assigned.first >= 0, assigned.first < 0
    alone = float((nodes[own] / assigned.blocks[own]).max(initial=0))
    if not assigned.pooled:
        return alone
    rounds = -(-assigned.pooled // max(1, grid - int(assigned.blocks[own].sum())))
    return max(alone, rounds * float(nodes[rest].mean()))


def best_assignment(nodes: Int64, processors: int, blocks: int) -> tuple[BlockAssignment, int]:
    """Returns an assignment and its number of thread blocks, `blocks` of them on a multiprocessor.

    It spares SPARED multiprocessors, or fewer where that would leave many others idle.
    """
    spared = min(SPARED, processors // 4)
    grids = [blocks * (processors - s) for s in range(spared, spared // 2 - 1, -1)]
    found = [(assign_blocks(nodes, grid), grid) for grid in grids]
    load = [busiest(nodes, assigned, grid) for assigned, grid in found]
    return found[int(np.argmax(np.array(load) <= 1.1 * min(load)))]


ROW_RANGE = PCG.dtype("RowRange")
"""Rows of A of one thread block.

body; index: of the thread block in its body; begin, own: own nodes [begin, begin + own) of the body;
halo_first, halo: range in Halo.nodes; block_first, blocks: range of the blocks of A.
"""


class Halo(NamedTuple):
    """Nodes that each thread block of each body reads.

    ranges (thread blocks,): ROW_RANGE
    nodes: of the body; the lists of all thread blocks one after another, in each its own nodes first
    local (blocks of A,): column of each block as a position in the list of its thread block
    first (bodies,): first range of each body
    """

    ranges: NDArray[Any]
    nodes: Int64
    local: Int64
    first: Int64


def halo(ranges: Int64, count: Int64, row_start: Int32, columns: Int32) -> Halo:
    """Cuts the rows of each body evenly by nodes.

    ranges (bodies, 2): nodes [first, last) of each body. count (bodies,): its number of thread blocks.
    """
    total = int(row_start.shape[0]) - 1
    first = np.cumsum(count) - count
    begin, end = [], []
    for (low, high), parts in zip(ranges.tolist(), count.tolist(), strict=True):
        cut = low + (high - low) * np.arange(parts + 1) // parts
        begin.append(cut[:-1])
        end.append(cut[1:])
    low, high = np.concatenate(begin), np.concatenate(end)
    own = high - low
    owner = np.repeat(np.arange(len(own)), own)  # of each node
    reader = np.repeat(owner, np.diff(row_start))  # of each block of A
    columns = columns.astype(np.int64)
    foreign = owner[columns] != reader
    keys, rank = np.unique(reader[foreign] * total + columns[foreign], return_inverse=True)
    of = keys // total
    extra = np.bincount(of, minlength=len(own))
    local = columns - low[reader]
    local[foreign] = own[reader[foreign]] + rank - (np.cumsum(extra) - extra)[reader[foreign]]
    start = np.concatenate([[0], np.cumsum(own + extra)])
    nodes = np.empty(start[-1], np.int64)
    mine = np.arange(total)
    nodes[start[owner] + mine - low[owner]] = mine
    nodes[start[of] + own[of] + np.arange(len(keys)) - (np.cumsum(extra) - extra)[of]] = keys % total
    origin = np.repeat(ranges[:, 0], count)  # of each thread block
    table = np.zeros(len(own), ROW_RANGE)
    table["body"] = np.repeat(np.arange(len(count)), count)
    table["index"] = np.arange(len(own)) - np.repeat(first, count)
    table["begin"], table["own"] = low - origin, own
    table["halo_first"], table["halo"] = start[:-1], np.diff(start)
    table["block_first"], table["blocks"] = row_start[low], row_start[high] - row_start[low]
    return Halo(table, nodes - np.repeat(origin, np.diff(start)), local, first)


def lists_of(partition: Halo) -> dict[str, NDArray[np.int32]]:
    """Returns the arrays of the solver by their names in PcgArguments."""
    ranges, nodes, local = partition.ranges.view(np.int32), partition.nodes, partition.local
    return {"row_ranges": ranges, "halo": nodes.astype(np.int32), "local_column": local.astype(np.int32)}


AHEAD, COLUMN_BITS = 1, 15  # of spmv.cuh
ROW_BLOCKS = 17  # most blocks of A in a slab for each of its rows


def warp_rows(warps: int) -> int:
    """Returns the rows of a slab for each of the warps of a thread block."""
    return 4 if warps > 8 else 8


def mirrored(partition: Halo, row_start: Int32, columns: Int32, warps: int) -> dict[str, NDArray[np.int32]]:
    """Returns the arrays by which one thread block a body finds each block of A among those on and above the diagonal,
    and sets what shared memory that takes in `partition`.

    warps: of a thread block
    """
    total, ranges = int(row_start.shape[0]) - 1, partition.ranges
    starts, columns = row_start.astype(np.int64), columns.astype(np.int64)
    rows = np.repeat(np.arange(total), np.diff(starts))
    above = columns >= rows
    rank: Int64 = np.cumsum(above) - above  # among the kept blocks of all bodies
    of_row = np.append(rank, int(above.sum()))[starts]  # of the first block of each row
    other = np.searchsorted(rows * total + columns, np.where(above, rows * total + columns, columns * total + rows))
    first = partition.ranges["block_first"]
    body = np.repeat(np.arange(len(ranges)), ranges["blocks"])
    rank = rank[other] - rank[first][body]
    word = (rank << COLUMN_BITS + 1) | (np.where(above, 0, 1) << COLUMN_BITS) | partition.local
    lowest, uppers, slab = np.empty(total, np.int64), [], warp_rows(warps) * warps
    for k, (own, at) in enumerate(zip(ranges["own"].tolist(), first.tolist(), strict=True)):
        low = int(rows[at])
        upper = of_row[low : low + own + 1] - of_row[low]
        reached = np.minimum.accumulate(columns[starts[low : low + own]][::-1])[::-1] - low
        lowest[low : low + own] = reached
        opens = np.arange(0, own, slab)
        ends = upper[np.minimum(opens + (AHEAD + 1) * slab, own)]
        fits = np.diff(np.append(starts[low + opens], starts[low + own])).max() <= ROW_BLOCKS * slab
        ranges["upper"][k] = upper[-1]
        ranges["window"][k] = (ends - upper[reached[opens]]).max() if fits else 0
        uppers.append(upper)
    return {
        "row_ranges": ranges.view(np.int32), "local_column": word.astype(np.uint32).view(np.int32),
        "upper_start": np.concatenate(uppers).astype(np.int32), "lowest_row": lowest.astype(np.int32),
    }  # fmt: skip


def initial_ranges(assigned: BlockAssignment, partition: Halo, grid: int) -> Int32:
    """Returns the range with which each thread block of the grid begins, -1 where it takes one of the pool."""
    found = np.full(grid, -1, np.int32)
    for body in assigned.order[: len(assigned.order) - assigned.pooled]:
        k = np.arange(assigned.blocks[body])
        found[assigned.first[body] + k] = partition.first[body] + k
    return found
