# SPDX-License-Identifier: MIT
"""Protobuf messages as values for JSON: all fields, numbers as numbers, NaN as null, enums by name."""

from __future__ import annotations

import math
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

LEFT_OUT = ("header",)  # used between processes only


def to_json(message: Message) -> dict[str, Any]:
    """Returns a message as a dictionary for json.dumps, without its fields of bytes."""
    return {
        field.name: [_value(field, item) for item in value] if field.is_repeated else _value(field, value)
        for field in message.DESCRIPTOR.fields
        if field.name not in LEFT_OUT and field.type != FieldDescriptor.TYPE_BYTES
        for value in [getattr(message, field.name)]
    }


def _value(field: Any, value: Any) -> Any:
    if isinstance(value, Message):
        return to_json(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if field.enum_type is not None:
        known = field.enum_type.values_by_number.get(value)
        return known.name.lower() if known else value
    return value
