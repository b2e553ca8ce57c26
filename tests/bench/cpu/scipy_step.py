# SPDX-License-Identifier: MIT
"""The same step as sim_server's, as one would write it with NumPy, SciPy and CHOLMOD: the yardstick of `bench cpu`.

Vectorized over elements (polar decomposition by batched SVD, einsum for the element matrices), assembled through a
precomputed map into CSC, factorized and solved each step. No shortcuts of ours, and nothing done twice.
"""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

from sim_server.mesh.shape_functions import shape_gradients
from sim_server.simulation import Simulation

Reals = NDArray[np.float64]


class ScipyStep:
    """Backward Euler with one linearization for the single corotational body of a simulation's scene."""

    def __init__(self, simulation: Simulation):
        world, elastic = simulation.world, simulation.effects["corotational"]
        rayleigh = simulation.scene.objects[0].effects["rayleigh"]
        gravity = simulation.scene.effects["gravity"]
        self.h, self.alpha, self.beta = world.dt, rayleigh.mass, rayleigh.stiffness  # type: ignore[attr-defined]
        self.x, self.v, self.mass = world.x.copy(), world.v.copy(), world.mass
        self.g = np.array(gravity.g)  # type: ignore[attr-defined]
        assert elastic.elements is not None
        self.tets = elastic.elements
        young, poisson = elastic.elastic[0]
        lam, mu = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
        volume, inner = shape_gradients(world.rest, self.tets)
        self.gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)  # (m, 4, 3)
        self.stiffness = _stiffness(self.gradients, volume, lam, mu)
        self.rest = world.rest[self.tets]
        self.free = np.repeat(world.free > 0, 3)
        self._map()

    def _map(self) -> None:
        """Where each entry of the element matrices lands in the CSC data of the free block."""
        number = np.cumsum(self.free) - 1
        dof = (3 * self.tets[:, :, None] + np.arange(3)).reshape(len(self.tets), 12)
        rows, columns = np.repeat(dof, 12, axis=1).ravel(), np.tile(dof, (1, 12)).ravel()
        self.used = self.free[rows] & self.free[columns]
        n = int(self.free.sum())
        r, c = number[rows[self.used]], number[columns[self.used]]
        pattern = coo_array((np.ones(len(r)), (r, c)), shape=(n, n)).tocsc()
        key = np.repeat(np.arange(n), np.diff(pattern.indptr)).astype(np.int64) * n + pattern.indices
        self.place = np.searchsorted(key, c.astype(np.int64) * n + r)
        self.pattern, self.diagonal = pattern, np.searchsorted(key, np.arange(n, dtype=np.int64) * (n + 1))

    def step(self) -> dict[str, float]:
        """One step; CPU seconds of the thread by stage."""
        begin = time.thread_time()
        a, b = self._assemble()
        assembled = time.thread_time()
        dv = self._factorize(a)(b)
        factorized = time.thread_time()
        self.v.ravel()[self.free] += dv
        self.x += self.h * self.v
        end = time.thread_time()
        return {"assemble": assembled - begin, "solve": factorized - assembled, "whole": end - begin}

    def _assemble(self) -> tuple[csc_array, Reals]:
        h, k = self.h, self.h * (self.h + self.beta)
        x, v = self.x[self.tets], self.v[self.tets]
        rotation = nearest_rotations(np.einsum("mai,maj->mij", x, self.gradients))
        turned = np.einsum("mji,maj->mai", rotation, x) - self.rest
        rate = np.einsum("mji,maj->mai", rotation, v)
        push = np.einsum("maibj,mbj->mai", self.stiffness, h * turned + k * rate)
        push = -np.einsum("mij,maj->mai", rotation, push)
        b = np.stack([np.bincount(self.tets.ravel(), push[:, :, i].ravel(), len(self.x)) for i in range(3)], axis=1)
        b += self.mass[:, None] * h * (self.g - self.alpha * self.v)
        blocks = np.einsum("mip,mapbq,mjq->maibj", rotation, self.stiffness, rotation, optimize=True)
        values = np.bincount(self.place, k * blocks.ravel()[self.used], len(self.pattern.data))
        values[self.diagonal] += (1 + h * self.alpha) * np.repeat(self.mass, 3)[self.free]
        a = csc_array((values, self.pattern.indices, self.pattern.indptr), shape=self.pattern.shape)
        return a, b.ravel()[self.free]

    def _factorize(self, a: csc_array) -> Any:
        from scipy.sparse import csc_matrix
        from sksparse.cholmod import analyze

        if not hasattr(self, "_factor"):
            self._factor = analyze(csc_matrix(a), mode="supernodal", ordering_method="metis")
        self._factor.cholesky_inplace(csc_matrix(a))
        return self._factor


def _stiffness(gradients: Reals, volume: Reals, lam: Reals, mu: Reals) -> Reals:
    """Element matrices at rest, (m, 4, 3, 4, 3)."""
    g, eye = gradients, np.eye(3)
    outer = np.einsum("mai,mbj->maibj", g, g)
    swapped = np.einsum("maj,mbi->maibj", g, g)
    isotropic = np.einsum("mak,mbk,ij->maibj", g, g, eye)
    one = volume[:, None, None, None, None]
    return one * (lam[:, None, None, None, None] * outer + mu[:, None, None, None, None] * (swapped + isotropic))


def nearest_rotations(deformation: Reals) -> Reals:
    """Proper rotations (m, 3, 3) nearest to F, by singular value decomposition."""
    u, _, vt = np.linalg.svd(deformation)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt
