# SPDX-License-Identifier: MIT
"""Loads scenes: TOML files with KEY=VALUE overrides and overlays, validated, with defaults filled in.

`load` reports everything that is wrong at once, as one InputError. It imports the effects that the scene lists and no
others.
"""

from collections.abc import Mapping, Sequence
from os.path import exists
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.scene import gallery, overlay, toml_file
from sim_server.scene.messages import readable
from sim_server.scene.model import Scene, SceneObject
from sim_server.scene.overrides import Place, apply

__all__ = ["Scene", "SceneObject", "load", "validated"]


def load(path: str | Path, overrides: Sequence[str] = ()) -> Scene:
    """Returns the validated scene in the TOML file `path` with `overrides` applied: KEY=VALUE, or @FILE, an overlay.

    path: a file, or gallery/NAME, a scene of the package
    Raises InputError with one line for each error.
    """
    path = gallery.found(Path(path))
    try:
        text = toml_file.read_text(path, "scene")
    except InputError as error:
        raise error if exists(path) else InputError(f"{error}; {gallery.known()}") from None
    table = toml_file.parse(text, path, "scene")
    overlays: dict[Place, str] = {}
    for override in overrides:
        try:
            if override.startswith("@"):
                overlays |= dict.fromkeys(overlay.apply(override[1:], table), override[1:])
            else:
                overlays[apply(override, table)] = ""
        except InputError as error:
            raise InputError(f"scene {path.name}, {error}") from None
    scene = validated({"name": path.stem, **table}, path.name, path.parent, overlays)
    scene._path, scene._text = gallery.name_of(path), text
    return scene


def validated(table: dict[str, Any], where: str, folder: Path, overlays: Mapping[Place, str] | None = None) -> Scene:
    """Returns the scene of a table. where: names it in messages; folder: of the files that it names.

    overlays: files that values are from, by their places. Raises InputError with one line for each error.
    """
    try:
        return Scene.model_validate({"name": "scene", **table}, context={"folder": folder})
    except ValidationError as error:
        raise readable(error, where, table, overlays) from None
