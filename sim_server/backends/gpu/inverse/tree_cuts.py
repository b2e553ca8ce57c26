# SPDX-License-Identifier: MIT
"""Choice of the thresholds that cut the elimination tree, by the least predicted time of one application.

Few groups have few phases, each with a latency, and many bytes; many groups the reverse. The constants were measured on
an H200. The ratio of latency to bandwidth decides, and it is similar on other large GPUs.
"""

from collections.abc import Iterator

import numpy as np

from sim_server.arrays import Int64
from sim_server.backends.gpu.inverse.load_balance import PhaseWork, balance
from sim_server.backends.gpu.inverse.partition import COLUMNS, ROWS, Partition, Tree, padded, partition

LATENCY, LATENCY_ALONE = 3000.0, 400.0  # of a phase [ns]: of several blocks, of one block
MEMORY, CACHE, SHARED = 4400 / 132, 7000 / 132, 25000 / 132  # bandwidths of one block [bytes/ns]
CACHED = 25e6  # bytes that stay in the near half of the second-level cache
SHARED_MEMORY = 227_000  # bytes of a thread block that has a multiprocessor for itself
KEPT, X_AREA = 0.83, 0.7  # share of a block's shared memory: for matrices and vectors; for vectors at most
LOAD, LOAD_ENTRY = 250.0, 0.4  # time of loading the vector of a part [ns]: constant, per entry
FLOPS, USES = 10e3, 3000  # of building the inverse: float32 operations per ns; applications that share its time
MAX_GROUPS = 9


def phase_work(cut: Partition, blocks: int, planes: int) -> Iterator[tuple[Int64, PhaseWork]]:
    """Yields, phase by phase, the parts and their work."""
    inside, outside = padded(cut.v, COLUMNS), padded(cut.b, COLUMNS)
    rate = _rate(cut, planes)
    for phase in range(2 * cut.groups - 1):
        group = min(phase, 2 * cut.groups - 2 - phase)
        which = np.flatnonzero(cut.group == group)
        forward, backward = phase < cut.groups - 1, phase >= cut.groups
        rows = padded(cut.b[which] if forward else cut.v[which], ROWS) // ROWS
        columns = inside[which] + outside[which] * backward
        tile = columns * (2.0 * ROWS * planes) / rate
        yield which, PhaseWork(rows, tile, LOAD + LOAD_ENTRY * columns)


def _rate(cut: Partition, planes: int) -> float:
    return CACHE if _bytes(cut, planes) < CACHED else MEMORY


def _bytes(cut: Partition, planes: int) -> float:
    v, b = padded(cut.v, COLUMNS).astype(float), padded(cut.b, COLUMNS).astype(float)
    return float((v * v + 2 * v * b).sum()) * 2 * planes


def estimate(cut: Partition, blocks: int, planes: int, shared: int) -> float:
    """Estimates the time of one application [ns] with perfect balance, plus a share of the time of building."""
    rate, kept, time = _rate(cut, planes), KEPT * shared, 0.0
    for which, work in phase_work(cut, blocks, planes):
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
    for _, work in phase_work(cut, blocks, planes):
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


def candidates(tree: Tree, groups: int) -> Iterator[tuple[int, ...]]:
    """Yields geometrically spaced thresholds for `groups` groups."""
    if groups == 1:
        yield ()
        return
    largest = int(tree.size.max(initial=1))
    tops = np.unique(np.geomspace(30, max(31, largest - 1), 14).astype(int))
    ratios = (1.0,) if groups == 2 else (2.0, 3.0, 4.5, 7.0, 11.0)
    for top in tops.tolist():
        for ratio in ratios:
            cut = tuple(int(top / ratio**k) for k in range(groups - 2, -1, -1))
            if cut[0] >= 6:
                yield cut


def choose_thresholds(
    tree: Tree, blocks: int, groups: int | None, planes: int, shared: int = SHARED_MEMORY
) -> tuple[int, ...]:
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
