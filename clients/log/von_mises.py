# SPDX-License-Identifier: MIT
"""Von Mises stress of linear corotational elasticity, for colours and export."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


class StressField:
    """Von Mises stress of a mesh, averaged to its nodes with the rest volumes as weights.

    With the polar decomposition F = R S of a tet's deformation gradient, the stress is
    R (2 mu (S - I) + lambda tr(S - I) I) R^T. Its von Mises value needs neither R nor lambda: with s the eigenvalues
    of S, which are the singular values of F (the smallest one negative where a tet is inverted), it is
    2 mu sqrt(((s1-s2)^2 + (s2-s3)^2 + (s3-s1)^2) / 2).

    rest (n, 3) [m], tets (m, 4), young (m,) [Pa], poisson (m,); nodes: if given, only tets that touch these count.
    """

    def __init__(
        self, rest: Float64, tets: NDArray, young: NDArray, poisson: NDArray, nodes: NDArray | None = None
    ) -> None:
        used = np.isin(tets, nodes).any(axis=1) if nodes is not None else np.ones(len(tets), bool)
        edges = _edges(rest, tets[used])
        volumes = np.abs(np.linalg.det(edges)) / 6
        solid = volumes > 0  # a flat tet has no deformation gradient
        self._tets = tets[used][solid]
        self._inverse = np.linalg.inv(edges[solid])
        self._volumes = volumes[solid]
        self._mu = (np.asarray(young, np.float64) / (2 * (1 + np.asarray(poisson, np.float64))))[used][solid]
        self._weight = np.bincount(self._tets.ravel(), np.repeat(self._volumes, 4), len(rest))

    def tets(self, x: Float64) -> Float64:
        """Returns the von Mises stress [Pa] of every tet that counts, for positions x (n, 3) [m]."""
        gradient = _edges(x, self._tets) @ self._inverse
        s = np.linalg.svd(gradient, compute_uv=False)  # descending
        s[:, 2] *= np.where(np.linalg.det(gradient) < 0, -1.0, 1.0)
        differences = (s[:, 0] - s[:, 1]) ** 2 + (s[:, 1] - s[:, 2]) ** 2 + (s[:, 2] - s[:, 0]) ** 2
        return 2 * self._mu * np.sqrt(differences / 2)

    def nodes(self, x: Float64) -> Float64:
        """Returns the von Mises stress [Pa] at every node (n,); 0 where no tet that counts touches it."""
        stress = np.repeat(self.tets(x) * self._volumes, 4)
        total = np.bincount(self._tets.ravel(), stress, len(self._weight))
        return np.divide(total, self._weight, out=np.zeros(len(total)), where=self._weight > 0)


def _edges(points: Float64, tets: NDArray) -> Float64:
    """Returns the edge vectors from node 0 of each tet as columns, (m, 3, 3)."""
    corners = points[tets]
    return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
