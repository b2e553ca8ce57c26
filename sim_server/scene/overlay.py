# SPDX-License-Identifier: MIT
"""Applies overlays to a scene: TOML files of overrides, ``--set @FILE`` on the command line."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sim_server.errors import InputError
from sim_server.scene import toml_file
from sim_server.scene.messages import NAMED, as_toml
from sim_server.scene.overrides import Place, assign


def apply(name: str, table: dict[str, Any]) -> Iterator[Place]:
    """Sets the values in the overlay file `name`, in its order, in a parsed scene; yields their places.

    Its keys are those of overrides. Tables are merged with those of the scene, except for a path in quotation marks at
    the top of the file, as ``"object.beam.mesh" = { ... }``: its value replaces a table as on the command line. Raises
    InputError.
    """
    path = Path(name)
    given = toml_file.parse(toml_file.read_text(path, "overlay"), path, "overlay")
    pending = [(key, value, "." not in key) for key, value in reversed(given.items())]
    while pending:
        key, value, merges = pending.pop()
        if merges and isinstance(value, dict) and value:
            pending += [(f"{key}.{below}", part, True) for below, part in reversed(value.items())]
            continue
        try:
            if key in NAMED:
                raise InputError(f"write [{key}.NAME] for one that the scene has; an overlay adds none")
            yield assign(key, value, as_toml(value), table, replace=not merges)
        except InputError as error:
            raise InputError(f"overlay {name}, {key} = {as_toml(value)}: {error}") from None
