# SPDX-License-Identifier: MIT
"""A log of its own for each start of a server: `--record run-{time}.mcap`."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

PLACE = "{time}"
FORM, PATTERN = "%Y%m%dT%H%M%SZ", r"\d{8}T\d{6}Z"


def started(path: Path, now: float | None = None) -> Path:
    """Puts a time, UTC, in the place of {time} in the name of a file. now: Unix time of the start [s]; None: now"""
    return path.with_name(path.name.replace(PLACE, time.strftime(FORM, time.gmtime(now))))


def earlier(path: Path) -> list[Path]:
    """Returns the files of the logs of all starts, oldest first. path: with {time} in its name, else there are none"""
    if PLACE not in path.name:
        return []
    stem = re.escape(path.stem).replace(re.escape(PLACE), PATTERN)
    form = re.compile(rf"({stem})(\.\d{{4,9}})?{re.escape(path.suffix)}")
    try:
        names = os.listdir(path.parent)
    except OSError:
        return []
    found = [(match[1], int((match[2] or ".1")[1:]), name) for name in names if (match := form.fullmatch(name))]
    return [path.with_name(name) for _, _, name in sorted(found)]
