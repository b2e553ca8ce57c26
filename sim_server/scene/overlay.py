# SPDX-License-Identifier: MIT
"""Applies overlays to a scene: TOML files of overrides, ``--set @FILE`` on the command line."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sim_server.errors import InputError
from sim_server.scene import overrides, toml_file
from sim_server.scene.messages import NAMED, as_toml

VERBATIM = "set"  # key of an overlay with a list of overrides


def apply(name: str, table: dict[str, Any]) -> Iterator[overrides.Place]:
    """Sets the values in the overlay file `name`, in its order, in a parsed scene; yields their places.

    Its keys are those of overrides; a table is merged with that of the scene. The key `set` is a list of overrides as
    on the command line, where a table replaces the scene's. Raises InputError.
    """
    path = Path(name)
    given = toml_file.parse(toml_file.read_text(path, "overlay"), path, "overlay")
    pending = list(reversed(given.items()))
    while pending:
        key, value = pending.pop()
        if isinstance(value, dict) and value:
            pending += [(f"{key}.{below}", part) for below, part in reversed(value.items())]
            continue
        try:
            if key == VERBATIM:
                yield from _verbatim(value, table)
            elif key in NAMED:
                raise InputError(f"write [{key}.NAME] for one that the scene has; an overlay adds none")
            else:
                yield overrides.assign(key, value, as_toml(value), table, replace=False)
        except InputError as error:
            raise InputError(f"overlay {name}, {key} = {as_toml(value)}: {error}") from None


def _verbatim(given: Any, table: dict[str, Any]) -> Iterator[overrides.Place]:
    if not isinstance(given, list) or not all(isinstance(each, str) for each in given):
        raise InputError('must be an array of overrides, as ["solver.tolerance=1e-8"]')
    for override in given:
        yield overrides.apply(override, table)
