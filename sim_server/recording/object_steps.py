# SPDX-License-Identifier: MIT
"""Step records of a loop as ObjectStep messages.

A column of struct Record (backends/cpu/native/ring_buffers.h) is the field of the same name, or that in FIELDS. A
column without a field is not sent. NaN leaves an `optional` field unset.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64
from sim_server.backends.cpu.structs import REACTION_KINDS, RECORD
from sim_server.backends.kinds import Kind
from sim_server.backends.measured import Measured

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

    def add_to(self, steps: Sequence[pb.ObjectStep]) -> None:
        """Adds to the steps of the records what their objects exert."""
        if not self.any:
            return
        for step, each in zip(steps, self.on_obstacles, strict=True):
            add_reactions(step, each, self.obstacles)
        if not len(self.others):
            return
        of = {(step.step, step.header.object): step for step in steps}
        for other in self.others:
            found = of.get((int(other["step"]), self.bodies[other["body"]]))
            if found is not None:
                self._add(found.reactions.add(), other)

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

    def add_to(self, steps: Sequence[pb.ObjectStep]) -> None:
        """Adds them to the steps of the records."""
        if not self.measured:
            return
        for step, values in zip(steps, self.values.tolist(), strict=True):
            for m, value in zip(self.measured.get(step.header.object, ()), values, strict=False):
                step.readings.add(of=m.of, quantity=m.quantity, unit=m.unit, value=value)


def rows(records: NDArray[Any]) -> list[dict[str, Any]]:
    """Step records (structs.RECORD) as dictionaries of Python numbers."""
    names = records.dtype.names or ()
    columns = [records[name].tolist() for name in names]
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def object_step(record: dict[str, Any], name: str, kinds: dict[Kind, str]) -> pb.ObjectStep:
    """Makes the message of one record, but for reactions. name: of the object. kinds: names of preconditioners."""
    made, kind, asked = record["factor_step"], record["kind"], record["asked"]
    values = {field: record[column] for column, field in COPIED.items()}
    values["dissipated"] = record["budget"] - record["kinetic"] - record["elastic"]
    for field in OPTIONAL:
        if values[field] != values[field]:
            del values[field]
    if record["nonlinear"] == -1:  # no Newton-Raphson
        values["linearizations"] = values["nonlinear_residual"] = 0
    return pb.ObjectStep(
        header=pb.Header(object=name, epoch=1),
        factor_age=record["step"] - 1 - made if made >= 0 else -1,
        preconditioner=kinds[Kind(kind)],
        asked=kinds[Kind(asked)] if asked != kind else "",
        **values,
    )


def add_reactions(step: pb.ObjectStep, reactions: Float64, obstacles: Sequence[str]) -> None:
    """Adds to a step what its object exerts on obstacles, but for what is 0.

    reactions: (obstacles, 6), force [N] and torque [N m] on each
    """
    for number in np.flatnonzero(reactions.any(axis=1)).tolist():
        fx, fy, fz, tx, ty, tz = reactions[number].tolist()
        force, torque = pb.Vector(x=fx, y=fy, z=fz), pb.Vector(x=tx, y=ty, z=tz)
        step.reactions.add(obstacle=obstacles[number], force=force, torque=torque)
