# SPDX-License-Identifier: MIT
"""Effects: what acts on the objects of a scene. The file name in this folder is the registry.

A scene lists the effects that it wants; only those are imported, and what is not listed costs nothing. A name that is
not in this folder may be an effect of another package (_outside.py). Each file has

* ``SCOPE``: "scene" (listed once, under [effects]) or "object" (listed under [object.effects]),
* ``Params``: a pydantic model of its table in the scene, with units in the field descriptions,
* a docstring that says what it computes, the formula, the source and the usual ranges.
"""

import importlib
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from sim_server.errors import InputError

if TYPE_CHECKING:
    from sim_server.effects._outside import Code  # imported where a scene lists an effect of another package


def known_effects() -> list[str]:
    """Names of the effects in this folder, sorted; nothing is imported."""
    return list(_files())


@cache
def _files() -> tuple[str, ...]:
    return tuple(sorted(f.stem for f in Path(__file__).parent.glob("*.py") if not f.stem.startswith("_")))


def effect(name: str) -> ModuleType:
    """The module of one effect, imported now if it was not yet.

    Raises InputError for an unknown name, or for an effect of another package that cannot be imported.
    """
    if name in known_effects():
        return importlib.import_module(f"{__name__}.{name}")
    from sim_server.effects import _outside

    module = _outside.load(name)
    if module is None:
        raise InputError(f"no effect {name!r} (known effects: {', '.join(all_effects())})")
    return module


def all_effects() -> list[str]:
    """Names of the effects in this folder and of packages that are installed, sorted; no effect is imported."""
    from sim_server.effects import _outside

    return sorted({*known_effects(), *_outside.names()})


def exists(name: str) -> bool:
    """True if there is an effect of this name; entry points are read only if it is not in this folder."""
    return name in known_effects() or name in all_effects()


def codes_outside(names: Iterable[str]) -> "list[Code]":
    """Returns what code those of these effects are that are of other packages; all of them have been imported."""
    others = sorted(set(names) - set(known_effects()))
    if not others:
        return []
    from sim_server.effects import _outside

    return [_outside.code_of(name) for name in others]


def effect_of(module: str) -> str:
    """The effect that a module of this name is; empty for a module that is none."""
    folder, _, name = module.rpartition(".")
    if folder == __name__:
        return "" if name.startswith("_") else name
    outside = sys.modules.get(f"{__name__}._outside")
    return outside.effect_of(module) if outside is not None else ""
