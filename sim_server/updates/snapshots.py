# SPDX-License-Identifier: MIT
"""Copies of matrices, or of positions, that the loop makes for workers: requested, kept, used again.

The loop copies as it assembles, into memory that it is given here. A copy that was sent is kept until its factor came,
which is checked with it; then its memory is used again, so that in the long run none is added.
"""

import time
from collections.abc import Callable, Sequence
from itertools import count

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.body_state import BodyUpdateState, on_requests
from sim_server.updates.factor_source import FactorSource

MAX_FAILED_ASSEMBLIES = 3  # jobs in a row with positions without a factor, after which matrices are sent for good


class SnapshotPool:
    """Copies for the bodies of one simulation.

    source: says whether workers can assemble matrices from positions
    expected_latency: steps from the matrix of a body to its factor
    """

    def __init__(
        self, simulation: Simulation, source: FactorSource, expected_latency: Callable[[BodyUpdateState], float]
    ):
        self._simulation, self._source, self._expected_latency = simulation, source, expected_latency
        self._solver = simulation.scene.solver
        self._requests = count()
        self._requested: dict[int, BodyUpdateState] = {}  # by body, oldest first; what was sent leaves it later
        self._shapes: dict[int, tuple[int, int, int]] = {}  # of the matrices of bodies, with room for all blocks
        self.free: dict[tuple[int, ...], list[NDArray[np.float64]]] = {}  # by shape; pages touched before

    def request(self, state: BodyUpdateState) -> None:
        """Asks the loop to copy when it assembles next: the matrix, or the positions if they suffice."""
        engine, body, job = self._simulation.engine, state.body, state.job
        job.request, job.requested = next(self._requests), time.monotonic()
        self._requested.pop(body.index, None)  # to stand behind all others
        self._requested[body.index] = state
        if self._workers_assemble(state):
            copy = self._allocate((body.last - body.first, 3))
            job.extrapolated = self._extrapolated_time(state)
            engine.request_positions(body.index, copy, job.extrapolated)
        else:
            job.extrapolated = 0.0
            if (shape := self._shapes.get(body.index)) is None:
                shape = self._shapes[body.index] = (self._simulation.system.most_blocks(body.first, body.last), 3, 3)
            own = engine.copy_memory(body.index)
            copy = own if own is not None and own.shape == shape else self._allocate(shape)
            engine.request_matrix(body.index, copy)
        job.set_copy(copy)

    def request_all(self, states: Sequence[BodyUpdateState]) -> None:
        """Does `request` for some bodies, at once where the loop has memory for their matrices."""
        engine = self._simulation.engine
        whole = self._solver.build != "worker" and self._simulation.splits is None
        copies = engine.request_matrices([state.body.index for state in states]) if states and whole else None
        if copies is None:
            for state in states:
                self.request(state)
            return
        now, number = time.monotonic(), self._requests
        for state in states:
            state.job.request, state.job.requested, state.job.extrapolated = next(number), now, 0.0
            self._requested.pop(state.body.index, None)
            self._requested[state.body.index] = state
        on_requests(states, copies)

    def step(self, state: BodyUpdateState) -> int:
        """Returns the steps completed before the one whose matrix was copied; -1: the copy is not there yet."""
        step: int = self._simulation.engine.matrix_step(state.body.index)
        return step

    def completed(self) -> list[tuple[BodyUpdateState, int]]:
        """Returns the bodies whose copy is there, in the order of the requests, and the steps of these copies."""
        steps = self._simulation.engine.matrix_steps(list(self._requested))
        places = np.flatnonzero(steps >= 0)
        if not len(places):
            return []
        states = list(self._requested.values())
        there = [(states[k], step) for k, step in zip(places.tolist(), steps[places].tolist(), strict=True)]
        for state in [state for state, _ in there if state.job.copy is None]:  # sent, or given up
            del self._requested[state.body.index]
        return [each for each in there if each[0].job.copy is not None]

    def suffices(self, state: BodyUpdateState, step: int) -> bool:
        """True if the copy of a step is all that a worker needs. Positions do not tell of the springs of a grab, nor of
        other parameters than those of the start, which may have come between the request and the copy."""
        assert state.job.copy is not None
        if state.job.copy.ndim == 3:
            return True
        simulation = self._simulation
        known = all(e.known_to_workers_at(step) for e in simulation.effects.values())
        return known and simulation.parameters.known_to_workers_at(step)

    def discard(self, state: BodyUpdateState) -> None:
        """Gives up a copy that is not sent."""
        assert state.job.copy is not None
        self.recycle(state.job.copy)
        state.job.set_copy(None)

    def release(self, state: BodyUpdateState, step: int = -1) -> NDArray[np.float64] | None:
        """Recycles the copy of the job in flight, which is over. Returns it if it is the matrix of `step`: to be read
        before the next request."""
        if state.job.matrix is None:
            return None
        (copied, values), state.job.matrix = state.job.matrix, None
        self.recycle(values)
        return values if copied == step and values.ndim == 3 else None

    def hold(
        self, state: BodyUpdateState, step: int
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:  # fmt: skip
        """Returns the copy of the job in flight, which is over, and the same if it is the matrix of `step`. Its memory
        is not used again before `recycle`."""
        if state.job.matrix is None:
            return None, None
        (copied, values), state.job.matrix = state.job.matrix, None
        return values, values if copied == step and values.ndim == 3 else None

    def _allocate(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        free = self.free.setdefault(shape, [])
        return free.pop() if free else np.full(shape, 0.0)

    def recycle(self, copy: NDArray[np.float64]) -> None:
        """Has the memory of a copy used again."""
        if copy.base is None:  # not a view of the system's own values
            self.free.setdefault(copy.shape, []).append(copy)

    def _workers_assemble(self, state: BodyUpdateState) -> bool:
        """True if workers can assemble the matrix from positions: all effects are known to them, there is no contact,
        and fewer than MAX_FAILED_ASSEMBLIES attempts in a row have failed."""
        if self._solver.build != "worker" or self._simulation.contact is not None:
            return False
        if state.failures.assemblies >= MAX_FAILED_ASSEMBLIES:
            return False
        known = all(e.known_to_workers for e in self._simulation.effects.values())
        return known and self._simulation.parameters.known_to_workers and self._source.assembles_matrices()

    def _extrapolated_time(self, state: BodyUpdateState) -> float:
        """Returns by how much positions are extrapolated [s]: to when the factor is expected."""
        return min(self._solver.extrapolate, self._expected_latency(state) * self._simulation.scene.dt)
