# SPDX-License-Identifier: MIT
"""Reads TOML files, with errors for the user."""

import tomllib
from pathlib import Path
from typing import Any

from sim_server.errors import InputError


def read_text(path: Path, kind: str) -> str:
    """Returns the text of a file. kind: what the file is, for errors. Raises InputError."""
    try:
        return path.read_bytes().decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{kind} {path}: not a text file in UTF-8 (byte {error.start})") from None
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        reason = getattr(error, "strerror", None) or error
        needed = f"needed: {'an' if kind[0] in 'aeiou' else 'a'} {kind} file in TOML"
        raise InputError(f"{kind} {str(path)!r}: cannot be read ({reason}); {needed}") from None


def parse(text: str, path: Path, kind: str) -> dict[str, Any]:
    """Returns the table that the text of a file holds. Raises InputError."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{kind} {path}: not valid TOML: {error}") from None
