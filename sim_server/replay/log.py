# SPDX-License-Identifier: MIT
"""Reads a log for a replay: scene, step records and the places of frames, up to the first gap.

A log is read twice: once for what each solve used, and then frame by frame as the replay reaches them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.log_chunks import BadLog
from protocol.log_file import KEPT_EVERY, LogFile, LogMessage
from protocol.refused import Refused
from protocol.validate import array, checksum
from sim_server.arrays import Float64
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.kinds import Kind
from sim_server.recording import object_steps
from sim_server.scene.solver_options import FACTORS

COMPARED = (
    "iterations", "residual", "status", "kind", "fallbacks", "factor_step", "linearizations", "form", "estimate",
    "kinetic", "work", "contacts", "passes", "clipped", "contact_residual", "substeps", "halvings",
    "solve_error", "step_error",
)  # fmt: skip
INPUTS = ("step", "asked", "probe")
ROW = np.dtype([(name, "f8" if RECORD[name].kind == "f" else "i8") for name in (*INPUTS, *COMPARED)])
"""Input and result of a solve: columns of the step record, from an ObjectStep."""
FIELDS = {name: (object_steps.COPIED | object_steps.KINDS)[name] for name in ROW.names or ()}
OPTIONAL = tuple(name for name in COMPARED if FIELDS[name] in object_steps.OPTIONAL)
"""NaN in logs of versions that did not record them, and in steps without a value."""
_PACK = struct.Struct("<" + "".join("d" if ROW[name].kind == "f" else "q" for name in ROW.names or ()))
_KINDS = {kind.name.lower(): int(kind) for kind in Kind} | dict.fromkeys(FACTORS, int(Kind.CHOLESKY))


@dataclass
class RecordedObject:
    """What a log holds of one object.

    packed: step records in the order of the log, packed; empty once `rows` is made
    frames: (offset, number) of each (log_file.py), by step
    factors: by the step whose matrix they were made from
    rows: of type ROW; rows[k] is of step first + k + 1
    left_out: by step, how many records before it were left out, as the log could not follow
    filled: (rows,) True where the record was left out: the row tells what the solve was given, and nothing else
    reactions: by step and kind, digests of those that there are
    """

    topology: pb.Topology | None = None
    packed: bytearray = field(default_factory=bytearray)
    frames: dict[int, tuple[int, int]] = field(default_factory=dict)
    factors: dict[int, pb.FactorUse] = field(default_factory=dict)
    rows: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, ROW))
    left_out: dict[int, int] = field(default_factory=dict)
    filled: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    reactions: dict[tuple[int, str], int] = field(default_factory=dict)


class Recording:
    """A log to be repeated.

    Raises BadLog if the file is no log, is of another protocol version, or cannot be repeated at all.

    first: steps before the run began, 0 unless it went on from a checkpoint; checkpoint: that file
    steps: last step that can be repeated
    notes: why the replay ends there, and what is missing in the log
    touched: the run had pushes or grabs
    """

    def __init__(self, path: str | Path, progress: Callable[[int], None] = lambda _: None):
        self.path = Path(path)
        self.scene = pb.Scene()
        self.objects: dict[str, RecordedObject] = {}
        self.touch: list[pb.TouchSet] = []
        self.obstacles: dict[str, pb.Obstacle] = {}
        self.targets: list[pb.ObstacleTargets] = []
        self.parameters: dict[int, list[pb.ParameterSet]] = {}  # by step
        self.resets: list[tuple[pb.Reset, int]] = []  # and how many of `parameters` of its step came before
        self.first, self.checkpoint = 0, b""
        self.touched = False
        self.notes: list[str] = []
        self._file = LogFile.open(self.path)
        malformed: list[str] = []
        try:
            for message in self._file.messages(progress):
                try:
                    self._keep(message)
                except (DecodeError, Refused, KeyError, struct.error) as error:
                    malformed.append(str(error))
            self.notes += self._file.notes()
            if malformed:
                self.notes.append(f"{self.path}: {len(malformed)} malformed messages left out, first: {malformed[0]}")
            self.steps = self._complete()
            self._check()
        except BaseException:
            self.close()
            raise

    @property
    def device(self) -> str:
        """Device of the recorded run, "cpu" or "gpu"."""
        return self.scene.device or ("cpu" if ", cpu," in self.scene.software else "gpu")  # old logs tell in `software`

    def frame(self, name: str, step: int) -> tuple[Float64, Float64] | None:
        """Returns x [m] and v [m/s], (nodes, 3), of an object after a step; None if the log has no such frame."""
        position = self.objects[name].frames.get(step)
        if position is None:
            return None
        state = pb.State.FromString(self._file.data(*position))
        shape = (state.nodes, 3)
        return array(state.x, np.float64, shape, "State.x"), array(state.v, np.float64, shape, "State.v")

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _keep(self, message: LogMessage) -> None:
        if message.topic == "/scene":
            self.scene = pb.Scene.FromString(message.data)
        elif message.topic == "/touch":
            self.touch.append(pb.TouchSet.FromString(message.data))
        elif message.topic == "/targets":
            self.targets.append(pb.ObstacleTargets.FromString(message.data))
        elif message.topic == "/parameters":
            found = pb.ParameterSet.FromString(message.data)
            self.parameters.setdefault(found.step, []).append(found)
        elif message.topic == "/checkpoint":
            saved = pb.Checkpoint.FromString(message.data)
            self.first, self.checkpoint = saved.step, saved.data
        elif message.topic == "/resets":
            reset = pb.Reset.FromString(message.data)
            self.resets.append((reset, len(self.parameters.get(reset.step, ()))))
        elif message.kind == "obstacle":
            self.obstacles[message.object] = pb.Obstacle.FromString(message.data)
        elif message.kind != "pose":  # which follow from the scene and the targets
            self._keep_of_object(message)

    def _keep_of_object(self, message: LogMessage) -> None:
        kind, data = message.kind, message.data
        if kind not in ("topology", "state", "interaction", "factor", "step") or not message.object:
            raise Refused("a message of an unknown channel")
        found = self.objects.setdefault(message.object, RecordedObject())
        if kind == "topology":
            topology = pb.Topology.FromString(data)
            if found.topology is None:  # others follow from the parameters
                found.topology = topology
        elif kind == "state":
            found.frames[pb.State.FromString(data).step] = message.offset, message.number
        elif kind == "interaction":
            self.touched = True
        elif kind == "factor":
            factor = pb.FactorUse.FromString(data)
            found.factors[factor.step] = factor
        elif kind == "step":
            s = pb.ObjectStep.FromString(data)
            found.packed += _PACK.pack(*_row(s).values())
            if s.left_out:
                found.left_out[s.step] = s.left_out
            found.reactions |= {(s.step, kind): digest for kind, digest in reaction_digests(s).items()}

    def _complete(self) -> int:
        """Sorts the rows; returns the last step up to which no object lacks a row."""
        last, most, gap = [], 0, ""
        for name in self.scene.objects:
            found = self.objects.setdefault(name, RecordedObject())
            rows, found.filled = filled(np.sort(np.frombuffer(bytes(found.packed), ROW), order="step"), found.left_out)
            found.packed = bytearray()
            whole = len(rows)
            wrong = np.flatnonzero(rows["step"] != self.first + np.arange(1, len(rows) + 1))
            if len(wrong):
                whole = int(wrong[0])
                gap = f"{self.path}: no record of object {name!r}, step {self.first + whole + 1}"
            found.rows = rows[:whole]
            last.append(self.first + whole)
            most = max(most, int(rows["step"].max(initial=0)))
        steps = min(last, default=0)
        if steps < most and gap:
            self.notes.append(f"{gap}: the replay ends before it, the log at step {most}")
        if thinned := sum(int(found.filled.sum()) for found in self.objects.values()):
            self.notes.append(
                f"{self.path}: {thinned} step records were left out, as the log could not follow: their steps are "
                "repeated and not compared"
            )
        return steps

    def _check(self) -> None:
        if not self.scene.resolved:
            raise BadLog(f"{self.path}: the log holds no scene; its beginning is damaged")
        if missing := [name for name in self.scene.objects if self.objects[name].topology is None]:
            raise BadLog(f"{self.path}: the log holds no mesh of {', '.join(missing)}; it is damaged")
        if self._file.begins_late:
            raise BadLog(f"{self.path}: the first file of this log is gone, without which no run can be repeated")
        if self.steps <= self.first:
            raise BadLog(f"{self.path}: the log holds no step that could be repeated")
        if self.device == "gpu" and self.touched and not self.touch:
            self.notes.append(
                f"{self.path}: written by an older version, which did not record when a GPU took up pushes and grabs: "
                "the replay diverges with the first of them"
            )
        if not self.scene.build:
            self.notes.append(
                f"{self.path}: written by an older version, which did not record the build, the steps at which pushes "
                "and grabs took effect, and probes of the automatic preconditioner: only runs without these repeat"
            )


def filled(rows: NDArray[np.void], left_out: dict[int, int]) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
    """Adds the rows of steps whose records were left out, and returns which these are. rows: (k,) by step"""
    gaps = np.diff(rows["step"]) - 1
    told = np.array([left_out.get(step, 0) for step in rows["step"][1:].tolist()], np.int64)
    gaps[(gaps != told) | (gaps >= KEPT_EVERY) | (gaps < 0)] = 0  # others are losses
    counts = np.ones(len(rows), np.int64)
    counts[:-1] += gaps
    source = np.arange(len(rows)).repeat(counts)
    whole, after = rows[source], np.arange(len(source)) - (np.cumsum(counts) - counts)[source]
    whole["step"] += after
    whole["status"][after > 0] = pb.CONVERGED
    return whole, after > 0


def reaction_digests(message: pb.ObjectStep) -> dict[str, int]:
    """Returns a digest of the reactions of a step by kind: obstacle, object, grab; and of its readings: reading."""
    kinds: dict[str, bytes] = {}
    for reaction in message.reactions:
        kind = reaction.WhichOneof("on") or ""
        kinds[kind] = kinds.get(kind, b"") + reaction.SerializeToString(deterministic=True)
    for told in message.readings:
        kinds["reading"] = kinds.get("reading", b"") + told.SerializeToString(deterministic=True)
    return {kind: checksum(data) for kind, data in kinds.items()}


def _row(message: pb.ObjectStep) -> dict[str, Any]:
    """Values of the columns of ROW, in its order."""
    row = {name: getattr(message, field) for name, field in FIELDS.items()}
    for name in OPTIONAL:
        if not message.HasField(FIELDS[name]):  # type: ignore[arg-type]
            row[name] = math.nan
    row["kind"] = _KINDS[message.preconditioner]
    row["asked"] = _KINDS[message.asked] if message.asked else row["kind"]
    row["linearizations"] = max(message.linearizations, 1)
    return row
