# SPDX-License-Identifier: MIT
"""Springs between nodes, one by one in plain NumPy: slow, and meant to be obviously right."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass
class Net:
    """ends (m, 2); stiffness k, length l0 (m,); x, v (n, 3); mass, free (n,); h: time step; beta: Rayleigh damping of
    the stiffness."""

    ends: NDArray[np.int32]
    stiffness: Array
    length: Array
    x: Array
    v: Array
    mass: Array
    free: Array
    h: float
    beta: float = 0.0

    def energy(self) -> float:
        """sum k (l - l0)^2 / 2."""
        return sum(
            0.5 * k * (np.linalg.norm(self.x[j] - self.x[i]) - l0) ** 2
            for (i, j), k, l0 in zip(self.ends, self.stiffness, self.length, strict=True)
        )

    def forces(self) -> Array:
        """k (l - l0) u on the first end, the opposite on the second, (n, 3)."""
        f = np.zeros_like(self.x)
        for (i, j), k, l0 in zip(self.ends, self.stiffness, self.length, strict=True):
            d = self.x[j] - self.x[i]
            pull = k * (np.linalg.norm(d) - l0) * d / np.linalg.norm(d)
            f[i] += pull
            f[j] -= pull
        return f

    def tangent(self, clamped: bool = True) -> Array:
        """sum K with K = k [u u^T + c (I - u u^T)], c = 1 - l0 / l, not below 0 if clamped: (3 n, 3 n)."""
        K = np.zeros((self.x.size, self.x.size))
        for (i, j), k, l0 in zip(self.ends, self.stiffness, self.length, strict=True):
            d = self.x[j] - self.x[i]
            along = np.outer(d, d) / (d @ d)
            across = 1 - l0 / np.linalg.norm(d)
            if clamped:
                across = max(0.0, across)
            block = k * (along + across * (np.eye(3) - along))
            for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                K[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += sign * block
        return K

    def matrix(self, clamped: bool = True) -> Array:
        """A = M + h (h + beta) sum K; rows and columns of fixed nodes are the identity's."""
        A = np.diag(np.repeat(self.mass, 3)) + self.h * (self.h + self.beta) * self.tangent(clamped)
        held = np.repeat(self.free, 3) == 0
        A[held] = 0
        A[:, held] = 0
        A[held, held] = 1
        return A

    def right_side(self) -> Array:
        """b = h f - h (h + beta) K v, (n, 3)."""
        Kv = (self.tangent() @ self.v.ravel()).reshape(-1, 3)
        return self.h * self.forces() - self.h * (self.h + self.beta) * Kv
