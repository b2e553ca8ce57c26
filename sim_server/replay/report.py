# SPDX-License-Identifier: MIT
"""What a replay found: the first divergence from the log, the largest one, and how much was compared."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.engine import Kind
from sim_server.replay.log import Recording

Pair = tuple[NDArray[np.float64], NDArray[np.float64]]
COMPARED = ("iterations", "residual", "status", "kind", "fallbacks", "factor_step", "linearizations", "kinetic", "work")
TOLD_LATER = ("kinetic", "work")  # NaN in a log of a version that did not tell


class Comparison:
    """Collects; `same` once nothing differed in a single bit."""

    def __init__(self, recording: Recording):
        self.recording = recording
        self.notes = list(recording.notes)
        self.first: dict[str, Any] | None = None  # step, object, what, detail; of what differed first
        self.largest: dict[str, Any] | None = None  # step, object, node, distance [m]
        self.other_factor: dict[str, Any] | None = None  # step, object, detail: the first that is not the recorded one
        self.solves_compared = self.solves_different = 0
        self.frames_compared = self.frames_different = 0

    @property
    def same(self) -> bool:
        """No divergence."""
        return self.first is None

    def diverged(self, step: int, name: str, what: str, detail: str) -> None:
        """Something differs; only the first is told."""
        if self.first is None:
            self.first = {"step": step, "object": name, "what": what, "detail": detail}

    def factor(self, step: int, name: str, detail: str) -> None:
        """A factor is not the recorded one. No divergence by itself: what it was used for shows that."""
        if self.other_factor is None:
            self.other_factor = {"step": step, "object": name, "detail": detail}

    def solves(self, records: NDArray[Any], rows: list[Any]) -> None:
        """One step: records of the engine and rows of the log, one a body in order."""
        for record, row, name in zip(records, rows, self.recording.scene.objects, strict=True):
            self.solves_compared += 1
            told = [n for n in COMPARED if n not in TOLD_LATER or not math.isnan(row[n])]
            different = [n for n in told if not _same(record[n], row[n])]
            if different:
                self.solves_different += 1
                detail = ", ".join(f"{n} {_shown(n, record[n])}, recorded {_shown(n, row[n])}" for n in different)
                self.diverged(int(row["step"]), name, "solve", detail)

    def frame(self, step: int, name: str, recorded: Pair, now: Pair) -> None:
        """Positions and velocities (nodes, 3) of one object after a step."""
        self.frames_compared += 1
        if all(a.tobytes() == b.tobytes() for a, b in zip(recorded, now, strict=True)):
            return
        self.frames_different += 1
        node, distance = _farthest(recorded[0], now[0])
        _, speed = _farthest(recorded[1], now[1])
        self.diverged(step, name, "frame", f"positions differ by up to {distance:.3g} m, velocities {speed:.3g} m/s")
        if self.largest is None or not distance <= self.largest["distance"]:
            self.largest = {"step": step, "object": name, "node": node, "distance": distance}

    def lines(self) -> list[str]:
        """For people."""
        steps, counts = self.recording.steps, f"{self.solves_compared} solves, {self.frames_compared} frames"
        lines = [f"note: {note}" for note in self.notes]
        if self.other_factor:
            f = self.other_factor
            lines.append(f"the factor of step {f['step']}, object {f['object']!r}, is another: {f['detail']}")
        if self.first is None:
            return [*lines, f"{steps} steps repeated, the same bit for bit ({counts} compared)"]
        f = self.first
        lines.append(f"diverged at step {f['step']}, object {f['object']!r}: {f['detail']}")
        if self.largest:
            m = self.largest
            lines.append(
                f"largest difference of positions: {m['distance']:.3g} m at step {m['step']}, object {m['object']!r}, "
                f"node {m['node']}"
            )
        different = f"{self.solves_different} of {self.solves_compared} solves"
        return [
            *lines,
            f"{steps} steps repeated; {different}, {self.frames_different} of {self.frames_compared} frames differ",
        ]

    def plain(self) -> dict[str, Any]:
        """For programs."""
        largest = self.largest and {**self.largest, "distance": _finite(self.largest["distance"])}
        return {
            "same": self.same, "steps": self.recording.steps, "first": self.first, "largest": largest,
            "other_factor": self.other_factor, "solves": self.solves_compared,
            "solves_different": self.solves_different, "frames": self.frames_compared,
            "frames_different": self.frames_different, "notes": self.notes,
        }  # fmt: skip


def _same(a: Any, b: Any) -> bool:
    return bool(a == b) or (math.isnan(a) and math.isnan(b))


def _shown(name: str, value: Any) -> str:
    if name == "status":
        return pb.SolveStatus.Name(int(value)).lower()
    if name == "kind":
        return Kind(int(value)).name.lower()
    return repr(float(value)) if name in ("residual", *TOLD_LATER) else str(int(value))


def _farthest(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[int, float]:
    distance = np.linalg.norm(a - b, axis=1)
    node = int(distance.argmax())
    return node, float(distance[node])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
