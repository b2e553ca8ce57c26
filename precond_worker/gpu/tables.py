# SPDX-License-Identifier: MIT
"""The kernel launches of a factorization, and for each launch the first thread block of each front."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Int32, Int64
from precond_worker.gpu.assembly_tree import WIDTH
from precond_worker.gpu.plan import CHUNK, MultifrontalPlan

TILE = 64
FRONT = np.dtype(
    [(name, "i8") for name in ("at", "value", "child", "map", "split")]
    + [(name, "i4") for name in ("own", "rows", "stride", "column", "children", "unused")]
)  # struct Front in multifrontal.cu


class KernelLaunch(NamedTuple):
    """kernel: name; level, step: of the fronts; table: offset of its starts; fronts, blocks: their numbers."""

    kernel: str
    level: int
    step: int
    table: int
    fronts: int
    blocks: int


def front_table(plan: MultifrontalPlan) -> NDArray[np.void]:
    """Returns the fronts as the kernels read them, (f,)."""
    table = np.zeros(len(plan.own), FRONT)
    table["at"], table["value"], table["own"], table["rows"] = plan.at, plan.value, plan.own, plan.rows
    table["child"], table["map"], table["split"] = plan.child_start[:-1], plan.map_start[:-1], plan.split_start
    table["stride"], table["column"] = plan.stride, plan.column
    table["children"] = np.diff(plan.child_start)
    return table


def launch_list(plan: MultifrontalPlan) -> tuple[list[KernelLaunch], Int32]:
    """Returns the launches of a factorization in their order, and the starts that they read.

    Per level: assembly, the first diagonal blocks, then panel and update step by step, and the copy of L (store).
    """
    result: list[KernelLaunch] = []
    tables: list[Int64] = []
    filled = 0

    def add(kernel: str, level: int, step: int, counts: Int64) -> None:
        nonlocal filled
        start = np.concatenate([[0], np.cumsum(counts)])
        if start[-1] == 0:
            return
        result.append(KernelLaunch(kernel, level, step, filled, len(counts), int(start[-1])))
        tables.append(start)
        filled += len(start)

    for level in range(plan.levels):
        own, rows = plan.own[plan.fronts(level)], plan.rows[plan.fronts(level)]
        add("assemble", level, 0, -(-rows // (3 * CHUNK)))
        result.append(KernelLaunch("factor", level, 0, 0, len(own), len(own)))
        for step in range(plan.steps(level)):
            active = own > WIDTH * step  # the first ones, as they are sorted
            below = (rows - np.minimum(own, WIDTH * (step + 1)))[active]
            tiles = -(-below // TILE)
            add("panel", level, step, tiles)
            add("update", level, step, tiles * (tiles + 1) // 2)
        add("store", level, 0, -(-own // (3 * CHUNK)))
    return result, np.concatenate(tables).astype(np.int32)
