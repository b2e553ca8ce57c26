# SPDX-License-Identifier: MIT
"""The inf-sup constant of strain cells and patches: how well displacements see the pressures of patches.

Source: Chapelle and Bathe, The inf-sup test, 1993.
"""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from sim_server.mesh.strain_cells import StrainCells
from tests.reference.quadratic import strains

Array = NDArray[np.float64]
Apply = Callable[[Array], Array]


def schur_complement(cells: StrainCells, held: NDArray[np.bool_]) -> tuple[Apply, Array]:
    """q -> W^-1/2 B S^-1 B^T W^-1/2 q, and its null vector of a body whose surface lets no volume through.

    S: integral of |e|^2, B: change of volume of the patches, W: their volumes; held: components that are zero (n, 3)
    """
    m, free = len(cells.volume), np.flatnonzero(~held.ravel())
    strain = strains(cells, len(held))[:, free]
    trace = sp.kron(sp.eye_array(m), np.array([[1.0, 1, 1, 0, 0, 0]])).tocsr() @ strain
    volume = np.bincount(cells.patch, cells.volume)
    B = sp.csr_array((cells.volume / np.sqrt(volume[cells.patch]), (cells.patch, np.arange(m)))) @ trace
    S = splu(sp.csc_array(strain.T @ sp.diags_array(np.repeat(cells.volume, 6)) @ strain))
    transposed = sp.csr_array(B.T)

    def apply(q: Array) -> Array:
        return np.asarray(B @ S.solve(transposed @ q))

    return apply, np.sqrt(volume / volume.sum())


def inf_sup(cells: StrainCells, held: NDArray[np.bool_]) -> float:
    """Returns the smallest singular value of pressures other than the constant one; 1 is the largest there can be."""
    apply, constant = schur_complement(cells, held)
    size = len(constant)
    operator = LinearOperator((size, size), lambda q: apply(q.ravel()) + constant * (constant @ q.ravel()), dtype=float)
    least = eigsh(operator, 1, which="SA", tol=1e-3, v0=np.cos(np.arange(size)), return_eigenvectors=False)[0]
    return float(np.sqrt(max(least, 0.0)))


def unseen(cells: StrainCells, held: NDArray[np.bool_]) -> int:
    """Returns how many independent pressures make no force at all, the constant one among them."""
    apply, constant = schur_complement(cells, held)
    return int((np.linalg.eigvalsh(apply(np.eye(len(constant)))) < 1e-9).sum())
