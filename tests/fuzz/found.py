# SPDX-License-Identifier: MIT
"""Inputs that were findings once, kept as files of tests/fuzz/cases: KIND-SEED with the suffix of what they are."""

from pathlib import Path
from typing import Any

from tests.fuzz.inputs import made

FOLDER = Path(__file__).with_name("cases")
SUFFIXES = {"scene": ".toml", "log": ".mcap"}


def keep(kind: str, seed: int, folder: Path | None = None) -> Path:
    """Writes the input of a seed to a file; a later change of how inputs are made does not change it."""
    given = made(kind, seed)
    head, data = given if isinstance(given, tuple) else (SUFFIXES[kind], given)
    suffix = f".{head}" if kind == "wire" else head
    path = (folder or FOLDER) / f"{kind}-{seed}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def kept(path: Path) -> tuple[str, Any]:
    """(kind, input) of a file."""
    kind = path.name.partition("-")[0]
    head = path.suffix.removeprefix(".") if kind == "wire" else path.suffix
    data = path.read_bytes()
    return kind, (head, data) if kind in ("wire", "mesh") else data
