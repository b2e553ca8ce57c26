# SPDX-License-Identifier: MIT
"""Who does what on the device: thread blocks of each body, the rows of A of each, the nodes that their rows read."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
SPARED = 8  # multiprocessors that a step leaves to expansions beside it: one that needs all would wait for them to end
NODES_A_BLOCK = 8  # a body of few nodes is not spread over more thread blocks than this gives


class BlockAssignment(NamedTuple):
    """Thread blocks [first, first + blocks) of each body, first -1 where any free one takes it; `order`: those with
    blocks of their own, then the `pooled` others, largest first."""

    first: Ints
    blocks: Ints
    order: Ints
    pooled: int


def assignment(nodes: Ints, grid: int) -> BlockAssignment:
    """nodes (bodies,): by size while there are enough thread blocks; of many bodies the small share what is left."""
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


def _spread(nodes: Ints, blocks: int) -> Ints:
    """Thread blocks of each body so that the busiest block of all has as few nodes as can be; no more than help."""
    low, high = nodes.sum() / blocks, float(nodes.max())
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if np.ceil(nodes / middle).sum() <= blocks else (middle, high)
    return np.minimum(np.ceil(nodes / high).astype(np.int64), -(-nodes // NODES_A_BLOCK))


def busiest(nodes: Ints, given: BlockAssignment, grid: int) -> float:
    """Nodes that the busiest thread block has to do with, one round of the pool after another."""
    own, rest = given.first >= 0, given.first < 0
    alone = float((nodes[own] / given.blocks[own]).max(initial=0))
    if not given.pooled:
        return alone
    rounds = -(-given.pooled // max(1, grid - int(given.blocks[own].sum())))
    return max(alone, rounds * float(nodes[rest].mean()))


def assign_blocks(nodes: Ints, processors: int, blocks: int) -> tuple[BlockAssignment, int]:
    """The assignment and its number of thread blocks, `blocks` of them on a multiprocessor. Some multiprocessors are
    spared, fewer where more would leave many others idle."""
    spared = min(SPARED, processors // 4)
    grids = [blocks * (processors - s) for s in range(spared, spared // 2 - 1, -1)]
    found = [(assignment(nodes, grid), grid) for grid in grids]
    load = [busiest(nodes, share, grid) for share, grid in found]
    return found[int(np.argmax(np.array(load) <= 1.1 * min(load)))]


ROW_RANGE = np.dtype(
    [(n, "i4") for n in ("body", "index", "begin", "own", "halo_first", "halo", "block_first", "blocks")]
)
"""What a thread block has of a body: own nodes [begin, begin + own) of the body, places in Halo.nodes, blocks of A."""


class Halo(NamedTuple):
    """What each thread block of each body reads.

    ranges (thread blocks,): ROW_RANGE; nodes: of the body, lists of the thread blocks one after another, its own first;
    local (blocks of A,): the column as a place in its thread block's list; first (bodies,): first share of a body.
    """

    ranges: NDArray[Any]
    nodes: Ints
    local: Ints
    first: Ints


def halo(ranges: Ints, count: Ints, row_start: NDArray[Any], columns: NDArray[Any]) -> Halo:
    """ranges (bodies, 2): nodes [first, last) of each; count (bodies,): thread blocks. Rows are cut evenly by nodes."""
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


def initial_ranges(given: BlockAssignment, seen: Halo, grid: int) -> NDArray[np.int32]:
    """The share that each thread block of the grid begins with, -1 where it takes one of the pool."""
    found = np.full(grid, -1, np.int32)
    for body in given.order[: len(given.order) - given.pooled]:
        k = np.arange(given.blocks[body])
        found[given.first[body] + k] = seen.first[body] + k
    return found
