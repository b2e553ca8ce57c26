# SPDX-License-Identifier: MIT
"""What the last steps of a run came to: times, iterations, energies, events, and the last step of each object."""

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.backends.ring_buffers import as_bytes
from sim_server.recording import messages
from sim_server.recording.object_steps import Additions, Reactions, Readings
from sim_server.service.event_counts import EventCounts
from sim_server.updates.driver import Driver

STATISTICS_STEPS = 1000  # last steps that percentiles and means are taken over


class RunSummary:
    """Takes records in as they come.

    seconds: wall time of the last steps [s]
    """

    def __init__(self, driver: Driver):
        self.driver, self.simulation = driver, driver.simulation
        bodies = len(self.simulation.world.bodies)
        self.seconds: deque[float] = deque(maxlen=STATISTICS_STEPS)
        self.events = EventCounts()
        self._window = np.zeros((bodies, STATISTICS_STEPS), np.int32)  # iterations of the last steps
        self._told = np.zeros(bodies, np.int64)  # steps of each body
        self._last: NDArray[Any] = np.zeros(bodies, driver.engine.records_dtype)
        self._last_reactions: dict[int, tuple[Reactions, int]] = {}  # by body, and the number of its record in them
        self._last_readings: dict[int, Readings] = {}  # by body, one record
        self._energy = np.full(bodies, np.nan)  # by body, of the last step with all of kinetic, elastic and gravity [J]

    def update(
        self, records: NDArray[Any], reactions: Reactions | None = None, readings: Readings | None = None
    ) -> None:
        """Takes records in; reactions, readings: of these records."""
        order = np.argsort(records["body"], kind="stable")
        present, first, counts = np.unique(records["body"][order], return_index=True, return_counts=True)
        at = self._told[present].repeat(counts) + np.arange(len(order)) - first.repeat(counts)
        self._window[present.repeat(counts), at % STATISTICS_STEPS] = records["iterations"][order]
        self._told[present] += counts
        newest = order[first + counts - 1]
        as_bytes(self._last)[present] = as_bytes(records)[newest]
        self.events.add(records)
        if reactions is not None and reactions.any:
            for body, record in zip(present.tolist(), newest.tolist(), strict=True):
                self._last_reactions[body] = reactions, record
        if readings is not None and readings.measured:
            for body, record in zip(present.tolist(), newest.tolist(), strict=True):
                self._last_readings[body] = readings[record : record + 1]
        with np.errstate(all="ignore"):  # a body that blew up
            energy = records["kinetic"] + records["elastic"] + records["gravity"]
        evaluated = np.flatnonzero(np.isfinite(records["elastic"]))
        self._energy[records["body"][evaluated]] = energy[evaluated]

    def latest(self, bound: int) -> dict[int, pb.ObjectStep]:
        """Returns the last steps by body. bound: age that factors are to have at most"""
        bodies, additions = np.flatnonzero(self._told), Additions()
        records = self._last[bodies]
        for number, body in enumerate(bodies.tolist()):
            own, record = Additions(), records[number : number + 1]
            if body in self._last_reactions:
                reactions, at = self._last_reactions[body]
                reactions[at : at + 1].add_to(own, record)
            if body in self._last_readings:
                self._last_readings[body].add_to(own, [self.simulation.world.bodies[body].name])
            if own:
                additions[number] = own[0]
        excess = np.array([self.driver.bodies[body].solves.excess for body in bodies.tolist()])
        steps = messages.encoded_steps(
            self.simulation, records, self.driver.method, excess=excess, age_bound=bound, additions=additions
        )
        return {body: pb.ObjectStep.FromString(s.data) for body, s in zip(bodies.tolist(), steps, strict=True)}

    def mean_iterations(self) -> NDArray[np.float64]:
        """Returns the mean iterations of the last steps, by body."""
        means: NDArray[np.float64] = self._window.sum(axis=1) / np.clip(self._told, 1, STATISTICS_STEPS)
        return means

    def total_energy(self, body: int) -> float | None:
        """Returns kinetic, elastic and gravity energy [J] of the last step that has all; None: there is none."""
        energy = float(self._energy[body])
        return None if np.isnan(energy) else energy

    def percentiles(self) -> tuple[float, float, float]:
        """Returns p50, p99 and maximum of the time [s] of the last steps."""
        if not self.seconds:
            return 0.0, 0.0, 0.0
        seconds = np.array(self.seconds)
        return float(np.percentile(seconds, 50)), float(np.percentile(seconds, 99)), float(seconds.max())
