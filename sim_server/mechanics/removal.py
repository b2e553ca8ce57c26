# SPDX-License-Identifier: MIT
"""Elements that a scene and its parameters have removed from an object, and what is left without them."""

import json
import re
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene

NUMBERS = re.compile(r"\s*(\d{1,9})(?:-(\d{1,9}))?(?:\s+|$)")
KEY = "object.{}.effects.cutting.removed"  # of the parameter, by the object's name
LEAST_MASS = 1e-6  # of its own, which a node without elements keeps, since equations divide by it


def ranges_of(text: str) -> list[tuple[int, int]]:
    """Returns first and last number of each part of a text such as "3 7-9 12". Raises ValueError."""
    at, ranges = 0, []
    while at < len(text):
        found = NUMBERS.match(text, at)
        if found is None:
            raise ValueError(f'{text[at : at + 20]!r} is no list of element numbers and ranges such as "3 7-9 12"')
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise ValueError(f"{found[0].strip()!r} is no range of element numbers, from a lower to a higher one")
        ranges.append((first, last))
        at = found.end()
    return ranges


@lru_cache(maxsize=8)
def numbers_of(text: str, count: int) -> Int64:
    """Returns the numbers of such a text, ascending, once each, not to be changed. Raises ValueError.

    count: of the elements that there are, from 0
    """
    ranges, named = ranges_of(text), np.zeros(count, bool)
    if ranges and (last := max(last for _, last in ranges)) >= count:
        raise ValueError(f"there is no element {last}: numbers are from 0 to {count - 1}")
    for first, last in ranges:
        named[first : last + 1] = True
    return np.flatnonzero(named)


def text_of(numbers: Sequence[int] | Int64) -> str:
    """Returns numbers as a text of ranges, from which `numbers_of` reads them."""
    found = np.unique(np.asarray(numbers, np.int64))
    if not len(found):
        return ""
    first = np.flatnonzero(np.diff(found, prepend=found[0] - 2) > 1)
    last = np.append(first[1:], len(found)) - 1
    ends = zip(found[first].tolist(), found[last].tolist(), strict=True)
    return " ".join(str(a) if a == b else f"{a}-{b}" for a, b in ends)


def removed_from(scene: Scene, body: Body) -> Int64:
    """Returns the numbers of the elements that a scene has removed from an object. Raises InputError."""
    params = scene.objects[body.index].effects.get("cutting")
    if params is None:
        return np.zeros(0, np.int64)
    try:
        return numbers_of(params.removed, len(body.mesh.tets))  # type: ignore[attr-defined]
    except ValueError as error:
        raise InputError(f"object {body.name!r}, effect cutting: removed: {error}") from None


def removal(scene: Scene, body: Body, numbers: Int64) -> dict[str, str]:
    """Returns the parameter, by its key as TOML, with which a scene has no such elements either."""
    return {KEY.format(body.name): json.dumps(text_of(np.append(removed_from(scene, body), numbers)))}


def present(scene: Scene, bodies: Sequence[Body]) -> Float64:
    """Returns 1 for each element of these bodies, one after another, 0 for those that the scene has removed."""
    parts = [np.ones(len(body.mesh.tets)) for body in bodies]
    for body, part in zip(bodies, parts, strict=True):
        part[removed_from(scene, body)] = 0
    return np.concatenate(parts)


def present_nodes(scene: Scene, world: World) -> Float64:
    """Returns the part of each node's elements that is left by volume, (nodes,): 1 where none was removed, 0 if all."""
    out = np.ones(world.nodes)
    for body in world.bodies:
        removed = removed_from(scene, body)
        if len(removed):
            size = body.mesh.volumes
            gone = np.zeros(len(size))
            gone[removed] = size[removed]
            n, corners = body.last - body.first, body.mesh.tets.ravel()
            whole = np.bincount(corners, weights=np.repeat(size, 4), minlength=n)
            left = np.bincount(corners[np.repeat(gone == 0, 4)], minlength=n)
            lost = np.bincount(corners, weights=np.repeat(gone, 4), minlength=n)
            out[body.nodes] = np.where(left > 0, 1 - lost / np.where(whole > 0, whole, 1), 0)
    return out


def masses_left(part: Float64, masses: Float64) -> Float64:
    """Returns the nodal masses without removed elements [kg]. part: of present_nodes; masses: with all elements."""
    return np.where(part > 0, part, LEAST_MASS) * masses
