# SPDX-License-Identifier: MIT
"""Materials with a memory in plain NumPy: their memory after a path of positions, element by element in one go."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
I = np.eye(3)  # noqa: E741
ENTRIES = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # of a symmetric matrix, as kernels have them


def gradients(rest: Array, tets: Any) -> tuple[Array, Array]:
    """Rest volumes (m,) and gradients (m, 4, 3) of the shape functions."""
    corners = rest[tets]
    edges = corners[:, 1:] - corners[:, :1]
    inner = np.linalg.inv(edges).transpose(0, 2, 1)
    return np.abs(np.linalg.det(edges)) / 6, np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)


def turned(x: Array, rest: Array, tets: Any) -> tuple[Array, Array]:
    """Rotations R nearest to F and stretches R^T F, (m, 3, 3) each."""
    F = np.einsum("maj,mak->mjk", x[tets], gradients(rest, tets)[1])
    u, _, vt = np.linalg.svd(F)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    R = u @ vt
    return R, R.transpose(0, 2, 1) @ F


def deviator(a: Array) -> Array:
    return a - np.trace(a, axis1=1, axis2=2)[:, None, None] / 3 * I


def rows(a: Array) -> Array:
    """Symmetric matrices (m, 3, 3) as the kernels have them, (6, m)."""
    return np.asarray(a[:, ENTRIES[0], ENTRIES[1]].T)


def prony(path: Iterable[Array], rest: Array, tets: Any, terms: Any, dt: float) -> list[Array]:
    """q of each branch (m, 3, 3) after steps that begin at the positions of the path."""
    reached, found = np.zeros((len(tets), 3, 3)), [np.zeros((len(tets), 3, 3)) for _ in terms]
    for x in path:
        now = deviator(turned(x, rest, tets)[1] - I)
        for q, (_, tau) in zip(found, terms, strict=True):
            left = np.exp(-dt / tau)
            q *= left
            q += tau / dt * (1 - left) * (now - reached)
        reached = now
    return found


def forces(x: Array, rest: Array, tets: Any, stress: Array) -> Array:
    """Nodal forces of stresses T (m, 3, 3) whose work is T : dS, by solving for their skew part, (n, 3)."""
    volume, D = gradients(rest, tets)
    R, S = turned(x, rest, tets)
    out = np.zeros_like(x)
    generators = np.array([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
                           [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float)  # fmt: skip
    for e, corners in enumerate(tets):
        lack = S[e] @ stress[e] - stress[e] @ S[e]
        system = np.stack([(A @ S[e] + S[e] @ A).ravel() for A in generators], axis=1)
        A = np.tensordot(np.linalg.lstsq(system, lack.ravel(), rcond=None)[0], generators, 1)
        np.add.at(out, corners, -volume[e] * D[e] @ (R[e] @ (stress[e] + A)).T)
    return out


def plastic_return(strain: Array, plastic: Array, hardened: Array, mu: float, constants: Any) -> tuple[Array, Array]:
    """Plastic strain (m, 3, 3) and equivalent one (m,) at a strain, by bisection for the amount of flow."""
    yield_stress, isotropic, kinematic = constants
    e = deviator(strain)
    found, grown = plastic.copy(), hardened.copy()
    for k in range(len(e)):
        xi = 2 * mu * (e[k] - plastic[k]) - 2 / 3 * kinematic * plastic[k]
        size = np.linalg.norm(xi)
        if size <= np.sqrt(2 / 3) * (yield_stress + isotropic * hardened[k]):
            continue
        low, high = 0.0, size / (2 * mu)
        for _ in range(200):
            amount = (low + high) / 2
            over = size - (2 * mu + 2 / 3 * kinematic) * amount
            over -= np.sqrt(2 / 3) * (yield_stress + isotropic * (hardened[k] + np.sqrt(2 / 3) * amount))
            low, high = (amount, high) if over > 0 else (low, amount)
        found[k] += amount * xi / size
        grown[k] += np.sqrt(2 / 3) * amount
    return found, grown


def plasticity(path: Iterable[Array], rest: Array, tets: Any, mu: float, constants: Any) -> tuple[Array, Array]:
    """Plastic strain (m, 3, 3) and equivalent one (m,) after steps that begin at the positions of the path."""
    plastic, hardened = np.zeros((len(tets), 3, 3)), np.zeros(len(tets))
    for x in path:
        plastic, hardened = plastic_return(turned(x, rest, tets)[1] - I, plastic, hardened, mu, constants)
    return plastic, hardened


def tension(strain: Array) -> Array:
    """Mazars' equivalent strain, (m,)."""
    return np.asarray(np.sqrt((np.maximum(np.linalg.eigvalsh(strain), 0) ** 2).sum(axis=1)))


def largest_tension(path: Iterable[Array], rest: Array, tets: Any) -> Array:
    """Largest equivalent strain (m,) at the positions of the path."""
    return np.asarray(np.max([tension(turned(x, rest, tets)[1] - I) for x in path], axis=0))
