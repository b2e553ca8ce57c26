# SPDX-License-Identifier: MIT
"""A parameter with a value for each region of an object, seen as one factor of all of them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

SAME = 1e-3  # relative difference between the factors of regions that are meant to be one


def has_regions(key: str, value: Any) -> bool:
    """Returns True for a list of tables that each have a positive number for the last word of the key."""
    name = _name(key)
    return (
        isinstance(value, list)
        and bool(value)
        and all(isinstance(t, dict) and isinstance(t.get(name), int | float) and t[name] > 0 for t in value)
    )


class Regions:
    """value: of the parameter when the factor is 1, a list of tables such as { where = "Z < 1", young = 1e5 }."""

    def __init__(self, key: str, value: list[dict[str, Any]]) -> None:
        self._key, self._value = _name(key), value

    def factor(self, value: list[dict[str, Any]]) -> float:
        """Returns the factor of a value; 1 for one that is no multiple, which is the value of factor 1 from now on."""
        if self._places(value) == self._places(self._value):
            ratios = np.array([new[self._key] / old[self._key] for new, old in zip(value, self._value, strict=True)])
            if np.ptp(ratios) <= SAME * ratios.min():
                return float(f"{np.median(ratios):.4g}")
        self._value = value
        return 1.0

    def times(self, factor: float) -> str:
        """Returns the values of all regions times a factor, as TOML."""
        tables = ({**table, self._key: float(f"{table[self._key] * factor:.6g}")} for table in self._value)
        return f"[{', '.join(map(_toml, tables))}]"

    def _places(self, value: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [{key: each for key, each in table.items() if key != self._key} for table in value]


def _name(key: str) -> str:
    return key.rpartition(".")[2]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{json.dumps(key)} = {_toml(each)}' for key, each in value.items())} }}"
    return f"[{', '.join(map(_toml, value))}]" if isinstance(value, list) else json.dumps(value, ensure_ascii=False)
