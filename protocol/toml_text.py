# SPDX-License-Identifier: MIT
"""Writes values as TOML: parameters travel as such."""

import json
from collections.abc import Mapping, Sequence
from typing import Any


def toml(value: Any) -> str:
    """Returns a number, bool, text, list or table of such as TOML in one line, from which the same value is read.

    Raises TypeError for other values.
    """
    if hasattr(value, "tolist"):  # of NumPy
        value = value.tolist()
    if isinstance(value, (str, bool)):
        return json.dumps(value)
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(key)} = {toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(toml, value)) + "]"
    raise TypeError(f"{value!r} is not a number, true, false, text, or a list or table of these")
