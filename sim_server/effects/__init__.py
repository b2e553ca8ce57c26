# SPDX-License-Identifier: MIT
"""Effects: what acts on the objects of a scene. The file name in this folder is the registry.

A scene lists the effects that it wants; only those are imported, and what is not listed costs nothing. Each file has

* ``SCOPE``: "scene" (listed once, under [effects]) or "object" (listed under [object.effects]),
* ``Params``: a pydantic model of its table in the scene, with units in the field descriptions,
* a docstring that says what it computes, the formula, the source and the usual ranges.
"""

import importlib
from functools import cache
from pathlib import Path
from types import ModuleType

from sim_server.errors import InputError


def known_effects() -> list[str]:
    """Names of the effects, sorted; nothing is imported."""
    return list(_files())


@cache
def _files() -> tuple[str, ...]:
    return tuple(sorted(f.stem for f in Path(__file__).parent.glob("*.py") if not f.stem.startswith("_")))


def effect(name: str) -> ModuleType:
    """The module of one effect, imported now if it was not yet; raises InputError for an unknown name."""
    if name not in known_effects():
        raise InputError(f"no effect {name!r} (known effects: {', '.join(known_effects())})")
    return importlib.import_module(f"{__name__}.{name}")


def effect_of(module: str) -> str:
    """The effect that a module of this name is; empty for a module that is none."""
    folder, _, name = module.rpartition(".")
    return name if folder == __name__ and not name.startswith("_") else ""
