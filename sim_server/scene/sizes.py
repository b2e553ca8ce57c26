# SPDX-License-Identifier: MIT
"""Sizes and times as options have them: 500MB, 2GiB, 10min."""

import re
from collections.abc import Mapping

SIZES = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
TIMES = {"S": 1.0, "MIN": 60.0, "H": 3600.0, "D": 86400.0}
_VALUE = re.compile(r"(\d{1,15}(?:\.\d{1,9})?)\s*([A-Za-z]+)")


def measure(text: str, units: Mapping[str, float]) -> float | None:
    """Returns a number with one of these units, in the smallest of them; None for anything else."""
    match = _VALUE.fullmatch(text.strip())
    factor = units.get(match[2].upper()) if match else None
    return float(match[1]) * factor if match and factor is not None else None
