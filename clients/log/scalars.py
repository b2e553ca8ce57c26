# SPDX-License-Identifier: MIT
"""Scalars per step of an object as columns: names, types and order for export, plots and tables."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from numpy.typing import NDArray

from protocol import messages_pb2 as pb

Columns = dict[str, NDArray]

INPUTS = ("asked", "probe")  # of a solve: for replays only
REACTION = (
    "reaction/"  # columns reaction/OBSTACLE/force_x to torque_z [N, N m], of obstacles that the object has touched
)
REACTIONS = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")


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


def enum_name(field: str, value: int) -> str:
    """Names a value of an enumerated scalar, as `status_name` does."""
    return ENUMS[field].get(value, f"unknown_{value}")


def row(message: pb.ObjectStep) -> tuple:
    """Returns the values of one step in the order of DTYPES, and then its reactions by obstacle."""
    reactions = {r.obstacle: (*_three(r.force), *_three(r.torque)) for r in message.reactions}
    return *(_value(message, name) for name in DTYPES), reactions


def _three(v: pb.Vector) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def _value(message: pb.ObjectStep, name: str) -> object:
    if name in ENUMS:
        return enum_name(name, getattr(message, name))
    return math.nan if name in OPTIONAL and not message.HasField(name) else getattr(message, name)  # type: ignore[arg-type]


def columns(rows: Iterable[tuple]) -> Columns:
    """Returns one array per scalar, ascending in step."""
    *table, reactions = list(zip(*sorted(rows, key=lambda r: r[0]), strict=True)) or [()] * (len(DTYPES) + 1)
    found = {name: np.array(values, dtype) for (name, dtype), values in zip(DTYPES.items(), table, strict=True)}
    none = (0.0,) * len(REACTIONS)
    for obstacle in sorted(set().union(*reactions)):
        values = np.array([each.get(obstacle, none) for each in reactions])
        found |= {f"{REACTION}{obstacle}/{name}": values[:, k] for k, name in enumerate(REACTIONS)}
    return found
