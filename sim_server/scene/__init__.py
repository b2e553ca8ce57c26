# SPDX-License-Identifier: MIT
"""Loads scenes: TOML files with KEY=VALUE overrides, validated, with defaults filled in.

`load` reports everything that is wrong at once, as one InputError. It imports the effects that the scene lists and no
others.
"""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.scene.messages import readable
from sim_server.scene.model import Scene, SceneObject
from sim_server.scene.overrides import apply

__all__ = ["Scene", "SceneObject", "load"]


def load(path: str | Path, overrides: Sequence[str] = ()) -> Scene:
    """Returns the validated scene in the TOML file `path` with KEY=VALUE `overrides` applied.

    Raises InputError with one line for each error.
    """
    path = Path(path)
    text = _text(path)
    table = _parsed(path, text)
    for override in overrides:
        try:
            apply(override, table)
        except InputError as error:
            raise InputError(f"scene {path.name}, override {override!r}: {error}") from None
    try:
        scene = Scene.model_validate({"name": path.stem, **table}, context={"folder": path.parent})
    except ValidationError as error:
        raise readable(error, path.name, table) from None
    scene._path, scene._text = path, text
    return scene


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except UnicodeDecodeError as error:
        raise InputError(f"scene {path}: not a text file in UTF-8 (byte {error.start})") from None
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"scene {str(path)!r}: cannot be read ({reason}); needed: a scene file in TOML") from None


def _parsed(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"scene {path}: not valid TOML: {error}") from None
