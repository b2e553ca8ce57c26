# SPDX-License-Identifier: MIT
"""The multifrontal method on a plan (precond_worker/gpu/plan.py), front by front in NumPy: what the GPU computes.

It reads the same maps as the kernels, in the same memory of two halves, filled with NaN at first and after each use:
whatever the plan forgets to write, or frees too early, shows in the result.
"""

import numpy as np
from numpy.typing import NDArray

from precond_worker.gpu.plan import CHUNK, Plan


def factorize(plan: Plan, blocks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of L in the order of the pattern, (nonzeros,), of block values (blocks, 3, 3)."""
    halves = [np.full(size, np.nan) for size in plan.half]
    values = np.full(plan.nonzeros, np.nan)
    for level in range(plan.levels):
        fronts = range(plan.level_start[level], plan.level_start[level + 1])
        halves[level % 2][:] = np.nan
        for front in fronts:
            assemble(plan, front, halves[level % 2], halves[1 - level % 2], blocks)
        for front in fronts:
            matrix = view(plan, front, halves[level % 2])
            eliminate(matrix, int(plan.own[front]))
            store(plan, front, matrix, values)
    return values


def view(plan: Plan, front: int, half: NDArray[np.float64]) -> NDArray[np.float64]:
    """A front as a matrix, (rows, rows): entry [i, j] is row i of column j."""
    rows, stride, at = int(plan.rows[front]), int(plan.stride[front]), int(plan.at[front])
    return half[at : at + rows * stride].reshape(rows, stride).T[:rows]


def assemble(
    plan: Plan, front: int, here: NDArray[np.float64], there: NDArray[np.float64], blocks: NDArray[np.float64]
) -> None:
    """Entries of A and the children's update matrices, chunk by chunk of columns; only the lower triangle is right."""
    matrix = view(plan, front, here)
    own, nodes = int(plan.own[front]) // 3, int(plan.rows[front]) // 3
    for chunk in range(-(-nodes // CHUNK)):
        columns = range(CHUNK * chunk, min(CHUNK * (chunk + 1), nodes))
        matrix[:, 3 * columns.start : 3 * columns.stop] = 0
        for node in columns:
            if node < own:
                column = int(plan.column[front]) // 3 + node
                for e in range(plan.entry_start[column], plan.entry_start[column + 1]):
                    row = plan.entry_row[e]
                    matrix[3 * row : 3 * row + 3, 3 * node : 3 * node + 3] = blocks[plan.entry_block[e]]
        for child in plan.child[plan.child_start[front] : plan.child_start[front + 1]]:
            k = int(plan.own[child])
            update = view(plan, child, there)[k:, k:]
            target = plan.map[plan.map_start[child] : plan.map_start[child + 1]]
            begin, end = plan.split[plan.split_start[child] + chunk : plan.split_start[child] + chunk + 2]
            assert all(node in columns for node in target[begin:end])
            for b in range(begin, end):
                for a in range(b, len(target)):
                    to = (slice(3 * target[a], 3 * target[a] + 3), slice(3 * target[b], 3 * target[b] + 3))
                    matrix[to] += update[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]


def eliminate(matrix: NDArray[np.float64], own: int) -> None:
    """Partial Cholesky factorization in place, reading the lower triangle alone."""
    for j in range(own):
        matrix[j:, j] /= np.sqrt(matrix[j, j])
        matrix[j + 1 :, j + 1 :] -= np.outer(matrix[j + 1 :, j], matrix[j + 1 :, j])


def store(plan: Plan, front: int, matrix: NDArray[np.float64], values: NDArray[np.float64]) -> None:
    """The front's columns of L to their place among the values."""
    at = int(plan.value[front])
    for j in range(int(plan.own[front])):
        length = len(matrix) - j
        values[at : at + length] = matrix[j:, j]
        at += length
