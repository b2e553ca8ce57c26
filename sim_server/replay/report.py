# SPDX-License-Identifier: MIT
"""Result of a replay: the first divergence from the log, the largest one, and how much was compared."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64
from sim_server.backends.kinds import Kind
from sim_server.replay.log import COMPARED, OPTIONAL, Recording, reaction_digests

Pair = tuple[Float64, Float64]


class Comparison:
    """Collects the differences between a replay and its log.

    first: step, object, kind and details of the first difference
    largest: step, object, node and distance [m] of the largest difference of positions
    other_factor: step, object and details of the first factor that is not the recorded one
    kinds: of reactions that the log has and a replay is to repeat
    """

    def __init__(self, recording: Recording):
        self.recording = recording
        self.notes = list(recording.notes)
        self.first: dict[str, Any] | None = None
        self.largest: dict[str, Any] | None = None
        self.other_factor: dict[str, Any] | None = None
        self.solves_compared = self.solves_different = 0
        self.frames_compared = self.frames_different = 0
        self.kinds = {kind for each in recording.objects.values() for _, kind in each.reactions}

    @property
    def same(self) -> bool:
        """True if nothing compared so far differed in a single bit."""
        return self.first is None

    def diverged(self, step: int, name: str, what: str, detail: str) -> None:
        """Notes a difference; only the first is kept."""
        if self.first is None:
            self.first = {"step": step, "object": name, "what": what, "detail": detail}

    def factor(self, step: int, name: str, detail: str) -> None:
        """Notes a factor that is not the recorded one. No divergence by itself: the solves that use it show that."""
        if self.other_factor is None:
            self.other_factor = {"step": step, "object": name, "detail": detail}

    def solves(self, records: NDArray[Any], rows: list[Any]) -> None:
        """Compares one step: records of the engine with rows of the log, one for each body, in order; None: the log
        has none."""
        for record, row, name in zip(records, rows, self.recording.scene.objects, strict=True):
            if row is None:
                continue
            self.solves_compared += 1
            recorded = [n for n in COMPARED if n not in OPTIONAL or not math.isnan(row[n])]
            different = [n for n in recorded if not _same(record[n], row[n])]
            if different:
                self.solves_different += 1
                detail = ", ".join(f"{n} {_shown(n, record[n])}, recorded {_shown(n, row[n])}" for n in different)
                self.diverged(int(row["step"]), name, "solve", detail)

    def reactions(self, steps: list[pb.ObjectStep]) -> None:
        """Compares what objects exerted in a step, of the kinds that the log has."""
        for step in steps:
            name = step.header.object
            now, then = reaction_digests(step), self.recording.objects[name].reactions
            for kind in sorted(self.kinds):
                if now.get(kind) != then.get((step.step, kind)):
                    what = "reading" if kind == "reading" else "reaction"
                    said = "other readings" if kind == "reading" else f"other forces on {kind}s"
                    self.diverged(step.step, name, what, f"{said} than recorded")

    def frame(self, step: int, name: str, recorded: Pair, now: Pair) -> None:
        """Compares positions and velocities (nodes, 3) of one object after a step."""
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
        """Returns the result as text."""
        steps, counts = (
            self.recording.steps - self.recording.first,
            f"{self.solves_compared} solves, {self.frames_compared} frames",
        )
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
        """Returns the result as JSON types."""
        steps = self.recording.steps - self.recording.first
        largest = self.largest and {**self.largest, "distance": _finite(self.largest["distance"])}
        return {
            "same": self.same, "steps": steps, "first": self.first, "largest": largest,
            "other_factor": self.other_factor, "solves": self.solves_compared,
            "solves_different": self.solves_different, "frames": self.frames_compared,
            "frames_different": self.frames_different, "notes": self.notes,
        }  # fmt: skip


def _same(a: Any, b: Any) -> bool:
    return bool(a == b) or (math.isnan(a) and math.isnan(b))


def _shown(name: str, value: Any) -> str:
    if name == "status":
        return pb.SolveStatus.Name(int(value)).lower()
    if name == "form":
        return pb.StepForm.Name(int(value)).lower()
    if name == "kind":
        return Kind(int(value)).name.lower()
    return repr(float(value)) if name in ("residual", *OPTIONAL) else str(int(value))


def _farthest(a: Float64, b: Float64) -> tuple[int, float]:
    distance = np.linalg.norm(a - b, axis=1)
    node = int(distance.argmax())
    return node, float(distance[node])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
