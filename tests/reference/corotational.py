# SPDX-License-Identifier: MIT
"""Corotational linear tetrahedra, element by element in plain NumPy: slow, and meant to be obviously right.

f_e = -R K_e (R^T x_e - X_e) with K_e = V B^T D B in Voigt's notation and R the rotation nearest to F, by SVD.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def nearest_rotation(F: Array) -> Array:
    """argmax of tr(R^T F) over proper rotations, (3, 3)."""
    U, _, Vt = np.linalg.svd(F)
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    return U @ Vt


def frame(x: Array) -> Array:
    """Axes, in columns, of edge 01 and face 012 of a tetrahedron with corners (4, 3)."""
    first = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
    across = np.cross(x[1] - x[0], x[2] - x[0])
    third = across / np.linalg.norm(across)
    return np.column_stack([first, np.cross(third, first), third])


def turned_frame(x: Array, X: Array) -> Array:
    """Rotation of that frame from rest to now (Nesme, Payan, Faure 2005), (3, 3)."""
    return frame(x) @ frame(X).T


def deformation(x: Array, X: Array) -> Array:
    """F of a tetrahedron from its corners (4, 3) now and at rest."""
    return (x[1:] - x[0]).T @ np.linalg.inv((X[1:] - X[0]).T)


def volume(X: Array) -> float:
    return float(np.linalg.det(X[1:] - X[0])) / 6


def hooke(young: float, poisson: float) -> Array:
    """D (6, 6) for the strains xx, yy, zz, xy, yz, zx, the last three doubled."""
    lam = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    mu = young / (2 * (1 + poisson))
    D = np.diag([2 * mu, 2 * mu, 2 * mu, mu, mu, mu])
    D[:3, :3] += lam
    return D


def stiffness(X: Array, young: float, poisson: float) -> Array:
    """K_e = V B^T D B, (12, 12)."""
    gradients = np.linalg.inv(np.column_stack([np.ones(4), X]))[1:].T  # of the shape functions, (4, 3)
    B = np.zeros((6, 12))
    for a, (gx, gy, gz) in enumerate(gradients):
        B[:, 3 * a : 3 * a + 3] = [[gx, 0, 0], [0, gy, 0], [0, 0, gz], [gy, gx, 0], [0, gz, gy], [gz, 0, gx]]
    return volume(X) * B.T @ hooke(young, poisson) @ B


def exact_tangent(x: Array, X: Array, young: float, poisson: float, clamped: bool = True) -> Array:
    """-df/dx of an element, R turning with x: d2W/dF2 (9, 9) by singular vectors, contracted with dF/dx; (12, 12).

    clamped: negative eigenvalues of the twists are zero.
    """
    lam, mu = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    F = deformation(x, X)
    U, s, Vt = np.linalg.svd(F)
    sign = np.sign(np.linalg.det(U @ Vt))
    U[:, 2] *= sign
    s[2] *= sign
    r = (U @ Vt).ravel()
    H = 2 * mu * np.eye(9) + lam * np.outer(r, r)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        twist = (np.outer(U[:, a], Vt[b]) - np.outer(U[:, b], Vt[a])).ravel() / np.sqrt(2)
        e = 2 * mu + (lam * (s.sum() - 3) - 2 * mu) * 2 / (s[a] + s[b])
        H += ((max(e, 0.0) if clamped else e) - 2 * mu) * np.outer(twist, twist)
    gradients = np.linalg.inv(np.column_stack([np.ones(4), X]))[1:].T
    dF = np.einsum("aj,ik->ijak", gradients, np.eye(3)).reshape(9, 12)
    return volume(X) * dF.T @ H @ dF


@dataclass
class Solid:
    """Mesh, material and state. rest, x, v (n, 3); tets (m, 4); young, poisson (m,); mass, free (n,); alpha, beta:
    Rayleigh damping; h: time step; rotation: of the elements, polar or qr; exact: the tangent."""

    rest: Array
    tets: NDArray[np.int32]
    young: Array
    poisson: Array
    mass: Array
    free: Array
    x: Array
    v: Array
    h: float
    alpha: float = 0.0
    beta: float = 0.0
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: str = "polar"
    exact: bool = False

    def elements(self) -> Iterator[tuple[Any, Any, Array]]:
        """(corner dofs (12,), block diagonal rotation (12, 12), K_e) of every element."""
        for tet, young, poisson in zip(self.tets, self.young, self.poisson, strict=True):
            x, X = self.x[tet], self.rest[tet]
            R = turned_frame(x, X) if self.rotation == "qr" else nearest_rotation(deformation(x, X))
            dofs = (3 * tet[:, None] + np.arange(3)).ravel()
            yield dofs, np.kron(np.eye(4), R), stiffness(self.rest[tet], young, poisson)

    def energy(self) -> float:
        """sum 1/2 u^T K_e u with u = R^T x_e - X_e."""
        total = 0.0
        for dofs, R, K in self.elements():
            u = R.T @ self.x.ravel()[dofs] - self.rest.ravel()[dofs]
            total += 0.5 * u @ K @ u
        return total

    def forces(self) -> Array:
        """Elastic forces, (n, 3)."""
        f = np.zeros(self.x.size)
        for dofs, R, K in self.elements():
            f[dofs] -= R @ K @ (R.T @ self.x.ravel()[dofs] - self.rest.ravel()[dofs])
        return f.reshape(-1, 3)

    def tangent(self) -> Array:
        """sum R K_e R^T, (3 n, 3 n): -df/dx with R held, or, if exact, turning as far as K stays definite."""
        K = np.zeros((self.x.size, self.x.size))
        if self.exact:
            for tet, young, poisson in zip(self.tets, self.young, self.poisson, strict=True):
                dofs = (3 * tet[:, None] + np.arange(3)).ravel()
                K[np.ix_(dofs, dofs)] += exact_tangent(self.x[tet], self.rest[tet], young, poisson)
            return K
        for dofs, R, K_e in self.elements():
            K[np.ix_(dofs, dofs)] += R @ K_e @ R.T
        return K

    def matrix(self) -> Array:
        """A = (1 + h alpha) M + h (h + beta) sum R K_e R^T; rows and columns of fixed nodes are the identity's."""
        h = self.h
        A = np.diag(np.repeat((1 + h * self.alpha) * self.mass, 3)) + h * (h + self.beta) * self.tangent()
        held = np.repeat(self.free, 3) == 0
        A[held] = 0
        A[:, held] = 0
        A[held, held] = 1
        return A

    def right_side(self) -> Array:
        """b = h f + h (h + beta) K v - h alpha M v + h M g with K = df/dx, and 0 at fixed nodes; (n, 3)."""
        h, m = self.h, self.mass[:, None]
        Kv = -(self.tangent() @ self.v.ravel()).reshape(-1, 3)
        b = h * self.forces() + h * (h + self.beta) * Kv - h * self.alpha * m * self.v + h * m * np.array(self.gravity)
        return b * self.free[:, None]
