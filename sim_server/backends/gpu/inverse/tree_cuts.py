# SPDX-License-Identifier: MIT
"""Choice of the thresholds that cut the elimination tree, by the least predicted time of one application.

Few groups have few phases, each with a latency, and many bytes; many groups the reverse. Times are predicted by native
code (tree_cuts.cpp, which has the constants): hundreds of thresholds are compared for each topology.
"""

from collections.abc import Iterator

import numpy as np

from sim_server.arrays import Int64
from sim_server.backends.gpu.inverse.load_balance import PhaseWork
from sim_server.backends.gpu.inverse.partition import Partition, Tree, library, tree_arguments

SHARED_MEMORY = 227_000  # bytes of a thread block that has a multiprocessor for itself
MAX_GROUPS = 9


def phase_work(cut: Partition, planes: int) -> Iterator[tuple[Int64, PhaseWork]]:
    """Yields, phase by phase, the parts and their work."""
    parts, arrays = len(cut.v), (cut.group, cut.v, cut.b)
    for phase in range(2 * cut.groups - 1):
        which = np.flatnonzero(cut.group == min(phase, 2 * cut.groups - 2 - phase))
        work = PhaseWork(np.empty(len(which), np.int64), np.empty(len(which)), np.empty(len(which)))
        library().tree_phase(
            cut.groups, parts, *(a.ctypes.data for a in arrays), phase, planes, *(a.ctypes.data for a in work)
        )
        yield which, work


def predict(tree: Tree, thresholds: tuple[int, ...], blocks: int, planes: int, shared: int) -> float:
    """Predicts the time of one application [ns], plus a share of the time of building, with the work balanced."""
    return float(library().tree_predict(*tree_arguments(tree, thresholds), blocks, planes, shared))


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
    return min((predict(tree, t, blocks, planes, shared), t) for _, t in near)[1]


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
    """Estimates the same time with perfect balance; infinite where the tree has fewer groups."""
    return float(library().tree_estimate(*tree_arguments(tree, thresholds), blocks, planes, shared))
