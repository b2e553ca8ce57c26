# SPDX-License-Identifier: MIT
"""Partitions of an elimination tree, their predicted times and the balance of their work, in NumPy and plain Python.

What sim_server/backends/gpu/inverse/tree_cuts.cpp computes, written for reading instead of speed.
"""

from collections.abc import Callable, Iterator

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.backends.gpu.inverse.load_balance import PhaseWork, TilePartition
from sim_server.backends.gpu.inverse.partition import COLUMNS, ROWS, Partition, Tree, padded
from sim_server.backends.gpu.inverse.tree_cuts import MAX_GROUPS, candidates

LATENCY, LATENCY_ALONE = 3000.0, 400.0  # of a phase [ns]: of several blocks, of one block
MEMORY, CACHE, SHARED = 4400 / 132, 7000 / 132, 25000 / 132  # bandwidths of one block [bytes/ns]
CACHED = 25e6  # bytes that stay in the near half of the second-level cache
KEPT, X_AREA = 0.83, 0.7  # share of a block's shared memory: for matrices and vectors; for vectors at most
LOAD, LOAD_ENTRY = 250.0, 0.4  # time of loading the vector of a part [ns]: constant, per entry
LARGE, TILE = 100e6, 35.0  # bytes of matrices that no cache keeps; constant time of a tile of theirs [ns]
FLOPS, USES = 10e3, 3000  # of building the inverse: float32 operations per ns; applications that share its time
CUT_GAIN = 1.1  # matrices are cut anywhere only if whole ones take this many times as long
MANY = 8  # matrices per block above which whole ones balance well enough


