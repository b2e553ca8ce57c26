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
    L = regularized_logarithm(floor, J)
    return mu / 2 * (I1 - 3) - mu * L + lam / 2 * L**2


def stable_neo_hookean(F: Any, young: float, poisson: float) -> Any:
    lam, mu = lame(young, poisson)
    m, k = 4 / 3 * mu, lam + 5 / 6 * mu
    I1, _, J = strain_invariants(F)
    a = 1 + 3 * m / (4 * k)
    return m / 2 * (I1 - 3) - m / 2 * np.log((I1 + 1) / 4) + k / 2 * (J - a) ** 2 - k / 2 * (1 - a) ** 2


def mooney_rivlin(F: Any, c1: float, c2: float, bulk: float) -> Any:
    I1, I2, J = strain_invariants(F)
    return c1 * (J ** (-2 / 3) * I1 - 3) + c2 * (J ** (-4 / 3) * I2 - 3) + bulk / 2 * np.log(J) ** 2


CHAIN = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)


def arruda_boyce(F: Any, shear: float, segments: float, bulk: float) -> Any:
    I1, _, J = strain_invariants(F)
    I1 = J ** (-2 / 3) * I1
    terms = [a / segments ** (i - 1) * (I1**i - 3**i) for i, a in enumerate(CHAIN, 1)]
    return shear * sum(terms) + bulk / 2 * np.log(J) ** 2


def veronda_westmann(F: Any, c1: float, c2: float, bulk: float) -> Any:
    I1, I2, J = strain_invariants(F)
    I1, I2 = J ** (-2 / 3) * I1, J ** (-4 / 3) * I2
    return c1 * (np.exp(c2 * (I1 - 3)) - 1) - c1 * c2 / 2 * (I2 - 3) + bulk / 2 * np.log(J) ** 2


def regularized_power(p: float, floor: float, J: Any) -> Any:
    return parabola(lambda J: J**p, p * floor ** (p - 1), p * (p - 1) * floor ** (p - 2), floor, J)


def regularized_logarithm(floor: float, J: Any) -> Any:
    return parabola(np.log, 1 / floor, -1 / floor**2, floor, J)


def regularized_mooney_rivlin(F: Any, c1: float, c2: float, bulk: float, floor: float) -> Any:
    I1, I2, J = strain_invariants(F)
    f, g, L = regularized_power(-2 / 3, floor, J), regularized_power(-4 / 3, floor, J), regularized_logarithm(floor, J)
    return c1 * (f * I1 - 3) + c2 * (g * I2 - 3) + bulk / 2 * L**2


def ogden(F: Any, mu: list[float], alpha: list[float], bulk: float) -> Any:
    """By the eigenvalues of C, so that complex steps work."""
    J = determinant(F)
    squares = eigenvalues(F.T @ F)
    W = bulk / 2 * np.log(J) ** 2
    for m, a in zip(mu, alpha, strict=True):
        W = W + m / a * (J ** (-a / 3) * sum(s ** (a / 2) for s in squares) - 3)
    return W


def eigenvalues(C: Any) -> Any:
    """Of a symmetric matrix with an imaginary part far below rounding: first order in it is exact."""
    real, vectors = np.linalg.eigh(np.real(C))
    return real + 1j * np.einsum("ik,ij,jk->k", vectors, np.imag(C), vectors)


def costa(F: Any, a: float, b: dict[str, float], bulk: float, axes: Array) -> Any:
    """axes: columns f, s, n."""
    E = axes.T @ (F.T @ F - np.eye(3)) @ axes / 2
    J = determinant(F)
    Q = sum(
        b["".join(sorted((p, q), key="fsn".index))] * E["fsn".index(p), "fsn".index(q)] ** 2
        for p in "fsn"
        for q in "fsn"
    )
    return a / 2 * (np.exp(Q) - 1) + bulk * (J * np.log(J) - J + 1)


def fibres(F: Any, stiffness: float, exponent: float, directions: Array) -> Any:
    W = 0.0
    for direction in directions:
        a = direction / np.linalg.norm(direction)
        I4 = a @ F.T @ F @ a
        if np.real(I4) > 1:
            y = (I4 - 1) ** 2
            W = W + (stiffness / (2 * exponent) * (np.exp(exponent * y) - 1) if exponent else stiffness / 2 * y)
    return W


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


def projected(H: Array, projection: str, F: Array) -> Array:
    """Its eigenvalues clamped at 0, made absolute, or left; excess: of isotropic laws, mode by mode, with F = U diag(s)
    V^T: absolute for the modes U diag(a) V^T; of the others, two for each pair of axes, what exceeds their mean."""
    values, vectors = np.linalg.eigh(H)
    if projection == "excess" and values[0] < -1e-7 * values[-1]:
        return excess(H, F)
    changed = {"clamp": np.maximum(values, 0), "absolute": np.abs(values)}.get(projection, values)
    return (vectors * changed) @ vectors.T


def excess(H: Array, F: Array) -> Array:
    """See projected."""
    U, _, Vt = np.linalg.svd(F)
    S = np.stack([np.outer(U[:, k], Vt[k]).ravel() for k in range(3)], axis=1)
    out = S @ projected(S.T @ H @ S, "absolute", F) @ S.T
    for i, j in ((0, 1), (0, 2), (1, 2)):
        T = np.stack([np.outer(U[:, i], Vt[j]).ravel(), np.outer(U[:, j], Vt[i]).ravel()], axis=1)
        assert np.abs(H @ T - T @ (T.T @ H @ T)).max() < 1e-7 * np.abs(H).max()
        values, vectors = np.linalg.eigh(T.T @ H @ T)
        changed = np.where(values < 0, np.maximum(-values - max(values.mean(), 0), 0), values)
        out += T @ (vectors * changed) @ vectors.T @ T.T
    return out


def gradients(X: Array) -> tuple[float, Array]:
    """Volume and rest gradients (4, 3) of a tetrahedron with rest corners X (4, 3)."""
    return float(np.linalg.det(X[1:] - X[0])) / 6, np.linalg.inv(np.column_stack([np.ones(4), X]))[1:].T


def element(W: Energy, x: Array, X: Array, projection: str = "none") -> tuple[float, Array, Array]:
    """Energy, forces (4, 3) and stiffness (12, 12) of a tetrahedron."""
    volume, D = gradients(X)
    F = x.T @ D
    P, H = stress(W, F), projected(tangent(W, F), projection, F).reshape(3, 3, 3, 3)
    K = volume * np.einsum("ap,ipjq,bq->aibj", D, H, D).reshape(12, 12)
    return volume * float(np.real(W(F))), -volume * D @ P.T, K
