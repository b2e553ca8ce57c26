# SPDX-License-Identifier: MIT
"""Marks the parameters of a scene that may change while steps run: `young: Annotated[Young, Live(...)]`."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

if TYPE_CHECKING:
    from sim_server.scene.model import Scene

Place = tuple[str | int, ...]
NAMED = {"obstacles": "obstacle"}  # fields of a scene with live parameters, and their tables


@dataclass(frozen=True)
class Live:
    """Bounds of a slider, for what is sensible; the field itself says what is allowed.

    relative: they are factors of the value at the start. Equal bounds: the parameter has no slider.
    listed: False for what clients change by a command of its own, and are not shown among parameters
    """

    low: float = 0.0
    high: float = 0.0
    logarithmic: bool = False
    relative: bool = False
    listed: bool = True


STIFFNESS = Live(0.01, 100, logarithmic=True, relative=True)
POISSON = Live(0.0, 0.49)


@dataclass(frozen=True)
class LiveField:
    """A live parameter of a scene.

    key: as after --set; place: in the table of the scene; short: key that may stand for it; of: table that it belongs
    to, as of mechanics.world.LiveArray; value: in the scene
    """

    key: str
    place: Place
    short: str
    of: str
    live: Live
    unit: str
    about: str
    value: Any


def live_fields(scene: "Scene") -> Iterator[LiveField]:
    """Yields the live parameters that a scene gives a value, also by default."""
    for name, params in scene.effects.items():
        yield from _fields(params, f"effects.{name}", ("effects", name), name, name)
    for index, o in enumerate(scene.objects):
        for name, params in o.effects.items():
            place = "object", index, "effects", name
            yield from _fields(params, f"object.{o.name}.effects.{name}", place, f"{o.name}.{name}", name)
        if "contact" in scene.effects:
            yield from _fields(o, f"object.{o.name}", ("object", index), o.name)
    for field, table in NAMED.items():
        for index, named in enumerate(getattr(scene, field) or ()):
            yield from _fields(named, f"{table}.{named.name}", (table, index), named.name)


def _fields(params: BaseModel, key: str, place: Place, short: str, of: str = "") -> Iterator[LiveField]:
    for name, live, unit, about in _marked(type(params)):
        value = getattr(params, name)
        if value is not None:
            where = f"{key}.{name}", (*place, name), f"{short}.{name}"
            yield LiveField(*where, of or name, live, unit, about, value)


@cache
def _marked(model: type[BaseModel]) -> list[tuple[str, Live, str, str]]:
    """Returns name, mark, unit and meaning of the live fields of a table."""
    found = []
    for name, field in model.model_fields.items():
        live = next((m for m in field.metadata if isinstance(m, Live)), None)
        if live is not None:
            found.append((name, live, *unit_and_meaning(field.description or "")))
    return found


def unit_and_meaning(description: str) -> tuple[str, str]:
    """Splits the description of a field, "Young's modulus [Pa], or ...", into unit and text; no unit: "-"."""
    found = re.search(r" ?\[([^\]]+)\]", description)
    return (found.group(1), description.replace(found.group(0), "", 1).strip(" ,;")) if found else ("-", description)
