# SPDX-License-Identifier: MIT
"""Preconditioned conjugate gradients as in the book (Saad, 2nd edition, algorithm 9.1), with every iterate kept."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Operator = Callable[[Array], Array]


def pcg(A: Any, b: Array, solve: Operator, tolerance: float, most: int, x: Array | None = None) -> list[Array]:
    """Iterates x_0, x_1, ... until |b - A x| <= tolerance |b| or `most` iterations. solve: r -> P^-1 r."""
    x = np.zeros_like(b) if x is None else x.copy()
    iterates = [x.copy()]
    r = b - A @ x
    z = solve(r)
    p, rz = z.copy(), r @ z
    while np.linalg.norm(r) > tolerance * np.linalg.norm(b) and len(iterates) <= most:
        q = A @ p
        alpha = rz / (p @ q)
        x = x + alpha * p
        r = r - alpha * q
        iterates.append(x.copy())
        z = solve(r)
        beta = (r @ z) / rz
        rz = r @ z
        p = z + beta * p
    return iterates


def jacobi(A: Any) -> Operator:
    """Division by the diagonal."""
    diagonal = A.diagonal()
    return lambda r: r / diagonal


def block_jacobi(A: Any) -> Operator:
    """Solves with the 3x3 blocks on the diagonal."""
    dense = A.toarray() if hasattr(A, "toarray") else A
    nodes = len(dense) // 3
    blocks = np.array([dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(nodes)])
    return lambda r: np.linalg.solve(blocks, r.reshape(-1, 3, 1)).ravel()
