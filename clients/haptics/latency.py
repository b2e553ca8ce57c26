# SPDX-License-Identifier: MIT
"""How late forces are: from each move to the first force of a step that was made with it, or with a newer one."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from protocol import messages_pb2 as pb

KEPT = 1 << 16  # moves that wait for their force, and latencies


class Latency:
    """Collects moves as they are sent and messages of the channel `reactions` as they come, from two threads.

    client, obstacle: whose moves. dt: time step of the simulation [s]
    """

    def __init__(self, client: str, obstacle: str, dt: float) -> None:
        self._client, self._obstacle, self._dt = client, obstacle, dt
        self._lock = threading.Lock()
        self._sent: deque[tuple[int, float, int]] = deque(maxlen=KEPT)  # number, time, newest step that was known
        self._taken: deque[tuple[int, int]] = deque(maxlen=KEPT)  # number, steps before the first one with it
        self._seconds: deque[float] = deque(maxlen=KEPT)
        self._steps: deque[int] = deque(maxlen=KEPT)
        self._came: deque[tuple[int, float]] = deque(maxlen=KEPT)  # step, time
        self._newest = -1
        self.missing = 0  # steps that did not come

    def sent(self, number: int, now: float) -> None:
        """Notes a move that is sent at `now` [s]."""
        with self._lock:
            self._sent.append((number, now, self._newest))

    def came(self, batch: pb.Steps, now: float) -> None:
        """Takes a message that came at `now` [s]."""
        with self._lock:
            for move in batch.moves:
                if move.client == self._client and move.obstacle == self._obstacle:
                    self._taken.append((move.move, move.step))
            for step in batch.steps:
                if step.step > self._newest:
                    if self._newest >= 0:
                        self.missing += step.step - self._newest - 1
                    self._newest = step.step
                    self._came.append((step.step, now))
            while self._taken and self._taken[0][1] < self._newest:
                self._know(self._taken.popleft(), now)

    def _know(self, taken: tuple[int, int], now: float) -> None:
        number, before = taken
        while self._sent and self._sent[0][0] <= number:
            _, at, known = self._sent.popleft()
            self._seconds.append(now - at)
            if known >= 0:
                self._steps.append(before + 1 - known)

    def result(self) -> dict[str, float | int]:
        """Returns percentiles of delays [ms, steps] and of the channel's jitter [ms], and counts.

        jitter: how far the time between two steps that came differs from that between the steps in the simulation
        """
        with self._lock:
            seconds, steps = np.array(self._seconds), np.array(self._steps)
            came = np.array(self._came, dtype=float).reshape(-1, 2)
        if len(seconds) == 0 or len(came) < 3:
            return {"moves": len(seconds), "steps": len(came), "missing": self.missing}
        gaps = np.diff(came, axis=0)
        jitter = gaps[:, 1] - gaps[:, 0] * self._dt
        found: dict[str, float | int] = {"moves": len(seconds), "steps": len(came), "missing": self.missing}
        found["steps_per_second"] = float((len(came) - 1) / (came[-1, 1] - came[0, 1]))
        for name, values in (("ms", 1e3 * seconds), ("steps_late", steps), ("jitter_ms", 1e3 * np.abs(jitter))):
            if len(values):
                p50, p99 = np.percentile(values, [50, 99])
                found |= {f"{name}_p50": float(p50), f"{name}_p99": float(p99), f"{name}_max": float(values.max())}
        return found