def partition(tree: Tree, thresholds: tuple[int, ...]) -> Partition:
    """Cuts the tree where the degrees of freedom of a subtree exceed one of the ascending thresholds.

    Parts without a boundary (whole trees, or their tops) are in the last group.
    """
    groups = len(thresholds) + 1
    level = np.searchsorted(np.asarray(thresholds), tree.size, side="left")
    label = np.arange(len(level)).tolist()
    parent, levels = tree.parent.tolist(), level.tolist()
    for s in range(len(parent) - 1, -1, -1):
        if parent[s] >= 0 and levels[s] == levels[parent[s]]:
            label[s] = label[parent[s]]
    root, part = np.unique(label, return_inverse=True)  # a part is named after its root
    b = (tree.height - tree.width)[root]
    v = np.bincount(part, tree.width, len(root)).astype(np.int64)
    group = np.where(b == 0, groups - 1, level[root])
    joined = _join_small(v, b)
    part, v = joined[part], np.bincount(joined, v).astype(np.int64)
    keep = np.unique(joined, return_index=True)[1]
    root, b, group = root[keep], b[keep], group[keep]
    order = np.argsort(group, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return Partition(groups, rank[part], group[order], root[order], v[order], b[order])


def _join_small(v: Int64, b: Int64) -> Int64:
    """Returns a new number for each part; trees of a few nodes (e.g. fixed ones) share a part of one chunk's width."""
    label, small = np.arange(len(v)), np.flatnonzero((b == 0) & (v <= COLUMNS // 2))
    room, home = 0, -1
    for s in small.tolist():
        if v[s] > room:
            room, home = COLUMNS, s
        room -= int(v[s])
        label[s] = home
    return np.unique(label, return_inverse=True)[1]


def phase_work(cut: Partition, planes: int) -> Iterator[tuple[Int64, PhaseWork]]:
    """Yields, phase by phase, the parts and their work."""
    inside, outside = padded(cut.v, COLUMNS), padded(cut.b, COLUMNS)
    rate = _rate(cut, planes)
    for phase in range(2 * cut.groups - 1):
        group = min(phase, 2 * cut.groups - 2 - phase)
        which = np.flatnonzero(cut.group == group)
        forward, backward = phase < cut.groups - 1, phase >= cut.groups
        rows = padded(cut.b[which] if forward else cut.v[which], ROWS) // ROWS
        columns = inside[which] + outside[which] * backward
        tile = columns * (2.0 * ROWS * planes) / rate + (TILE if _bytes(cut, planes) > LARGE else 0)
        yield which, PhaseWork(rows, tile, LOAD + LOAD_ENTRY * columns)


def _rate(cut: Partition, planes: int) -> float:
    return CACHE if _bytes(cut, planes) < CACHED else MEMORY


def _bytes(cut: Partition, planes: int) -> float:
    v, b = padded(cut.v, COLUMNS).astype(float), padded(cut.b, COLUMNS).astype(float)
    return float((v * v + 2 * v * b).sum()) * 2 * planes


def estimate(cut: Partition, blocks: int, planes: int, shared: int) -> float:
    """Estimates the time of one application [ns] with perfect balance, plus a share of the time of building."""
    rate, kept, time = _rate(cut, planes), KEPT * shared, 0.0
    for which, work in phase_work(cut, planes):
        if len(which) == 0:
            continue
        stream = work.tiles * work.tile
        busiest = max(float(stream.sum()) / blocks, float(work.tile.max()))
        shares = np.maximum(1, np.minimum(work.tiles, stream / busiest))  # blocks of each part
        load = float((work.load * shares).sum()) / min(blocks, float(np.ceil(shares).sum()))
        bytes_kept = min(kept, busiest * rate)
        kept -= bytes_kept
        time += bytes_kept / SHARED + (busiest - bytes_kept / rate) + load + _latency(blocks)
    return time + _build_time(cut)


def predict(cut: Partition, blocks: int, planes: int, shared: int) -> float:
    """Predicts the same time with the actual partition of the work."""
    rate, kept, time = _rate(cut, planes), np.full(blocks, KEPT * shared), 0.0
    for _, work in phase_work(cut, planes):
        pieces = balance(work, blocks)
        stream = np.bincount(pieces.block, pieces.tiles * work.tile[pieces.matrix], blocks)
        load = np.bincount(pieces.block, work.load[pieces.matrix], blocks)
        bytes_kept = np.minimum(kept, stream * rate)
        kept -= bytes_kept
        time += float((bytes_kept / SHARED + stream - bytes_kept / rate + load).max()) + _latency(blocks)
    return time + _build_time(cut)


def _latency(blocks: int) -> float:
    return LATENCY_ALONE if blocks == 1 else LATENCY


def _build_time(cut: Partition) -> float:
    """Returns the time of building the inverse [ns], divided by the applications that share it."""
    v, b = cut.v.astype(float), cut.b.astype(float)
    return float((2 / 3 * v**3 + v * v * b).sum()) / FLOPS / USES


def largest_area(cut: Partition, blocks: int) -> float:
    """Returns about the largest number of entries that one block loads in a phase."""
    return max(
        float(((padded(cut.v, COLUMNS) + padded(cut.b, COLUMNS))[cut.group == g]).sum()) / blocks
        for g in range(cut.groups)
    )


def choose_thresholds(tree: Tree, blocks: int, groups: int | None, planes: int, shared: int) -> tuple[int, ...]:
    """Returns the thresholds: the best estimate for each number of groups, improved, and of these the best prediction.

    groups: the number of groups, or fewer if the tree does not have so many; None: any number up to MAX_GROUPS.
    """
    found: list[tuple[float, tuple[int, ...]]] = []
    for count in range(groups, 0, -1) if groups else range(1, MAX_GROUPS + 1):
        estimated = [(_estimate(tree, t, blocks, planes, shared), t) for t in candidates(tree, count)]
        best = min(estimated, default=(np.inf, ()))
        if best[0] < np.inf:
            found.append(best)
            if groups:
                break
        if not groups and best[0] > 1.5 * min(found)[0]:
            break  # more phases do not help any more
    near = [_improved(tree, pair, blocks, planes, shared) for pair in found if pair[0] < 1.3 * min(found)[0]]
    return min((predict(partition(tree, t), blocks, planes, shared), t) for _, t in near)[1]


def _improved(
    tree: Tree, best: tuple[float, tuple[int, ...]], blocks: int, planes: int, shared: int
) -> tuple[float, tuple[int, ...]]:
    """Improves an estimate by changing one threshold after another by a third up or down, twice."""
    for k in [*range(len(best[1]))] * 2:
        for factor in (0.75, 1.33):
            moved = list(best[1])
            moved[k] = int(moved[k] * factor)
            if moved == sorted(set(moved)):
                best = min(best, (_estimate(tree, tuple(moved), blocks, planes, shared), tuple(moved)))
    return best


def _estimate(tree: Tree, thresholds: tuple[int, ...], blocks: int, planes: int, shared: int) -> float:
    cut = partition(tree, thresholds)
    if cut.groups > 1 and len(np.unique(cut.group)) < cut.groups:
        return np.inf
    time = estimate(cut, blocks, planes, shared)
    return time * 10 if 4 * largest_area(cut, blocks) > X_AREA * shared else time


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
