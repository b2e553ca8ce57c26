# SPDX-License-Identifier: MIT
"""Applies KEY=VALUE overrides to a scene: ``--set solver.tolerance=1e-8`` on the command line."""

import re
import tomllib
from typing import Any

from sim_server.errors import InputError
from sim_server.scene.messages import NAMED
from sim_server.scene.parameters import nearest

KEY_VALUE = "must be KEY=VALUE, as solver.tolerance=1e-8 or object.beam.density=900, or @FILE"
Place = tuple[str | int, ...]
"""Where a value stands in a parsed scene: keys, and indices of lists as that of objects."""


def apply(override: str, table: dict[str, Any]) -> Place:
    """Sets one value of a parsed scene: ``solver.tolerance=1e-8``, ``object.NAME.effects.corotational.young=1e6``,
    ``obstacle.NAME.friction=0.2``, ``...young[REGION]=2e4``, ``...poisson[REGION]=0.4``; returns its place. Raises
    InputError as `assign` does.
    """
    key, equals, text = override.partition("=")
    text = text.strip()
    try:
        if not equals:
            raise InputError(KEY_VALUE)
        return assign(key.strip(), value(text), text, table)
    except InputError as error:
        raise InputError(f"override {override!r}: {error}") from None


def assign(key: str, given: Any, text: str, table: dict[str, Any], replace: bool = True) -> Place:
    """Sets the value of a dotted key in a parsed scene; returns its place.

    text: the value as it was written; replace: an empty table takes the place of one that is there, too

    Missing tables on the way are created, so that an override may list an effect. The validation of the scene finds
    unknown keys. Raises InputError for an unknown object or a key below a value that is no table.
    """
    if not all(region_of(key)[0].split(".")):
        raise InputError(KEY_VALUE)
    place, rest = table, key
    at: Place = ()
    for kind in NAMED:
        if key == kind or key.startswith(f"{kind}."):
            place, at, rest = _named(kind, key.removeprefix(kind).lstrip("."), table)
            break
    rest, region = region_of(rest)
    *parents, last = rest.split(".")
    for depth, part in enumerate(parents):
        below = place.get(part)
        if below is None or below is True:  # an effect listed as true: its defaults
            below = place[part] = {}
        if not isinstance(below, dict):
            raise InputError(f"{'.'.join(parents[: depth + 1])} = {below!r} is no table, so it has no keys")
        place = below
    there: Any = place.get(last)
    if region:
        listed = _list_of_regions(place, last)
        there = place.get(listed)
        index = _index(there, region, last)
        place[listed] = [{**each, last: given} if k == index else each for k, each in enumerate(there)]
        return (*at, *parents, listed, index, last)
    if _tables(there) and not _tables(given):
        raise InputError(
            f"{last} is a list of {len(there)} regions in the scene, which one value would take the place of; allowed: "
            f"{last}[NAME] for a region that has a name, and a list of regions, for all elements "
            f"{key}=[{{ {last} = {text} }}]"
        )
    if replace or given != {} or not (isinstance(there, dict) or there is True):
        place[last] = given
    return (*at, *parents, last)


def region_of(key: str) -> tuple[str, str]:
    """Returns a key without the name of a region at its end, and that name: young[tumour]; "" without one."""
    found = re.fullmatch(r"([^\[\]]*)\[(.+)\]", key)
    return (found.group(1), found.group(2)) if found else (key, "")


def _list_of_regions(table: dict[str, Any], key: str) -> str:
    """Returns the key of the list of regions which may have a constant: a law has one, of its first constant.

    All regions have that constant, which tells their list from others.
    """
    lists = [k for k, value in table.items() if _tables(value) and all(k in region for region in value)]
    return key if key in lists or len(lists) != 1 else lists[0]


def _index(regions: Any, name: str, key: str) -> int:
    """Returns the place of the region of this name in a list. Raises InputError."""
    listed = regions if _tables(regions) else []
    names = [region.get("name", region.get("group")) for region in listed]
    if names.count(name) != 1:
        known = [str(n) for n in names if n is not None]
        wrong = "no region" if name not in names else f"{names.count(name)} regions"
        raise InputError(f"{key} has {wrong} {name!r}" + nearest(name, known, "names of regions"))
    return names.index(name)


def _tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)


def _named(kind: str, key: str, table: dict[str, Any]) -> tuple[dict[str, Any], Place, str]:
    """Returns the table of an object (or obstacle, or holder), its place, and the key inside it.

    Names may hold dots, so the longest matching name wins.
    """
    entries = table.get(kind)
    listed = [e if isinstance(e, dict) else {} for e in entries] if isinstance(entries, list) else []
    index = {e["name"]: number for number, e in enumerate(listed) if isinstance(e.get("name"), str)}
    fitting = [name for name in index if key.startswith(name + ".")]
    if not fitting:
        wanted = key.split(".")[0]
        raise InputError(f"no {kind} {wanted!r} with a key after it" + nearest(wanted, list(index), f"{kind}s"))
    name = max(fitting, key=len)
    return listed[index[name]], (kind, index[name]), key[len(name) + 1 :]


def value(text: str) -> Any:
    """Parses `text` as a TOML value; a bare word that is not TOML is a string."""
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        if not text or re.match(r"[\[{\"']", text):
            raise InputError(f"value {text!r} is not valid TOML: {error}") from None
        return text
    return parsed["value"] if len(parsed) == 1 else text
