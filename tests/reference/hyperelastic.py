# SPDX-License-Identifier: MIT
"""Hyperelastic laws and elements in plain NumPy, from the textbooks' energies: slow, and meant to be obviously right.

A law is a function W(F, **constants). Stress comes from it by complex steps, which are exact to rounding, and the
tangent by differences of the stress, so that nothing here repeats a formula of the kernels.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Energy = Callable[..., Any]


def lame(young: float, poisson: float) -> tuple[float, float]:
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def strain_invariants(F: Any) -> tuple[Any, Any, Any]:
    """I1, I2, J; for complex F as well."""
    C = F.T @ F
    I1 = np.trace(C)
    return I1, (I1**2 - np.trace(C @ C)) / 2, determinant(F)


def determinant(F: Any) -> Any:
    return F[:, 0] @ np.cross(F[:, 1], F[:, 2])


def st_venant_kirchhoff(F: Any, young: float, poisson: float) -> Any:
    lam, mu = lame(young, poisson)
    E = (F.T @ F - np.eye(3)) / 2
    return lam / 2 * np.trace(E) ** 2 + mu * (E * E).sum()


def neo_hookean(F: Any, young: float, poisson: float) -> Any:
    lam, mu = lame(young, poisson)
    I1, _, J = strain_invariants(F)
    return mu / 2 * (I1 - 3) - mu * np.log(J) + lam / 2 * np.log(J) ** 2


def parabola(f: Callable[[Any], Any], first: float, second: float, floor: float, J: Any) -> Any:
    """f(J) above the floor; below, its Taylor parabola there. first, second: f' and f'' at the floor."""
    x = J - floor
    return f(J) if np.real(J) > floor else f(floor) + first * x + second * x * x / 2


def regularized_neo_hookean(F: Any, young: float, poisson: float, floor: float) -> Any:
    lam, mu = lame(young, poisson)
    I1, _, J = strain_invariants(F)
    L = parabola(np.log, 1 / floor, -1 / floor**2, floor, J)
    return mu / 2 * (I1 - 3) - mu * L + lam / 2 * L**2


def stable_neo_hookean(F: Any, young: float, poisson: float) -> Any:
    lam, mu = lame(young, poisson)
    m, k = 4 / 3 * mu, lam + 5 / 6 * mu
    I1, _, J = strain_invariants(F)
    a = 1 + 3 * m / (4 * k)
    return m / 2 * (I1 - 3) - m / 2 * np.log((I1 + 1) / 4) + k / 2 * (J - a) ** 2 - k / 2 * (1 - a) ** 2


# --- derivatives and elements -----------------------------------------------------------------------------------------


def stress(W: Energy, F: Array) -> Array:
    """dW/dF by complex steps: exact to rounding."""
    P = np.zeros((3, 3))
    for k in np.ndindex(3, 3):
        G = F.astype(complex)
        G[k] += 1e-40j
        P[k] = np.imag(W(G)) / 1e-40
    return P


def tangent(W: Energy, F: Array) -> Array:
    """d2W/dF2, (9, 9), row-major F: central differences of the stress, error about 1e-10 of its size."""
    H, step = np.zeros((9, 9)), 1e-5
    for k in range(9):
        G = np.zeros(9)
        G[k] = step
        G = G.reshape(3, 3)
        H[:, k] = (
            8 * (stress(W, F + G) - stress(W, F - G)) - (stress(W, F + 2 * G) - stress(W, F - 2 * G))
        ).ravel() / (12 * step)
    return (H + H.T) / 2


def projected(H: Array, projection: str) -> Array:
    """Its eigenvalues clamped at 0, made absolute, or left."""
    values, vectors = np.linalg.eigh(H)
    changed = {"none": values, "clamp": np.maximum(values, 0), "absolute": np.abs(values)}[projection]
    return (vectors * changed) @ vectors.T


def gradients(X: Array) -> tuple[float, Array]:
    """Volume and rest gradients (4, 3) of a tetrahedron with rest corners X (4, 3)."""
    return float(np.linalg.det(X[1:] - X[0])) / 6, np.linalg.inv(np.column_stack([np.ones(4), X]))[1:].T


def element(W: Energy, x: Array, X: Array, projection: str = "none") -> tuple[float, Array, Array]:
    """Energy, forces (4, 3) and stiffness (12, 12) of a tetrahedron."""
    volume, D = gradients(X)
    F = x.T @ D
    P, H = stress(W, F), projected(tangent(W, F), projection).reshape(3, 3, 3, 3)
    K = volume * np.einsum("ap,ipjq,bq->aibj", D, H, D).reshape(12, 12)
    return volume * float(np.real(W(F))), -volume * D @ P.T, K
