# SPDX-License-Identifier: MIT
"""Block patterns like those of meshes of tetrahedra, and positive definite matrices on them."""

import itertools

import numpy as np
from numpy.typing import NDArray


def bar_edges(nx: int, ny: int, nz: int) -> NDArray[np.int64]:
    """Edges (e, 2) of nx x ny x nz cells, each cut into six tetrahedra along its diagonal; nodes x fastest."""

    def number(i: int, j: int, k: int) -> int:
        return (k * (ny + 1) + j) * (nx + 1) + i

    steps = [step for step in itertools.product((0, 1), repeat=3) if any(step)]
    return np.array(
        [
            (number(i, j, k), number(i + a, j + b, k + c))
            for i, j, k in itertools.product(range(nx + 1), range(ny + 1), range(nz + 1))
            for a, b, c in steps
            if i + a <= nx and j + b <= ny and k + c <= nz
        ]
    )


def pattern(nodes: int, edges: NDArray[np.int64], fixed: NDArray[np.int64] | tuple = ()) -> tuple[NDArray, NDArray]:
    """(row_start, columns) of the block rows: neighbours and the node itself; fixed nodes only themselves."""
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    free = edges[~np.isin(edges, fixed).any(axis=1)]
    diagonal = np.repeat(np.arange(nodes)[:, None], 2, axis=1)
    pairs = np.unique(np.concatenate([free, free[:, ::-1], diagonal]), axis=0)
    row_start = np.concatenate([[0], np.cumsum(np.bincount(pairs[:, 0], minlength=nodes))])
    return row_start.astype(np.int32), pairs[:, 1].astype(np.int32)


def spd(row_start: NDArray, columns: NDArray, seed: int = 0, zeros: float = 0.0) -> NDArray[np.float64]:
    """Symmetric, diagonally dominant values (blocks, 3, 3); a share of the blocks off the diagonal exactly zero."""
    random = np.random.default_rng(seed)
    nodes = len(row_start) - 1
    rows = np.repeat(np.arange(nodes), np.diff(row_start))
    dense = np.zeros((nodes, nodes, 3, 3))
    coupled = rows < columns
    upper = random.normal(size=(np.count_nonzero(coupled), 3, 3))
    upper[random.random(len(upper)) < zeros] = 0
    dense[rows[coupled], columns[coupled]] = upper
    dense += dense.transpose(1, 0, 3, 2)
    own = random.normal(size=(nodes, 3, 3))
    weight = np.abs(dense).sum(axis=(1, 3))  # (nodes, 3)
    dense[np.arange(nodes), np.arange(nodes)] = own @ own.transpose(0, 2, 1)
    dense[np.arange(nodes)[:, None], np.arange(nodes)[:, None], np.arange(3), np.arange(3)] += weight + 0.1
    return dense[rows, columns]


def dense_matrix(row_start: NDArray, columns: NDArray, values: NDArray) -> NDArray[np.float64]:
    """(3 * nodes, 3 * nodes) of block values."""
    nodes = len(row_start) - 1
    blocks = np.zeros((nodes, 3, nodes, 3))
    rows = np.repeat(np.arange(nodes), np.diff(row_start))
    blocks[rows, :, columns] = values
    return blocks.reshape(3 * nodes, 3 * nodes)


def diagonal_blocks(row_start: NDArray, columns: NDArray) -> NDArray[np.int64]:
    """Index of each node's diagonal block."""
    return np.flatnonzero(np.repeat(np.arange(len(row_start) - 1), np.diff(row_start)) == columns)


TWO_BARS = np.concatenate([bar_edges(3, 2, 4), bar_edges(2, 2, 2) + 60])
GRAPHS = {
    "bar": pattern(5 * 4 * 13, bar_edges(4, 3, 12)),
    "bar with a fixed end": pattern(5 * 4 * 13, bar_edges(4, 3, 12), np.arange(20)),
    "bars with fixed nodes": pattern(60 + 27, TWO_BARS, np.array([0, 7, 13, 61, 86])),
    "one node": pattern(1, np.empty((0, 2))),
    "two nodes": pattern(2, np.array([[0, 1]])),
    "all fixed": pattern(5, np.array([[0, 1], [1, 4]]), np.arange(5)),
    "chain": pattern(70, np.array([[i, i + 1] for i in range(69)])),
    "star": pattern(30, np.array([[11, i] for i in range(30) if i != 11])),
}
"""Patterns of all shapes, for factorizations."""
