# SPDX-License-Identifier: MIT
"""One scene with many copies of the objects of another one, which do not touch each other."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.embedded.scene import Scene, without_none
from sim_server.embedded.simulation import Simulation
from sim_server.errors import InputError
from sim_server.scene import where

Select = str | Mapping[str, Any] | int | list[int]  # how nodes of a copy are chosen: see Copies.nodes


@dataclass(frozen=True)
class Copies:
    """What names the objects of a scene have in each of its copies. names: by object, that in each copy."""

    names: dict[str, list[str]]

    @property
    def number(self) -> int:
        """Number of copies."""
        return len(next(iter(self.names.values())))

    def of(self, copy: int) -> list[str]:
        """Returns the names of the objects of a copy."""
        return [each[copy] for each in self.names.values()]

    def nodes(self, simulation: Simulation, select: Select, what: str) -> tuple[str, NDArray[np.intp]]:
        """Returns an object, and the rows of its nodes (copies, k) in all nodes of a simulation of these copies.

        select: "tip", an expression of rest coordinates as for `where` in a scene, or row numbers; where the scene has
        several objects {"NAME": such}. what: the argument that it is, for messages. Raises InputError.
        """
        name, chosen = self._object(select, what)
        world = simulation.inside.world
        rows = np.asarray(_rows(simulation, self.names[name][0], chosen, f"{what} of object {name!r}"))
        return name, np.array([world.body(copy).first + rows for copy in self.names[name]])

    def _object(self, select: Select, what: str) -> tuple[str, Any]:
        if not isinstance(select, Mapping):
            if len(self.names) == 1:
                return next(iter(self.names)), select
            raise InputError(f"{what} = {select!r}: the scene has several objects; write {{NAME: {select!r}}}")
        if len(select) != 1 or next(iter(select)) not in self.names:
            raise InputError(f"{what} = {select!r}: must name one of {', '.join(self.names)}")
        return next(iter(select.items()))


def copied(scene: Scene, copies: int, effects: Mapping[str, Any]) -> tuple[Scene, Copies]:
    """Returns the scene with each object, holder and tie `copies` times, at the same places, and their names.

    effects: beside those of the objects, or instead of them. Obstacles are there once. Raises InputError where copies
    of several objects would touch each other.
    """
    table = scene.table()
    objects = [o["name"] for o in table["object"]]
    names = {name: [f"{name}-{k}" for k in range(copies)] for name in objects}
    contact = table.get("effects", {}).get("contact")
    if contact is not None:
        _keep_apart(contact, objects)
        for pair in list(contact.get("friction") or ()):
            contact["friction"] += [_renamed(pair, names, k) for k in range(copies)]
        contact["friction"] = [p for p in contact.get("friction") or () if not {*p["between"]} & {*objects}] or None
    for o in table["object"]:
        o["effects"] = {**o["effects"], **effects}
        o.pop("skin", None)  # for viewers, and there are none
    for key in ("object", "holder", "attachment", "spring"):
        if table.get(key):
            table[key] = [_renamed(each, names, k) for k in range(copies) for each in table[key]]
    return Scene(without_none(table)), Copies(names)


def _keep_apart(contact: dict[str, Any], objects: list[str]) -> None:
    if contact.get("between") and len(objects) > 1:
        raise InputError(
            f"effects.contact.between = true with the objects {', '.join(objects)}: their copies are at the same "
            "places and would touch; allowed: false"
        )
    contact["between"] = False


def _renamed(table: Mapping[str, Any], names: Mapping[str, list[str]], copy: int) -> dict[str, Any]:
    """Returns a table with the names that it and the objects in it have in a copy."""
    new = dict(table)
    if "name" in new:
        new["name"] = f"{new['name']}-{copy}"
    for key in ("object", "to"):
        if new.get(key) in names:
            new[key] = names[new[key]][copy]
    if isinstance(between := new.get("between"), list | tuple):
        new["between"] = [
            _renamed(end, names, copy) if isinstance(end, Mapping) else names[end][copy] if end in names else end
            for end in between
        ]
    return new


def _rows(simulation: Simulation, name: str, chosen: Any, what: str) -> list[int]:
    """Returns the numbers of the chosen nodes of an object. Raises InputError."""
    mesh = simulation.inside.world.body(name).mesh
    if isinstance(chosen, str) and chosen == "tip":
        return [simulation.tip(name)]
    if isinstance(chosen, str):
        try:
            found = np.flatnonzero(where.nodes(chosen, mesh)).tolist()
        except InputError as error:
            raise InputError(f"{what}: {error}") from None
        if not found:
            raise InputError(f"{what} = {chosen!r}: no node is there")
        return found
    rows = np.atleast_1d(np.asarray(chosen))
    if rows.ndim != 1 or rows.dtype.kind not in "iu" or not rows.size:
        raise InputError(f'{what} = {chosen!r}: must be "tip", an expression such as "X > 0.1", or numbers of nodes')
    if ((rows < 0) | (rows >= len(mesh.rest))).any():
        raise InputError(f"{what} = {chosen!r}: numbers of nodes are from 0 to {len(mesh.rest) - 1}")
    return [int(row) for row in rows]
