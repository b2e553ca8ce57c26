# SPDX-License-Identifier: MIT
"""The law of contact and the residual of a step with it, in NumPy (kernels/contact_law.cuh)."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sim_server.simulation import Simulation


@dataclass
class Rows:
    """Rows in use, as they were before the solve."""

    corner: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    drift: np.ndarray
    gap: np.ndarray
    thickness: np.ndarray
    stiffness: np.ndarray
    friction: np.ndarray
    traction: np.ndarray
    force: np.ndarray

    @classmethod
    def of(cls, sim: Simulation) -> "Rows":
        given = sim.contact.contact_input()
        used = given.obstacle >= 0
        return cls(**{f.name: getattr(given, f.name)[used].copy() for f in fields(cls)})

    def forces(self, s: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal forces (k,) and tractions (k, 3) for displacements s (k, 3); limit (k,): normal forces of friction."""
        normal = np.maximum(0, self.stiffness * (self.thickness - self.gap - np.einsum("ij,ij->i", self.normal, s)))
        e = s - self.drift
        e -= self.normal * np.einsum("ij,ij->i", self.normal, e)[:, None]
        trial = self.traction - self.stiffness[:, None] * e
        size = np.linalg.norm(trial, axis=1)
        most = self.friction * limit
        scale = np.where(size > most, most / np.where(size > 0, size, 1), 1)
        return normal, trial * scale[:, None]


@dataclass
class Solved:
    """A step: residual with the law, relative to the larger one of |b| and |b + i H^T f|; forces of the rows."""

    residual: float
    normal: np.ndarray
    traction: np.ndarray


def step(sim: Simulation) -> tuple[Solved, Any]:
    """Makes one step of a scene with one body; returns it and its record."""
    w, system = sim.world, sim.system
    sim.engine.assemble()
    rows, x, predictor = Rows.of(sim), w.x.copy(), w.predictor.copy()
    matrix, b, frames = sim.matrix(0), system.b_material.ravel().copy(), system.rotation.copy()
    sim.engine.solve()
    y = system.y
    nodes = rows.corner  # -1: the weight is 0
    dv = np.einsum("nij,nj->ni", frames, y)
    moved = w.dx_dv * (predictor + dv)
    assert np.allclose(w.x, x + moved, rtol=0, atol=1e-12)
    s = np.einsum("ra,rak->rk", rows.weight, moved[nodes])
    normal, _ = rows.forces(s, rows.force)
    normal, traction = rows.forces(s, normal)
    impulse = np.zeros_like(y)
    f = normal[:, None] * rows.normal + traction
    each = w.force_coefficient * np.einsum("ra,raji,rj->rai", rows.weight, frames[nodes], f)
    np.add.at(impulse, nodes, each)
    residual = b - matrix @ y.ravel() + impulse.ravel()
    scale = max(np.linalg.norm(b), np.linalg.norm(b + impulse.ravel()))
    return Solved(np.linalg.norm(residual) / scale, normal, traction), sim.engine.records()[0]
