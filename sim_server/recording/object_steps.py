# SPDX-License-Identifier: MIT
"""Step records of a loop as ObjectStep messages.

A column of struct Record (kernels/step_record.cuh) is the field of the same name, or that in FIELDS. A
column without a field is not sent. NaN leaves an `optional` field unset.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64
from sim_server.backends.cpu.structs import REACTION_KINDS, RECORD
from sim_server.backends.measured import Measured
from sim_server.recording.wire import encode

FIELDS = {  # of ObjectStep by column, where names differ
    "assemble": "assemble_seconds",
    "solve": "solve_seconds",
    "integrate": "integrate_seconds",
    "whole": "step_seconds",
    "late": "late_seconds",
    "cpu": "cpu_seconds",
    "nonlinear": "nonlinear_residual",
    "kinetic": "kinetic_energy",
    "elastic": "elastic_energy",
    "gravity": "gravity_energy",
}
KINDS = {"kind": "preconditioner", "asked": "asked"}  # field by column, where the field is the name of a Kind
KNOWN = pb.ObjectStep.DESCRIPTOR.fields_by_name
COPIED = {  # field by column, where the value is the same
    column: field
    for column in RECORD.names or ()
    if column not in KINDS and (field := FIELDS.get(column, column)) in KNOWN
}
OPTIONAL = tuple(field for field in (*COPIED.values(), "dissipated") if KNOWN[field].has_presence)


class Encoded(NamedTuple):
    """Message of a step or a frame of an object, serialized. time: of the simulation after the step [s]"""

    object: str
    step: int
    time: float
    data: bytes


class Additions(dict[int, pb.ObjectStep]):
    """Messages with what the records of some numbers have beside their columns."""

    def __missing__(self, number: int) -> pb.ObjectStep:
        self[number] = pb.ObjectStep()
        return self[number]


@dataclass(frozen=True)
class Reactions:
    """What objects exerted in the steps of some records.

    on_obstacles: (records, obstacles, 6), force [N] and torque [N m]
    others: (k,) of structs.REACTION, in the order of steps
    obstacles, bodies: their names
    """

    on_obstacles: Float64
    others: NDArray[Any]
    obstacles: Sequence[str]
    bodies: Sequence[str]

    @property
    def any(self) -> bool:
        """True if there is something that reactions could be on."""
        return bool(self.obstacles) or len(self.others) > 0

    def __getitem__(self, of: Any) -> "Reactions":
        """Returns the same of some of the records. of: a slice, or numbers of records."""
        return Reactions(self.on_obstacles[of], self.others, self.obstacles, self.bodies)

    def add_to(self, steps: Mapping[int, pb.ObjectStep], records: NDArray[Any]) -> None:
        """Adds to the messages of the records what their objects exert. steps: by the number of the record"""
        for number in np.flatnonzero(self.on_obstacles.any(axis=(1, 2))).tolist():
            add_reactions(steps[number], self.on_obstacles[number], self.obstacles)
        if not len(self.others):
            return
        places = zip(records["step"].tolist(), records["body"].tolist(), strict=True)
        of = {place: number for number, place in enumerate(places)}
        for other in self.others:
            found = of.get((int(other["step"]), int(other["body"])))
            if found is not None:
                self._add(steps[found].reactions.add(), other)

    def _add(self, message: pb.Reaction, other: np.void) -> None:
        if other["kind"] == REACTION_KINDS["ON_GRAB"]:
            message.grab = int(other["number"])
        else:
            message.object = self.bodies[other["number"]]
        for name in ("force", "torque", "point"):
            x, y, z = other[name].tolist()
            getattr(message, name).CopyFrom(pb.Vector(x=x, y=y, z=z))


@dataclass(frozen=True)
class Readings:
    """What effects tell of objects in the steps of some records.

    values: (records, most of an object); measured: by object, of its values
    """

    values: Float64
    measured: Mapping[str, Sequence[Measured]]

    def __getitem__(self, of: Any) -> "Readings":
        """Returns the same of some of the records. of: a slice, or numbers of records."""
        return Readings(self.values[of], self.measured)

    def add_to(self, steps: Mapping[int, pb.ObjectStep], names: Sequence[str]) -> None:
        """Adds them to the messages of the records. steps: by the number of the record; names: of their objects"""
        if not self.measured:
            return
        for number, (name, values) in enumerate(zip(names, self.values.tolist(), strict=True)):
            for m, value in zip(self.measured.get(name, ()), values, strict=False):
                steps[number].readings.add(of=m.of, quantity=m.quantity, unit=m.unit, value=value)


def encoded(
    records: NDArray[Any], names: Sequence[str], kinds: Sequence[Sequence[str]], excess: Float64 | None = None,
    age_bound: int = 0, left_out: NDArray[np.int64] | None = None,
) -> list[bytes]:  # fmt: skip
    """Serializes the messages of records (structs.RECORD), but for reactions, readings and interactions.

    names: of their objects. kinds: names of the preconditioners that solves used, and of those that they began with
    excess: (records,) of the scheduler, and the age that factors are to have at most; 0 without them
    left_out: (records,) how many of its object before each are not in the log
    """
    common = list(zip(names, *kinds, strict=True))
    numbers = {each: k for k, each in enumerate(dict.fromkeys(common))}
    prefixes = [_prefix(*each) for each in numbers]
    number = np.fromiter(map(numbers.__getitem__, common), np.int64, len(common))
    columns: dict[str, NDArray[Any]] = {field: records[column] for column, field in COPIED.items()}
    one = records["nonlinear"] == -1  # no Newton-Raphson
    columns["linearizations"] = np.where(one, 0, records["linearizations"])
    columns["nonlinear_residual"] = np.where(one, 0.0, records["nonlinear"])
    with np.errstate(all="ignore"):  # a body that blew up
        columns["dissipated"] = records["budget"] - records["kinetic"] - records["elastic"]
    made = records["factor_step"]
    columns["factor_age"] = np.where(made >= 0, records["step"] - 1 - made, -1)
    columns["factor_age_bound"] = np.full(len(records), age_bound, np.int64)
    if excess is not None:
        columns["excess"] = excess
    if left_out is not None:
        columns["left_out"] = left_out
    return encode(KNOWN, columns, prefixes, number)


@lru_cache(1 << 16)
def _prefix(name: str, used: str, asked: str) -> bytes:
    """Returns what messages of an object have in common, serialized."""
    header = pb.Header(object=name, epoch=1)
    step = pb.ObjectStep(header=header, preconditioner=used, asked=asked if asked != used else "")
    return step.SerializeToString()


def add_reactions(step: pb.ObjectStep, reactions: Float64, obstacles: Sequence[str]) -> None:
    """Adds to a step what its object exerts on obstacles, but for what is 0.

    reactions: (obstacles, 6), force [N] and torque [N m] on each
    """
    for number in np.flatnonzero(reactions.any(axis=1)).tolist():
        fx, fy, fz, tx, ty, tz = reactions[number].tolist()
        force, torque = pb.Vector(x=fx, y=fy, z=fz), pb.Vector(x=tx, y=ty, z=tz)
        step.reactions.add(obstacle=obstacles[number], force=force, torque=torque)
