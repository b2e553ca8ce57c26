# SPDX-License-Identifier: MIT
"""Writes settings as an overlay, a TOML file that `sim-server --set @FILE` takes."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

from clients.errors import BadInput, ClientError
from clients.log.atomic_file import atomic_file

MARK = "Settings by sim-client plan"  # begins the first comment; a file that begins otherwise is not replaced


def overlay_text(settings: Mapping[str, str], comments: Sequence[str]) -> str:
    """Returns the text of an overlay: comments, then a line for each of the settings (KEY: VALUE as of `--set`)."""
    head = "".join(f"# {line}\n" if line else "#\n" for line in comments)
    values = {key: _value(text) for key, text in settings.items()}
    dotted = "".join(f"{key} = {value}\n" for key, value in values.items())
    quoted = "".join(f"{json.dumps(key)} = {value}\n" for key, value in values.items())
    return head + (dotted if _is_plain(dotted, values) else quoted)


def _is_plain(text: str, values: Mapping[str, str]) -> bool:
    """True if dotted keys do: no value is a table, which would be merged, and none is in another one's."""
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    return not any(isinstance(tomllib.loads(f"value = {value}")["value"], dict) for value in values.values())


def _value(text: str) -> str:
    """Returns a value of `--set` in TOML: a bare word is a string."""
    try:
        if list(tomllib.loads(f"value = {text}")) == ["value"]:
            return text
    except (tomllib.TOMLDecodeError, RecursionError):
        pass
    return json.dumps(text, ensure_ascii=False)


def check_path(path: Path) -> None:
    """Raises BadInput for a path at which there is something other than an overlay of this program."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            if not file.readline().startswith(f"# {MARK}"):
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
