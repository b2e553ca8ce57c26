# SPDX-License-Identifier: MIT
"""Copies of matrices, or of positions, that the loop makes for workers: requested, kept, used again.

The loop copies as it assembles, into memory that it is given here. A copy that was sent is kept until its factor came,
which is checked with it; then its memory is used again, so that in the long run none is added.
"""

import time
from collections.abc import Callable, Sequence

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.simulation import Simulation
from sim_server.updates.body_state import BodyUpdateState, on_requests
from sim_server.updates.factor_source import FactorSource
from sim_server.updates.update_table import NONE, UpdateTable

MAX_FAILED_ASSEMBLIES = 3  # jobs in a row with positions without a factor, after which matrices are sent for good


class SnapshotPool:
    """Copies for the bodies of one simulation.

    source: says whether workers can assemble matrices from positions
    expected_latency: steps from the matrix of a body to its factor
    """

    def __init__(
        self, simulation: Simulation, source: FactorSource, table: UpdateTable,
        expected_latency: Callable[[BodyUpdateState], float],
    ):  # fmt: skip
        self._simulation, self._source, self._expected_latency = simulation, source, expected_latency
        self._solver, self._table = simulation.scene.solver, table
        self._requests = 0  # so far
        self._shapes: dict[int, tuple[int, int, int]] = {}  # of the matrices of bodies, with room for all blocks
        self.free: dict[tuple[int, ...], list[Float64]] = {}  # by shape; pages touched before

    def request(self, state: BodyUpdateState) -> None:
        """Asks the loop to copy when it assembles next: the matrix, or the positions if they suffice."""
        engine, body, job = self._simulation.engine, state.body, state.job
        job.request, job.requested = self._requests, time.monotonic()
        self._requests += 1
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

    def request_all(self, bodies: Sequence[int] | Int64, states: Sequence[BodyUpdateState]) -> None:
        """Does `request` for some bodies, at once where the loop has memory for their matrices. states: of all"""
        engine, rows = self._simulation.engine, np.asarray(bodies, np.int64)
        whole = self._solver.build != "worker" and self._simulation.splits is None
        memory = engine.request_matrices(rows) if len(rows) and whole else None
        if memory is None:
            for row in rows.tolist():
                self.request(states[row])
            return
        on_requests(self._table, rows, *memory, self._requests, time.monotonic())
        self._requests += len(rows)

    def step(self, state: BodyUpdateState) -> int:
        """Returns the steps completed before the one whose matrix was copied; -1: the copy is not there yet."""
        step: int = self._simulation.engine.matrix_step(state.body.index)
        return step

    def completed(self) -> tuple[Int64, Int64]:
        """Returns the bodies whose copy is there, in the order of the requests, and the steps of these copies."""
        waiting = self._table.in_order_of_requests()
        steps = self._simulation.engine.matrix_steps(waiting)
        there = steps >= 0
        return waiting[there], steps[there]

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

    def release(self, state: BodyUpdateState, step: int = -1) -> Float64 | None:
        """Recycles the copy of the job in flight, which is over. Returns it if it is the matrix of `step`: to be read
        before the next request."""
        if state.job.matrix is None:
            return None
        (copied, values), state.job.matrix = state.job.matrix, None
        self.recycle(values)
        return values if copied == step and values.ndim == 3 else None

    def release_all(self, bodies: Int64) -> None:
        """Does `release` for some bodies, whose copies nobody reads any more."""
        held, matrices = self._table.matrices, [self._table.matrices[body] for body in bodies.tolist()]
        for body, matrix in zip(bodies.tolist(), matrices, strict=True):
            if matrix is not None:
                self.recycle(matrix)
                held[body] = None
        self._table.matrix_steps[bodies] = NONE

    def hold(self, state: BodyUpdateState, step: int) -> tuple[Float64 | None, Float64 | None]:
        """Returns the copy of the job in flight, which is over, and the same if it is the matrix of `step`. Its memory
        is not used again before `recycle`."""
        if state.job.matrix is None:
            return None, None
        (copied, values), state.job.matrix = state.job.matrix, None
        return values, values if copied == step and values.ndim == 3 else None

    def _allocate(self, shape: tuple[int, ...]) -> Float64:
        free = self.free.setdefault(shape, [])
        return free.pop() if free else np.full(shape, 0.0)

    def recycle(self, copy: Float64) -> None:
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
