# SPDX-License-Identifier: MIT
"""Corotational strain cells in patches, cell by cell in plain NumPy: slow, and meant to be obviously right.

W = sum_c V (mu |S - I|^2 + lambda_c / 2 tr(S - I)^2) + sum_p kappa / 2 V_p theta_p^2 (effects/_cells.py); kappa of a
patch is the mean by volume.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_server.mesh.strain_cells import DEVIATOR, DILATATION, StrainCells
from tests.reference.corotational import nearest_rotation

Array = NDArray[np.float64]


@dataclass
class CellSolid:
    """A body: its cells, young and poisson (tets,) of its tetrahedra.

    points: cells are points of quadratic elements
    """

    cells: StrainCells
    young: Array
    poisson: Array
    points: bool = False

    @property
    def mu(self) -> Array:
        """Of the cells [Pa]."""
        return (self.young / (2 * (1 + self.poisson)))[self.cells.element] * self.cells.has(DEVIATOR)

    @property
    def volume(self) -> Array:
        """Of the cells, as far as they have a dilatation [m3]."""
        return self.cells.volume * self.cells.has(DILATATION)

    @property
    def own(self) -> Array:
        """lambda_c of the cells [Pa]."""
        whole = (self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson)))[self.cells.element]
        return np.minimum(whole, self.mu) if self.points else -2 / 3 * self.mu

    @property
    def patch_volume(self) -> Array:
        return np.bincount(self.cells.patch, self.volume)

    @property
    def kappa(self) -> Array:
        """Of the patches [Pa]."""
        of_cells = (self.young / (3 * (1 - 2 * self.poisson)))[self.cells.element] - 2 / 3 * self.mu - self.own
        return np.bincount(self.cells.patch, of_cells * self.volume) / self.patch_volume

    def of(self, c: int) -> tuple[NDArray, Array]:
        """Nodes and gradients of a cell."""
        here = slice(self.cells.start[c], self.cells.start[c + 1])
        return self.cells.nodes[here], self.cells.gradients[here]

    def polar(self, x: Array, c: int) -> tuple[Array, Array]:
        nodes, g = self.of(c)
        F = x[nodes].T @ g
        R = nearest_rotation(F)
        return R, R.T @ F

    def theta(self, x: Array) -> Array:
        """Of the patches [-]."""
        cells = self.cells
        trace = np.array([np.trace(self.polar(x, c)[1]) - 3 for c in range(len(cells.volume))])
        return np.bincount(cells.patch, self.volume * trace) / self.patch_volume

    def energy(self, x: Array) -> float:
        total = 0.5 * (self.kappa * self.patch_volume * self.theta(x) ** 2).sum()
        for c, (V, mu, own) in enumerate(zip(self.cells.volume, self.mu, self.own, strict=True)):
            E = self.polar(x, c)[1] - np.eye(3)
            total += V * (mu * (E**2).sum() + own / 2 * np.trace(E) ** 2)
        return float(total)

    def forces(self, x: Array) -> Array:
        """(n, 3)."""
        f, theta, kappa, own = np.zeros_like(x), self.theta(x), self.kappa, self.own
        for c, (V, mu, p) in enumerate(zip(self.cells.volume, self.mu, self.cells.patch, strict=True)):
            (nodes, g), (R, S) = self.of(c), self.polar(x, c)
            E = S - np.eye(3)
            pressure = kappa[p] * theta[p] * (self.volume[c] > 0) + own[c] * np.trace(E)
            f[nodes] -= V * g @ (R @ (2 * mu * E + pressure * np.eye(3))).T
        return f

    def tangent(self, x: Array, exact: bool, least: float = 0.0) -> Array:
        """-df/dx with R held, or, if exact, turning, with eigenvalues of the twists not below least; (3 n, 3 n)."""
        K, theta, kappa, own = np.zeros((x.size, x.size)), self.theta(x), self.kappa, self.own
        g_p = np.zeros((self.cells.patches, x.size))
        for c, (V, mu, p) in enumerate(zip(self.cells.volume, self.mu, self.cells.patch, strict=True)):
            (nodes, g), (R, _) = self.of(c), self.polar(x, c)
            dofs = (3 * nodes[:, None] + np.arange(3)).ravel()
            dF = np.einsum("il,kj->ijkl", np.eye(3), g).reshape(9, -1)  # dF_ij / dx_kl
            U, s, Vt = np.linalg.svd(x[nodes].T @ g)
            sign = np.sign(np.linalg.det(U @ Vt))
            U[:, 2] *= sign
            s[2] *= sign
            r = R.ravel()
            sym = _symmetric_part(R)
            H = 2 * mu * sym.T @ sym + own[c] * np.outer(r, r)
            if exact:
                pressure = kappa[p] * theta[p] * (self.volume[c] > 0) + own[c] * (s.sum() - 3)
                for a, b in ((0, 1), (1, 2), (0, 2)):
                    t = (np.outer(U[:, a], Vt[b]) - np.outer(U[:, b], Vt[a])).ravel() / np.sqrt(2)
                    H += max(2 * mu + (pressure - 2 * mu) * 2 / (s[a] + s[b]), least) * np.outer(t, t)
            K[np.ix_(dofs, dofs)] += V * dF.T @ H @ dF
            g_p[p, dofs] += self.volume[c] * (r @ dF)
        for p, row in enumerate(g_p):
            K += kappa[p] / self.patch_volume[p] * np.outer(row, row)
        return K


def _symmetric_part(R: Array) -> Array:
    """The map from dF to the symmetric part of R^T dF, in the world's frame of rows: (9, 9), a projection."""
    to_frame = np.kron(R.T, np.eye(3))
    swap = np.eye(9).reshape(3, 3, 3, 3).transpose(1, 0, 2, 3).reshape(9, 9)
    return 0.5 * (np.eye(9) + swap) @ to_frame
