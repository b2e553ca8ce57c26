# SPDX-License-Identifier: MIT
"""Statics and frequencies of quadratic tetrahedra at small strains, in sparse matrices of SciPy."""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh, splu

from sim_server.mesh.strain_cells import StrainCells

HALF = 0.5**0.5  # for shears, so that the squares of the six components sum to |e|^2


def stiffness(cells: StrainCells, nodes: int, young: float, poisson: float) -> sp.csc_array:
    """K (3 n, 3 n) [N/m] of quadratic elements: lambda up to mu at each cell, the rest on the mean of its patch."""
    mu, lam = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    own = min(lam, mu)
    m = len(cells.volume)
    strain = _strains(cells, nodes)
    dilatation = sp.kron(sp.eye_array(m), np.array([[1.0, 1, 1, 0, 0, 0]])).tocsr() @ strain
    theta = sp.csr_array((cells.volume, (cells.patch, np.arange(m)))) @ dilatation
    matrix = 2 * mu * strain.T @ sp.diags_array(np.repeat(cells.volume, 6)) @ strain
    matrix += own * dilatation.T @ sp.diags_array(cells.volume) @ dilatation
    matrix += (lam - own) * theta.T @ sp.diags_array(1 / np.bincount(cells.patch, cells.volume)) @ theta
    return sp.csc_array(matrix)


def _strains(cells: StrainCells, nodes: int) -> sp.csr_array:
    """Six components of the small strain of each cell from displacements, (6 m, 3 n)."""
    owner = np.repeat(np.arange(len(cells.volume)), np.diff(cells.start))
    rows, columns, values = [], [], []
    for row, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))):
        for a, b in {(i, j), (j, i)}:
            rows.append(6 * owner + row)
            columns.append(3 * cells.nodes + a)
            values.append((1.0 if i == j else HALF) * cells.gradients[:, b])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sp.csr_array(entries, shape=(6 * len(cells.volume), 3 * nodes))


def displacement(matrix: sp.csc_array, force: NDArray, free: NDArray) -> NDArray[np.float64]:
    """Static displacement (n, 3) [m] under forces (n, 3) [N], with other nodes than `free` (n,) held."""
    keep = np.flatnonzero(np.repeat(free, 3))
    out = np.zeros(force.size)
    out[keep] = splu(matrix[keep][:, keep].tocsc()).solve(force.ravel()[keep])
    return out.reshape(-1, 3)


def frequencies(matrix: sp.csc_array, mass: NDArray, free: NDArray, count: int) -> NDArray[np.float64]:
    """The lowest frequencies [Hz] with lumped masses (n,) [kg]."""
    keep = np.flatnonzero(np.repeat(free, 3))
    lumped = sp.diags_array(np.repeat(mass, 3)[keep])
    squares = eigsh(matrix[keep][:, keep], count, lumped, sigma=0.0, which="LM", return_eigenvectors=False)
    return np.sqrt(np.sort(squares)) / (2 * np.pi)
