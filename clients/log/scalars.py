# SPDX-License-Identifier: MIT
"""Scalars per step of an object as columns: names, types and order for export, plots and tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from numpy.typing import NDArray

from protocol import messages_pb2 as pb

Columns = dict[str, NDArray]
V = TypeVar("V")

INPUTS = ("asked", "probe", "left_out")  # for replays only
REACTION = "reaction/"  # columns reaction/WHAT/force_x to torque_z [N, N m] and point_z [m]
REACTIONS = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z", "point_x", "point_y", "point_z")
"""Of what the object exerts on WHAT (`reaction_name`); the point only where the torque is about one of its own."""


MOST_READINGS, MOST_REACTIONS = 1024, 256  # names that a log may have of each in the steps of an object
READING = "reading/"  # columns reading/WHAT/QUANTITY: reading/cavity/pressure [Pa], reading/cable[1]/tension [N]


def _dtype(field: Any) -> str:
    if field.type == FieldDescriptor.TYPE_DOUBLE:
        return "f8"
    return "U24" if field.type in (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_ENUM) else "i8"


_FIELDS = [f for f in pb.ObjectStep.DESCRIPTOR.fields if f.message_type is None and f.name not in INPUTS]
DTYPES: dict[str, str] = {f.name: _dtype(f) for f in _FIELDS}
"""Type by name, in the order of ObjectStep (protocol/messages.proto has the units). Seconds are wall-clock, time is
simulated."""
OPTIONAL = frozenset(f.name for f in _FIELDS if f.has_presence)  # NaN where they were not recorded


ENUMS = {f.name: {v.number: v.name.lower() for v in f.enum_type.values} for f in _FIELDS if f.enum_type is not None}


def status_name(value: int) -> str:
    """Names a SolveStatus, e.g. 'converged' or 'max_iterations'; 'unknown_7' if this version does not know it."""
    return enum_name("status", value)


def ended(step: pb.ObjectStep) -> str:
    """Says how the solve of a step ended: the name of its status, or that the object is at rest."""
    return "at rest" if step.at_rest and step.status == pb.CONVERGED else status_name(step.status)


def enum_name(field: str, value: int) -> str:
    """Names a value of an enumerated scalar, as `status_name` does."""
    return ENUMS[field].get(value, f"unknown_{value}")


def row(message: pb.ObjectStep) -> tuple:
    """Returns the values of one step in the order of DTYPES, its reactions by what they are on, and its readings."""
    reactions = {reaction_name(r): _reaction(r) for r in message.reactions}
    readings = {f"{READING}{r.of}/{r.quantity}": r.value for r in message.readings}
    return *(_value(message, name) for name in DTYPES), reactions, readings


class Rows(list[tuple]):
    """The rows of an object of a log, with as many names of reactions and readings as are allowed."""

    def __init__(self) -> None:
        self._reactions, self._readings = _Names("reactions", MOST_REACTIONS), _Names("readings", MOST_READINGS)

    def take(self, message: pb.ObjectStep) -> None:
        """Appends the row of a step."""
        *scalars, reactions, readings = row(message)
        self.append((*scalars, self._reactions.known(reactions), self._readings.known(readings)))

    def notes(self) -> list[str]:
        """Returns a clause for each kind of which some were left out."""
        return [
            f"more than {names.most:,} names of {names.kind}: {names.left_out:,} values of further ones are left out"
            for names in (self._reactions, self._readings)
            if names.left_out
        ]


class _Names:
    """The names of one kind that came first, `most` at most."""

    def __init__(self, kind: str, most: int) -> None:
        self.kind, self.most, self.left_out = kind, most, 0
        self._known: set[str] = set()

    def known(self, values: dict[str, V]) -> dict[str, V]:
        """Returns the values whose names are known or have room."""
        if values.keys() <= self._known:
            return values
        new = [name for name in values if name not in self._known]
        self._known.update(new[: self.most - len(self._known)])
        found = {name: value for name, value in values.items() if name in self._known}
        self.left_out += len(values) - len(found)
        return found


def reaction_name(message: pb.Reaction) -> str:
    """Names what a reaction is on: an obstacle or another object by its name, a grab as "grab:ID"."""
    return f"grab:{message.grab}" if message.HasField("grab") else message.object or message.obstacle


def _reaction(message: pb.Reaction) -> tuple[float, ...]:
    point = _three(message.point) if message.HasField("point") else ()
    return *_three(message.force), *_three(message.torque), *point


def _three(v: pb.Vector) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def _value(message: pb.ObjectStep, name: str) -> object:
    if name in ENUMS:
        return enum_name(name, getattr(message, name))
    return math.nan if name in OPTIONAL and not message.HasField(name) else getattr(message, name)  # type: ignore[arg-type]


def columns(rows: Iterable[tuple]) -> Columns:
    """Returns one array per scalar, ascending in step."""
    *table, reactions, readings = list(zip(*sorted(rows, key=lambda r: r[0]), strict=True)) or [()] * (len(DTYPES) + 2)
    found = {name: np.array(values, dtype) for (name, dtype), values in zip(DTYPES.items(), table, strict=True)}
    return found | _reactions(reactions) | _readings(readings)


def _reactions(steps: Sequence[Mapping[str, tuple[float, ...]]]) -> Columns:
    """Returns columns of the reactions of each step, without force where there was none."""
    widths: dict[str, int] = {}
    for each in steps:
        for what, values in each.items():
            widths[what] = max(widths.get(what, 0), len(values))
    place = {what: k for k, what in enumerate(sorted(widths))}
    table = np.zeros((len(place), len(REACTIONS), len(steps)))
    table[:, 6:] = math.nan
    for step, each in enumerate(steps):
        for what, values in each.items():
            table[place[what], : len(values), step] = values
    return {
        f"{REACTION}{what}/{name}": table[k, component]
        for what, k in place.items()
        for component, name in enumerate(REACTIONS[: widths[what]])
    }


def _readings(steps: Sequence[Mapping[str, float]]) -> Columns:
    """Returns columns of the readings of each step, NaN where there was none."""
    place = {name: k for k, name in enumerate(dict.fromkeys(name for each in steps for name in each))}
    table = np.full((len(place), len(steps)), math.nan)
    for step, each in enumerate(steps):
        table[[place[name] for name in each], step] = list(each.values())
    return dict(zip(place, table, strict=True))
