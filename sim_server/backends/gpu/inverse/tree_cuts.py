# SPDX-License-Identifier: MIT
"""Which thresholds cut the elimination tree: those with the least predicted time of one application.

Few groups mean few phases, each with a latency, and many bytes; many groups the reverse. The constants were measured on
an H200; what matters of them is the ratio of latency to bandwidth, which is much the same on other large GPUs.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu.inverse.load_balance import PhaseWork, share
from sim_server.backends.gpu.inverse.partition import COLUMNS, ROWS, Partition, Tree, padded, partition

Ints = NDArray[np.int64]
LATENCY, LATENCY_ALONE = 3000.0, 400.0  # of a phase [ns]: between many blocks, in one block
MEMORY, CACHE, SHARED = 4400 / 132, 7000 / 132, 25000 / 132  # bandwidths of one block [bytes/ns]
CACHED = 25e6  # bytes that stay in the near half of the second-level cache
SHARED_MEMORY = 227_000  # bytes of a thread block that has a multiprocessor for itself
KEPT, X_AREA = 0.83, 0.7  # of a block's shared memory: for matrices and vectors, at most for vectors
BRING, ENTRY = 250.0, 0.4  # of a part's vector [ns]: at all, per entry
FLOPS, USES = 10e3, 3000  # making the matrices: float32 operations per ns; applications that share the cost
MOST = 9  # groups


def works(cut: Partition, blocks: int, planes: int) -> Iterator[tuple[Ints, PhaseWork]]:
    """Parts and what is to be done for each, phase by phase."""
    inside, outside = padded(cut.v, COLUMNS), padded(cut.b, COLUMNS)
    rate = _rate(cut, planes)
    for phase in range(2 * cut.groups - 1):
        group = min(phase, 2 * cut.groups - 2 - phase)
        which = np.flatnonzero(cut.group == group)
        forward, backward = phase < cut.groups - 1, phase >= cut.groups
        rows = padded(cut.b[which] if forward else cut.v[which], ROWS) // ROWS
        columns = inside[which] + outside[which] * backward
        tile = columns * (2.0 * ROWS * planes) / rate
        yield which, PhaseWork(rows, tile, BRING + ENTRY * columns)


def _rate(cut: Partition, planes: int) -> float:
    return CACHE if _bytes(cut, planes) < CACHED else MEMORY


def _bytes(cut: Partition, planes: int) -> float:
    v, b = padded(cut.v, COLUMNS).astype(float), padded(cut.b, COLUMNS).astype(float)
    return float((v * v + 2 * v * b).sum()) * 2 * planes


def estimate(cut: Partition, blocks: int, planes: int, shared: int) -> float:
    """Time of one application [ns] if all blocks had the same to do, and a share in the cost of making the matrices."""
    rate, kept, time = _rate(cut, planes), KEPT * shared, 0.0
    for which, work in works(cut, blocks, planes):
        if len(which) == 0:
            continue
        stream = work.tiles * work.tile
        busiest = max(float(stream.sum()) / blocks, float(work.tile.max()))
        shares = np.maximum(1, np.minimum(work.tiles, stream / busiest))  # blocks of each part
        bring = float((work.bring * shares).sum()) / min(blocks, float(np.ceil(shares).sum()))
        bytes_kept = min(kept, busiest * rate)
        kept -= bytes_kept
        time += bytes_kept / SHARED + (busiest - bytes_kept / rate) + bring + _latency(blocks)
    return time + _making(cut)


def predict(cut: Partition, blocks: int, planes: int, shared: int) -> float:
    """As estimate, with the work shared out as it will be."""
    rate, kept, time = _rate(cut, planes), np.full(blocks, KEPT * shared), 0.0
    for _, work in works(cut, blocks, planes):
        pieces = share(work, blocks)
        stream = np.bincount(pieces.block, pieces.tiles * work.tile[pieces.matrix], blocks)
        bring = np.bincount(pieces.block, work.bring[pieces.matrix], blocks)
        bytes_kept = np.minimum(kept, stream * rate)
        kept -= bytes_kept
        time += float((bytes_kept / SHARED + stream - bytes_kept / rate + bring).max()) + _latency(blocks)
    return time + _making(cut)


def _latency(blocks: int) -> float:
    return LATENCY_ALONE if blocks == 1 else LATENCY


def _making(cut: Partition) -> float:
    """Time of making the matrices [ns] by the applications that share it."""
    v, b = cut.v.astype(float), cut.b.astype(float)
    return float((2 / 3 * v**3 + v * v * b).sum()) / FLOPS / USES


def largest_area(cut: Partition, blocks: int) -> float:
    """Entries that one block brings in a phase, about."""
    return max(
        float(((padded(cut.v, COLUMNS) + padded(cut.b, COLUMNS))[cut.group == g]).sum()) / blocks
        for g in range(cut.groups)
    )


def candidates(tree: Tree, groups: int) -> Iterator[tuple[int, ...]]:
    """Thresholds that leave about as much to each group, geometrically spaced."""
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


def choose(tree: Tree, blocks: int, groups: int | None, planes: int, shared: int = SHARED_MEMORY) -> tuple[int, ...]:
    """Thresholds: of each number of groups the best by estimate, improved one by one, of these the best by predicted
    time. groups: so many, or as many as the tree has."""
    found: list[tuple[float, tuple[int, ...]]] = []
    for count in range(groups, 0, -1) if groups else range(1, MOST + 1):
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
    """One threshold after another a third up or down, twice."""
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
