# SPDX-License-Identifier: MIT
"""One solve of the native loop taken apart: matrix, right-hand side, iterates, what was reported."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.cpu.factors import NativeFactor
from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from tests.scenes import bar, simulation

STATUSES = ["converged", "max_iterations", "budget", "breakdown_matrix", "breakdown_preconditioner", "not_finite"]
HARD = {"tolerance": 1e-9, "max_iterations": 5000, "factor_precision": "float64"}


def bent(seed: int = 0, **solver: Any) -> Simulation:
    """A damped bar held at one end, nodes off their rest and moving; the first half of a step is made."""
    sim = simulation(
        bar((5, 2, 2), (2.5, 1, 1), young=1e7, fixed="X < 0.01", damping=(0.1, 0.0)), gravity=(0, -9.81, 0),
        **(HARD | solver),
    )  # fmt: skip
    random = np.random.default_rng(seed)
    free = sim.world.free[:, None]
    sim.world.x += 0.02 * random.normal(size=sim.world.x.shape) * free
    sim.world.v[:] = random.normal(size=sim.world.v.shape) * free
    sim.engine.assemble()
    return sim


def system(sim: Simulation) -> tuple[Any, NDArray]:
    """A' (sparse) and b' (3 n,)."""
    return sim.matrix(), sim.system.b_material.ravel().copy()


def solve(sim: Simulation, start: NDArray | None = None, **settings: Any) -> tuple[NDArray, Any]:
    """Solves the assembled system as the loop does, and takes the step back: y (3 n,) and the record.

    start: where the iteration starts (needs warm_start). settings: of the solver, e.g. kind, tolerance.
    """
    native, world, loop = sim.engine.settings(0), sim.world, sim.engine.loop
    for name, value in settings.items():
        setattr(native, name, int(value) if isinstance(value, Kind) else value)
    x, v, dv = world.x.copy(), world.v.copy(), sim.system.dv.copy()
    sim.system.y[:] = 0 if start is None else start.reshape(-1, 3)
    sim.engine.records()
    loop.energies = None  # b is anything
    sim.engine.solve()
    loop.step -= 1
    world.x[:], world.v[:], sim.system.dv[:] = x, v, dv
    return sim.system.y.ravel().copy(), sim.engine.records()[0]


def true_residual(sim: Simulation, y: NDArray) -> float:
    """|b - A y| / |b|, recomputed with SciPy."""
    A, b = system(sim)
    return float(np.linalg.norm(b - A @ y) / np.linalg.norm(b))


def applied(pattern: Any, values: NDArray) -> Callable[[NDArray], NDArray]:
    """r -> (L L^T)^-1 r by the native triangular solves."""
    return NativeFactor(pattern, np.ascontiguousarray(values)).apply


def stops(A: Any, b: NDArray, iterates: list[NDArray]) -> Iterator[tuple[int, float]]:
    """(k, tolerance): a solve with this tolerance ends with the iterate x_k, as its residual is the smallest so far."""
    least = 1.0
    for k, x in enumerate(iterates):
        residual = float(np.linalg.norm(b - A @ x) / np.linalg.norm(b))
        if residual < 0.97 * least:
            yield k, 1.01 * residual
            least = residual
