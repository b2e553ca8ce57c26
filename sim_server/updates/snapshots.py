# SPDX-License-Identifier: MIT
"""Copies of matrices, or of positions, that the loop makes for workers: asked for, kept, used again.

The loop copies as it assembles, into memory that it is given here. What was sent is kept until its factor came, which
is judged by it; then its memory serves again, so that in the long run none is added.
"""

from collections.abc import Iterable
from itertools import count

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.factor_source import FactorSource
from sim_server.updates.stats import Track

UNBUILT = 3  # jobs of positions alone that may fail in a row before the matrix is sent for good


class Copies:
    """Of the bodies of one simulation. source: whose workers are asked whether they build matrices from positions."""

    def __init__(self, simulation: Simulation, source: FactorSource):
        self._simulation, self._source = simulation, source
        self._solver = simulation.scene.solver
        self._asked = count()
        self._spare: dict[tuple[int, ...], list[NDArray[np.float64]]] = {}  # by shape; it has been touched

    def ask(self, t: Track) -> None:
        """The loop copies into `t.wanted` when it assembles next: the matrix, or positions if they will do."""
        engine, body = self._simulation.engine, t.body
        t.asked = next(self._asked)
        if self._others_build(t):
            t.wanted = self._room((body.last - body.first, 3))
            t.ahead = self._ahead(t)
            engine.request_positions(body.index, t.wanted, t.ahead)
        else:
            t.ahead = 0.0
            t.wanted = self._room(self._simulation.system.body_values(body.first, body.last).shape)
            engine.request_matrix(body.index, t.wanted)

    def step(self, t: Track) -> int:
        """Steps completed before the one whose matrix was copied; -1: it is not there yet."""
        return self._simulation.engine.matrix_step(t.body.index)

    def made(self, tracks: Iterable[Track]) -> list[Track]:
        """Those whose copy is there, in the order in which they were asked for."""
        return sorted((t for t in tracks if t.wanted is not None and self.step(t) >= 0), key=lambda t: t.asked)

    def will_do(self, t: Track) -> bool:
        """What was copied is all that whoever takes it needs: a grab may have begun between the request and the copy,
        and positions do not tell of its springs."""
        assert t.wanted is not None
        step = self.step(t)
        return t.wanted.ndim == 3 or all(e.told_at(step) for e in self._simulation.effects.values())

    def discard(self, t: Track) -> None:
        """What was asked for goes to nobody."""
        assert t.wanted is not None
        self._give_back(t.wanted)
        t.wanted = None

    def take_back(self, t: Track, step: int = -1) -> NDArray[np.float64] | None:
        """The job in flight is over: the matrix that it was sent if that is of `step`, to be read at once."""
        if t.matrix is None:
            return None
        (made, values), t.matrix = t.matrix, None
        self._give_back(values)
        return values if made == step and values.ndim == 3 else None

    def _room(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        spare = self._spare.setdefault(shape, [])
        return spare.pop() if spare else np.full(shape, 0.0)

    def _give_back(self, copy: NDArray[np.float64]) -> None:
        if copy.base is None:  # not the system's own
            self._spare[copy.shape].append(copy)

    def _others_build(self, t: Track) -> bool:
        """Whether positions will do: workers have all that the matrix is made of, and it was no use but a few times."""
        if self._solver.build != "worker" or t.unbuilt >= UNBUILT:
            return False
        told = all(e.told for e in self._simulation.effects.values())
        return told and self._source.assembles_matrices()

    def _ahead(self, t: Track) -> float:
        """How far positions go ahead [s]: to when the factor is expected."""
        kind, n = self._solver.update
        latency = float(n) if kind == "lockstep" else t.latency.value or 0.0
        return min(self._solver.extrapolate, latency * self._simulation.scene.dt)
