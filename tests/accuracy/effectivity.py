# SPDX-License-Identifier: MIT
"""Estimated error of a linear solve over the true one (its effectivity), of many solves of scenes in motion.

The steps of a scene are solved to one tolerance after another.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from precond_worker.factorization.registry import make_factorization
from protocol.factor import FactorPattern
from protocol.method import Method
from sim_server.simulation import Simulation
from tests.scenes import bar

GRAVITY = (0, -9.81, 0)
EXACT = Method()
ROUNDING = 1e-13  # errors below it tell nothing [m]
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-5)
"""Relative to |b|, of one step after another."""


class Solve(NamedTuple):
    """Estimated and true error of a solve, the position that it had to reach [m], and its record."""

    estimate: float
    true: float
    position: float
    record: Any


def beam(
    young: Any = 5e5, cells: tuple[int, int, int] = (10, 2, 2), law: dict[str, Any] | None = None, **table: Any
) -> dict:
    """A beam of 10 x 2 x 2 m that is let go from horizontal, held at its left end."""
    made = bar(cells, (10, 2, 2), young=young, fixed="X < 0.01", **table)
    if law:
        del made["effects"]["corotational"]
        made["effects"] |= law
    return made


def nodal(values: NDArray[np.float64]) -> float:
    """Largest norm of a node."""
    return float(np.linalg.norm(values.reshape(-1, 3), axis=1).max())


class Factors:
    """Gives a body a factor of each `every`-th matrix, `late` steps after it."""

    def __init__(self, sim: Simulation, every: int, late: int, method: Method = EXACT, scale: float = 1.0):
        body = sim.world.bodies[0]
        self.sim, self.every, self.late, self.scale = sim, every, late, scale
        self.analysis = make_factorization(*sim.system.body_pattern(body.first, body.last), method, "auto")
        self.made: dict[int, tuple[FactorPattern, NDArray[Any]]] = {}

    def __call__(self, step: int) -> None:
        if step % self.every == 0:
            values = self.analysis.factorize(self.sim.system.body_values(*self._nodes), np.float32)
            self.made[step] = self.analysis.pattern, values * np.float32(self.scale)
        if (made := self.made.pop(step - self.late, None)) is not None:
            self.sim.engine.post_factor(0, *made, step - self.late)

    @property
    def _nodes(self) -> tuple[int, int]:
        return self.sim.world.bodies[0].first, self.sim.world.bodies[0].last


def solves(
    sim: Simulation, steps: int, prepare: Callable[[int], None] = lambda step: None, after: int = 2,
    positions: Sequence[float] = (0.0,), tolerances: Sequence[float] = TOLERANCES,
) -> list[Solve]:  # fmt: skip
    """Returns what is known of the solves that took iterations, to the tolerances and positions in turn.

    prepare: called in each step before its solve; after: steps made before the first one of them
    """
    settings, found = sim.engine.settings(0), []
    for step in range(steps):
        settings.tolerance = tolerances[step % len(tolerances)]
        settings.position = positions[step % len(positions)]
        sim.engine.assemble()
        prepare(step)
        exact = splu(sim.matrix()).solve(sim.system.b_material.ravel())
        sim.engine.solve()
        record = sim.engine.records()[0]
        if step >= after and record["iterations"]:
            true = sim.world.dx_dv * nodal(sim.system.y.ravel() - exact)
            if true < ROUNDING:
                continue
            found.append(Solve(float(record["solve_error"]), true, settings.position, record))
    return found
