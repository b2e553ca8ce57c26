# SPDX-License-Identifier: MIT
"""Applies KEY=VALUE overrides to a scene: ``--set solver.tolerance=1e-8`` on the command line."""

import re
import tomllib
from typing import Any

from sim_server.errors import InputError
from sim_server.scene.messages import NAMED
from sim_server.scene.parameters import nearest


def apply(override: str, table: dict[str, Any]) -> None:
    """Sets one value of a parsed scene: ``solver.tolerance=1e-8``, ``object.NAME.effects.corotational.young=1e6``,
    ``obstacle.NAME.friction=0.2``.

    Missing tables on the way are created, so that an override may list an effect. The validation of the scene finds
    unknown keys. Raises InputError for an unknown object or a key below a value that is no table.
    """
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key or not all(key.split(".")):
        raise InputError("must be KEY=VALUE, as solver.tolerance=1e-8 or object.beam.density=900")
    place = table
    for kind in NAMED:
        if key == kind or key.startswith(f"{kind}."):
            place, key = _named(kind, key.removeprefix(kind).lstrip("."), table)
            break
    *parents, last = key.split(".")
    for depth, part in enumerate(parents):
        below = place.get(part)
        if below is None or below is True:  # an effect listed as true: its defaults
            below = place[part] = {}
        if not isinstance(below, dict):
            raise InputError(f"{'.'.join(parents[: depth + 1])} = {below!r} is no table, so it has no keys")
        place = below
    given = value(text.strip())
    there: Any = place.get(last)
    if _tables(there) and not _tables(given):
        raise InputError(
            f"{last} is a list of {len(there)} regions in the scene, which one value would take the place of; allowed: "
            f"a list of regions, for all elements {override.partition('=')[0].strip()}=[{{ {last} = {text.strip()} }}]"
        )
    place[last] = given


def _tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)


def _named(kind: str, key: str, table: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Returns the table of an object (or obstacle, or holder) and the key inside it.

    Names may hold dots, so the longest matching name wins.
    """
    entries = table.get(kind)
    entries = [e for e in entries if isinstance(e, dict)] if isinstance(entries, list) else []
    named = {e["name"]: e for e in entries if isinstance(e.get("name"), str)}
    fitting = [name for name in named if key.startswith(name + ".")]
    if not fitting:
        wanted = key.split(".")[0]
        raise InputError(f"no {kind} {wanted!r} with a key after it" + nearest(wanted, list(named), f"{kind}s"))
    name = max(fitting, key=len)
    return named[name], key[len(name) + 1 :]


def value(text: str) -> Any:
    """Parses `text` as a TOML value; a bare word that is not TOML is a string."""
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        if not text or re.match(r"[\[{\"']", text):
            raise InputError(f"value {text!r} is not valid TOML: {error}") from None
        return text
    return parsed["value"] if len(parsed) == 1 else text
