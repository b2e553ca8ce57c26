# SPDX-License-Identifier: MIT
"""Lists the materials that a scene may name, or shows one with its sources, as tables or JSON."""

import json
from difflib import get_close_matches
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from clients.errors import BadInput
from protocol import materials


def show(name: str | None, as_json: bool) -> None:
    """Prints one material, or all without a name. Raises BadInput for a name that is not there."""
    known = materials.names()
    if name is not None and name not in known:
        similar = get_close_matches(name, known, n=3, cutoff=0.6)
        guess = f"; did you mean {' or '.join(map(repr, similar))}?" if similar else ""
        raise BadInput(f"materials: {name!r}: no such material{guess} (known materials: {', '.join(known)})")
    if as_json:
        found = [{"name": each, **materials.read(each)} for each in known]
        print(json.dumps(found if name is None else next(each for each in found if each["name"] == name)))
        return
    Console().print(_list(known) if name is None else _one(name, materials.read(name)))


def _list(known: list[str]) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for title in ("name", "what", "law", "typical constants, Pa", "kg/m3", "stretch"):
        table.add_column(title)
    for name in known:
        found = materials.read(name)
        table.add_row(
            name, found["title"], found["law"], written(found["typical"]), f"{found['density']:g}",
            " to ".join(f"{end:g}" for end in found["stretch"]),
        )  # fmt: skip
    return table


def _one(name: str, found: dict[str, Any]) -> Group:
    constants = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    constants.add_column(found["law"])
    places = [place for place in materials.PLACES if place in found]
    for place in places:
        constants.add_column(place, justify="right")
    for key in found["typical"]:
        constants.add_row(key, *(value(found[place][key]) for place in places))
    lines = [
        f"{name}: {found['title']}",
        f"measured: {found['condition']}",
        f"holds for uniaxial stretches of {' to '.join(f'{end:g}' for end in found['stretch'])}",
        f"density {found['density']:g} kg/m3 ({found['density_source']})",
        f"chosen, not measured: {found['chosen']}",
    ]
    sources = [Text(f"source: {each['text']}, {where(each)}") for each in found["source"]]
    return Group(*map(Text, lines), constants, *sources)


def where(source: dict[str, str]) -> str:
    """Returns the address of a source."""
    return f"https://doi.org/{source['doi']}" if "doi" in source else source["url"]


def written(constants: dict[str, Any]) -> str:
    """Returns constants as a scene has them, such as young = 5630, poisson = 0.48."""
    return ", ".join(f"{key} = {value(number)}" for key, number in constants.items())


def value(number: float | list[float]) -> str:
    """Returns a constant, or those of several terms, with six digits."""
    return f"[{', '.join(map(value, number))}]" if isinstance(number, list) else f"{number:.6g}"
