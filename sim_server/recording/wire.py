# SPDX-License-Identifier: MIT
"""Encodes many messages of one type at once, from columns of numbers (wire.cpp)."""

import ctypes as c
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.compiler import native
from sim_server.backends.declarations import Declarations

TEXT = Declarations("recording/wire.cpp")
COLUMN = TEXT.dtype("Column")
VALUE_BYTES = 15  # of a value with its tag, at most


@cache
def library() -> c.CDLL:
    """Compiles and loads wire.cpp."""
    p = c.c_void_p
    signature = (None, [p, c.c_int32, c.c_int64, p, p, p, p, p])
    loaded = native("recording/wire.cpp", {"wf_encode": signature}, stepping=False)
    TEXT.check_sizes(loaded)
    return loaded


def encode(
    fields: Mapping[str, Any], columns: Mapping[str, NDArray[Any]], prefixes: Sequence[bytes],
    number: NDArray[np.int64],
) -> list[bytes]:  # fmt: skip
    """Returns messages of one type, serialized.

    fields: descriptors of those of that type, by name
    columns: (rows,) of float64, int64 or int32, by field. As ever, what is 0 is left out; where the field is optional
        NaN is left out instead.
    prefixes: fields that are no columns, serialized. number: (rows,) which of them each message begins with
    """
    rows = len(number)
    table = np.zeros(len(columns), COLUMN)
    for row, (name, values) in zip(table, columns.items(), strict=True):
        field = fields[name]
        row["first"], row["stride"], row["bytes"] = values.ctypes.data, values.strides[0], values.dtype.itemsize
        row["tag"], row["optional"] = field.number << 3 | (values.dtype.kind == "f"), field.has_presence
    ends, sizes = np.empty(rows, np.int64), np.array([len(prefix) for prefix in prefixes], np.int64)
    room = int(sizes[number].sum()) + VALUE_BYTES * rows * len(columns)
    out, joined, prefix_ends = np.empty(room, np.uint8), b"".join(prefixes), np.cumsum(sizes)
    library().wf_encode(
        table.ctypes.data, len(table), rows, joined, prefix_ends.ctypes.data, number.ctypes.data, out.ctypes.data,
        ends.ctypes.data,
    )  # fmt: skip
    data, stops = out[: int(ends[-1]) if rows else 0].tobytes(), ends.tolist()
    return [data[begin:end] for begin, end in zip([0, *stops[:-1]], stops, strict=False)]


def repeated(number: int, messages: Sequence[bytes]) -> bytes:
    """Returns serialized messages as the values of a repeated field of another one."""
    tag = _varint(number << 3 | 2)
    return b"".join([part for message in messages for part in (tag, _varint(len(message)), message)])


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
