# SPDX-License-Identifier: MIT
"""Checks that what points.json holds is of the types that it should be of."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

Check = Callable[[Any], bool]


def check(table: Mapping[str, Any], known: Mapping[str, Check], where: str) -> None:
    """Raises TypeError for the first value of `table` that the check of its key refuses; other keys are left aside."""
    for key, is_right in known.items():
        if key in table and not is_right(table[key]):
            raise TypeError(f"{where}: {key} = {repr(table[key])[:60]} is not as it should be")


def any_value(value: Any) -> bool:
    return True


def text(value: Any) -> bool:
    return isinstance(value, str)


def number(value: Any) -> bool:
    """True for a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def one_of(*words: str) -> Check:
    return lambda value: text(value) and value in words


def optional(of: Check) -> Check:
    return lambda value: value is None or of(value)


def each(of: Check) -> Check:
    """Returns a check of a list."""
    return lambda value: isinstance(value, list) and all(of(item) for item in value)


def by_name(of: Check) -> Check:
    """Returns a check of a table with any keys."""
    return lambda value: isinstance(value, dict) and all(of(item) for item in value.values())


def with_keys(**of: Check) -> Check:
    """Returns a check of a table that has these keys."""
    return lambda value: (
        isinstance(value, dict) and all(key in value and is_right(value[key]) for key, is_right in of.items())
    )
