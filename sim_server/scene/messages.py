# SPDX-License-Identifier: MIT
"""Turns validation errors into messages, one line each: file, object, key = value, allowed values."""

import re
from collections.abc import Mapping
from operator import eq
from typing import Any

from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.scene import deleted

# Messages of error types for which pydantic's own are about Python rather than about a scene file.
MESSAGES = {
    "missing": "missing",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be a string",
    "tuple_type": "must be an array",
    "list_type": "must be an array",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
}
NAMED = ("object", "obstacle", "holder", "attachment", "spring")  # lists of tables that have names
MAX_VALUE = 80  # characters of a value in a message


def readable(
    error: ValidationError,
    file: str,
    table: dict[str, Any],
    overlays: Mapping[tuple[str | int, ...], str] | None = None,
) -> InputError:
    """Returns one InputError for all errors of `error`, found in `table` as read from `file`.

    overlays: files that values are from, by their places
    """
    lines = []
    for e in error.errors(include_url=False):
        path = [part for part in e["loc"] if not str(part).startswith("<")]
        lines.append(f"scene {file}{_with_overlays(path, overlays or {})}{_line(e, path, table)}")
    return InputError("\n".join(lines))


def _with_overlays(path: list[str | int], overlays: Mapping[tuple[str | int, ...], str]) -> str:
    """Returns words on the overlays that set the value at `path`, a value in it, or a table around it."""
    found = {name for place, name in overlays.items() if name and all(map(eq, place, path))}
    return f" with overlay {', '.join(sorted(found))}" if found else ""


def _line(error: Any, path: list[str | int], table: dict[str, Any]) -> str:
    """Returns place, value and message; the message alone where it is about several places, which it names."""
    key = ".".join(part for part in path if isinstance(part, str))
    message = deleted.advice(key, error["input"]) or _message(error)
    if path == ["object"] and error["type"] == "missing":
        message = "a scene needs at least one [[object]]"
    elif path in [[kind] for kind in NAMED] and isinstance(error["input"], dict) and error["type"] == "list_type":
        message = f"write [[{path[0]}]] with double brackets, once per {path[0]}"
    place = _place(path, table)
    whole = len(path) == 1 and path[0] in NAMED
    if error["type"] != "missing" and not isinstance(error["input"], dict) and path[:1] and not whole:
        place += f" = {as_toml(error['input'])}"
    return f", {place}: {message}" if place else f": {message}"


def _message(error: Any) -> str:
    if error["type"] == "literal_error":
        expected = error["msg"].removeprefix("Input should be ")
        return "must be " + expected.replace("True", "true").replace("False", "false")
    words = re.sub(r"^(Input|Tuple|List|String) should", "must", error["msg"])
    return MESSAGES.get(error["type"], words.replace(" after validation", ""))


def _place(path: list[str | int], table: dict[str, Any]) -> str:
    if len(path) >= 2 and path[0] in NAMED and isinstance(path[1], int):
        where = [_named(path[0], path[1], table), _dotted(path[2:])]
        return ", ".join(part for part in where if part)
    return _dotted(path)


def _named(kind: str, index: int, table: dict[str, Any]) -> str:
    entry = table[kind][index]
    name = entry.get("name") if isinstance(entry, dict) else None
    return f"{kind} {name!r}" if isinstance(name, str) and name else f"{kind} {index + 1}"


def _dotted(path: list[str | int]) -> str:
    """Returns a path as text, such as a.b[2].c; elements of arrays are counted from 1."""
    text = ""
    for part in path:
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}"
    return text.lstrip(".")


def as_toml(value: Any) -> str:
    """Returns a value about as TOML has it, shortened, for a message."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= MAX_VALUE else text[:MAX_VALUE] + "..."
