# SPDX-License-Identifier: MIT
"""What the kernels of precond_worker/gpu/multifrontal.cu compute, thread block by thread block in NumPy.

It follows the same launches (tables.py) and reads the same maps (plan.py) in the same memory of two halves. A half is
filled with NaN before it is used again, so whatever is not written, or freed too early, shows in the result.
"""

import numpy as np
from numpy.typing import NDArray

from precond_worker.gpu.assembly_tree import WIDTH
from precond_worker.gpu.plan import CHUNK, MultifrontalPlan
from precond_worker.gpu.tables import TILE, launch_list

Reals = NDArray[np.float64]


class Machine:
    """Memory of one factorization: halves of fronts, blocks (blocks, 3, 3) of A, values (nonzeros,) of L."""

    def __init__(self, plan: MultifrontalPlan, blocks: Reals):
        self.plan, self.blocks = plan, blocks
        self.halves = [np.full(size, np.nan) for size in plan.half]
        self.values = np.full(plan.nonzeros, np.nan)

    def front(self, number: int, level: int) -> Reals:
        """A front as a matrix, (rows, rows): entry [i, j] is row i of column j. Only the lower triangle counts."""
        p = self.plan
        rows, stride, at = int(p.rows[number]), int(p.stride[number]), int(p.at[number])
        return self.halves[level % 2][at : at + rows * stride].reshape(rows, stride).T[:rows]

    def assemble(self, number: int, level: int, chunk: int) -> None:
        """Columns of CHUNK nodes: entries of A, then the update matrices of the children."""
        p, front = self.plan, self.front(number, level)
        own, nodes = int(p.own[number]) // 3, int(p.rows[number]) // 3
        columns = range(CHUNK * chunk, min(CHUNK * (chunk + 1), nodes))
        front[:, 3 * columns.start : 3 * columns.stop] = 0
        for node in columns:
            if node < own:
                column = int(p.column[number]) // 3 + node
                for e in range(p.entry_start[column], p.entry_start[column + 1]):
                    row = p.entry_row[e]
                    front[3 * row : 3 * row + 3, 3 * node : 3 * node + 3] = self.blocks[p.entry_block[e]]
        for child in p.child[p.child_start[number] : p.child_start[number + 1]]:
            k = int(p.own[child])
            update = self.front(child, level - 1)[k:, k:]
            target = p.map[p.map_start[child] : p.map_start[child + 1]]
            begin, end = p.split[p.split_start[child] + chunk : p.split_start[child] + chunk + 2]
            assert all(node in columns for node in target[begin:end])
            for b in range(begin, end):
                for a in range(b, len(target)):
                    to = (slice(3 * target[a], 3 * target[a] + 3), slice(3 * target[b], 3 * target[b] + 3))
                    front[to] += update[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]

    def factor(self, number: int, level: int, step: int) -> None:
        """A diagonal block of at most WIDTH columns."""
        d, top = self._step(number, step)
        front = self.front(number, level)
        lower = np.tril(front[d:top, d:top])
        front[d:top, d:top] = np.linalg.cholesky(lower + np.tril(lower, -1).T)

    def panel(self, number: int, level: int, step: int, tile: int) -> None:
        """TILE rows under a diagonal block, divided by it."""
        d, top = self._step(number, step)
        front = self.front(number, level)
        rows = slice(top + TILE * tile, min(top + TILE * (tile + 1), len(front)))
        assert rows.start < rows.stop
        front[rows, d:top] = np.linalg.solve(np.tril(front[d:top, d:top]), front[rows, d:top].T).T

    def update(self, number: int, level: int, step: int, tile: int) -> None:
        """A tile of what is left, less the product of the panel's rows; the first goes on to the next diagonal."""
        d, top = self._step(number, step)
        front = self.front(number, level)
        i = next(i for i in range(tile + 1) if tile < (i + 1) * (i + 2) // 2)
        j = tile - i * (i + 1) // 2
        rows, columns = (slice(top + TILE * k, min(top + TILE * (k + 1), len(front))) for k in (i, j))
        assert rows.start < rows.stop and columns.start < columns.stop
        front[rows, columns] -= front[rows, d:top] @ front[columns, d:top].T
        if tile == 0 and top < self.plan.own[number]:
            self.factor(number, level, step + 1)

    def store(self, number: int, level: int, chunk: int) -> None:
        """Some columns of L to their places among the values."""
        p, front = self.plan, self.front(number, level)
        for j in range(3 * CHUNK * chunk, min(3 * CHUNK * (chunk + 1), int(p.own[number]))):
            at = int(p.value[number]) + j * len(front) - j * (j - 1) // 2
            self.values[at : at + len(front) - j] = front[j:, j]

    def _step(self, number: int, step: int) -> tuple[int, int]:
        """First column of a step, and the one after its last."""
        own = int(self.plan.own[number])
        assert WIDTH * step < own
        return WIDTH * step, min(WIDTH * (step + 1), own)


def factorize(plan: MultifrontalPlan, blocks: Reals) -> Reals:
    """Values of L in the order of the pattern, (nonzeros,), of block values (blocks, 3, 3)."""
    machine = Machine(plan, blocks)
    listed, starts = launch_list(plan)
    level = -1
    for launch in listed:
        if launch.level != level:
            level = launch.level
            machine.halves[level % 2][:] = np.nan
        first = int(plan.level_start[level])
        start = starts[launch.table : launch.table + launch.fronts + 1]
        for block in range(launch.blocks):
            if launch.kernel == "factor":
                machine.factor(first + block, level, 0)
                continue
            which = int(np.searchsorted(start, block, side="right")) - 1
            within = block - int(start[which])
            if launch.kernel in ("assemble", "store"):
                getattr(machine, launch.kernel)(first + which, level, within)
            else:
                getattr(machine, launch.kernel)(first + which, level, launch.step, within)
    return machine.values
