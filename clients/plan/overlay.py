# SPDX-License-Identifier: MIT
"""Writes settings as an overlay, a TOML file that `sim-server --set @FILE` takes."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clients.errors import BadInput, ClientError
from clients.log.atomic_file import atomic_file

MARK = "Settings by sim-client plan"  # begins the first comment; a file that begins otherwise is not replaced


def overlay_text(settings: Mapping[str, str], comments: Sequence[str]) -> str:
    """Returns the text of an overlay: comments, then settings (KEY: VALUE as of `--set`).

    These are keys where that means the same, else overrides as on the command line.
    """
    head = "".join(f"# {line}\n" if line else "#\n" for line in comments)
    keys = "".join(f"{key} = {_value(text)}\n" for key, text in settings.items())
    if _is_plain(keys, settings):
        return head + keys
    words = "".join(f"  {_string(f'{key}={text}')},\n" for key, text in settings.items())
    return f"{head}set = [\n{words}]\n"


def _is_plain(text: str, settings: Mapping[str, str]) -> bool:
    """True if the text is TOML and none of its values is a table, which would be merged with that of the scene."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    return not any(isinstance(_at(table, key), dict) for key in settings)


def _at(table: Mapping[str, Any], key: str) -> Any:
    for part in key.split("."):
        table = table[part]
    return table


def _value(text: str) -> str:
    """Returns a value of `--set` in TOML: a bare word is a string."""
    try:
        if list(tomllib.loads(f"value = {text}")) == ["value"]:
            return text
    except (tomllib.TOMLDecodeError, RecursionError):
        pass
    return _string(text)


def _string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def check_path(path: Path, mark: str = MARK) -> None:
    """Raises BadInput for a path at which there is something other than an overlay of a command, or no folder.

    mark: begins the first comment of its overlays
    """
    if not path.parent.is_dir():
        raise BadInput(f"--to {path}: no such folder")
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            if not file.readline().startswith(f"# {mark}"):
                raise BadInput(f"{path}: is there and was not written by this command; --to FILE takes another name")
    except FileNotFoundError:
        return
    except OSError as error:
        raise BadInput(f"--to {path}: {error.strerror}") from None


def write(path: Path, settings: Mapping[str, str], comments: Sequence[str]) -> None:
    """Writes the overlay. Raises ClientError."""
    try:
        with atomic_file(path) as part:
            part.write_text(overlay_text(settings, comments), encoding="utf-8")
    except OSError as error:
        raise ClientError(f"{path}: cannot be written: {error.strerror}") from None
