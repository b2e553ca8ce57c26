# SPDX-License-Identifier: MIT
"""Bodies that a scene and its parameters have split along faces of elements: which nodes are copied, what has them.

The elements around a node that hang together through faces that are not open share it; each further group of them gets
a copy of it, one of the spare nodes behind the body's own. Nodes are copied cut after cut, so that what a cut has made
keeps its number in all later ones: the largest group keeps the node, of equal ones that with the first element.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sim_server.arrays import Int32, Int64
from sim_server.errors import InputError
from sim_server.mechanics.numbers import ranges_of, text_of
from sim_server.mesh import Mesh
from sim_server.mesh.faces import Faces
from sim_server.mesh.surface import FACES

if TYPE_CHECKING:
    from sim_server.mechanics.world import Body
    from sim_server.scene import Scene

KEY = "object.{}.effects.cutting.opened"  # of the parameter, by the object's name
KEPT = 8  # texts of an object whose results are kept


@dataclass(frozen=True)
class Split:
    """What has become of a body's mesh.

    tets (m, 4): elements, by nodes of the body and its spare ones; origin (n + spares,): node that each was copied
    from, itself at nodes of the mesh, -1 at spare nodes that are left; used: spare nodes in use; closed (f,): faces
    that hold two elements together
    """

    tets: Int32
    origin: Int32
    used: int
    closed: np.ndarray[Any, np.dtype[np.bool_]]

    @property
    def root(self) -> Int32:
        """Node of the mesh of which each node is a copy, itself at spare nodes that are left, (n + spares,)."""
        found = np.where(self.origin < 0, np.arange(len(self.origin)), self.origin)
        while (further := found[found] != found).any():
            found[further] = found[found[further]]
        return found.astype(np.int32)


def cuts_of(text: str) -> list[list[tuple[int, int]]]:
    """Returns the ranges of faces that each cut of such a text has opened, as "3 17-19; 40". Raises ValueError."""
    return [ranges_of(part, "face") for part in text.split(";")] if text.strip() else []


class Splitter:
    """Splits the mesh of one body.

    mesh: without spare nodes. Faces are numbered 4 e + k, the k-th of element e in the order of mesh.surface.FACES;
    a face between two elements has a number of each.
    """

    def __init__(self, name: str, mesh: Mesh, spares: int):
        self.name, self.spares, self.nodes = name, spares, len(mesh.rest)
        self.faces = Faces.of(mesh.tets)
        inner = np.asarray((self.faces.owners >= 0).all(axis=1))
        origin = np.concatenate([np.arange(self.nodes), np.full(spares, -1)]).astype(np.int32)
        self.whole = Split(mesh.tets.astype(np.int32), origin, 0, inner)
        self._face = np.zeros(4 * len(mesh.tets), np.int64)  # of each side
        for side in (0, 1):
            there = self.faces.sides[:, side] >= 0
            self._face[self.faces.sides[there, side]] = np.flatnonzero(there)
        local = FACES[self.faces.sides % 4]  # (f, 2, 3) corners in their elements
        where = mesh.tets[self.faces.owners[:, :, None], local]
        order = np.argsort(where, axis=2)
        slots = 4 * self.faces.owners[:, :, None] + np.take_along_axis(local, order, axis=2)
        self._slots = slots  # (f, 2, 3) of both elements, those at the same node opposite each other
        self._known: dict[str, Split] = {"": self.whole}

    def split(self, text: str) -> Split:
        """Returns what the cuts of a text make of the mesh. Raises ValueError."""
        text = text.strip()
        parts, begun = [], text
        while (made := self._known.get(begun)) is None:
            begun, _, last = begun.rpartition(";")
            begun = begun.strip()
            parts.append(last)
        for part in reversed(parts):
            made = self._cut(made, self._named(part))
        known = dict(list(self._known.items())[1:][-KEPT:])  # made anew: several threads ask
        self._known = {"": self.whole} | known | {text: made}
        return made

    def opened_by(self, text: str, faces: Int64) -> str:
        """Returns the text with one cut more, which opens these faces (numbers in `faces`)."""
        sides = text_of(self.faces.sides[faces, 0])
        return f"{text}; {sides}" if text.strip() else sides

    def _named(self, text: str) -> Int64:
        named, most = np.zeros(len(self.faces.owners), bool), len(self._face)
        for first, last in ranges_of(text, "face"):
            if last >= most:
                raise ValueError(f"there is no face {last}: numbers are from 0 to {most - 1}")
            named[self._face[first : last + 1]] = True
        return np.flatnonzero(named)

    def _cut(self, before: Split, faces: Int64) -> Split:
        """Opens faces; raises ValueError where spare nodes do not suffice."""
        closed, tets, origin, used = before.closed.copy(), before.tets.copy(), before.origin.copy(), before.used
        new = faces[closed[faces]]
        closed[new] = False
        touched = np.zeros(len(origin), bool)
        touched[tets.ravel()[self._slots[new].ravel()]] = True
        groups = self._groups(tets, touched, closed)
        wanted = sum(len(found) - 1 for _, found in groups)
        if used + wanted > self.spares:
            raise ValueError(
                f"it needs {wanted} more spare nodes, {self.spares - used} of cutting.spare = {self.spares} are left"
            )
        flat = tets.reshape(-1)
        for node, found in groups:
            for slots in found[1:]:
                copy = self.nodes + used
                used += 1
                flat[slots], origin[copy] = copy, node
        return Split(tets, origin, used, closed)

    def _groups(
        self, tets: Int32, touched: np.ndarray[Any, np.dtype[np.bool_]], closed: np.ndarray[Any, np.dtype[np.bool_]]
    ) -> list[tuple[int, list[Int64]]]:
        """Returns the touched nodes whose elements have come apart, each with the slots 4 e + a of each group, that
        which keeps the node first."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        flat = tets.reshape(-1)
        slots = np.flatnonzero(touched[flat])
        place = np.full(len(flat), -1)
        place[slots] = np.arange(len(slots))
        pairs = self._slots[closed].swapaxes(1, 2).reshape(-1, 2)
        pairs = place[pairs[touched[flat[pairs[:, 0]]]]]
        graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(slots), len(slots)))
        if not len(slots):
            return []
        _, group = connected_components(graph, directed=False)
        _, first, size = np.unique(group, return_index=True, return_counts=True)
        order = np.lexsort((first, -size, flat[slots[first]]))  # by node, then size, then first element
        nodes, members = flat[slots[first[order]]], np.split(
            slots[np.argsort(np.argsort(order)[group], kind="stable")], np.cumsum(size[order])[:-1]
        )  # fmt: skip
        begin = np.flatnonzero(np.concatenate([[True], nodes[1:] != nodes[:-1]]))
        ends = [*begin[1:], len(nodes)]
        return [(int(nodes[a]), members[a:b]) for a, b in zip(begin, ends, strict=True) if b - a > 1]


def opening(splitter: Splitter, text: str, faces: Int64) -> dict[str, str]:
    """Returns the parameter, by its key as TOML, with which these faces are open, too, as one cut more."""
    return {KEY.format(splitter.name): json.dumps(splitter.opened_by(text, faces))}


class Splitting:
    """The bodies of a scene that may be split, which list cutting with spare nodes.

    splitters: by index of the body
    """

    def __init__(self, splitters: dict[int, Splitter], first: Sequence[int], nodes: int):
        self.splitters, self._first, self._nodes = splitters, first, nodes
        self._follows: dict[int, Callable[[Scene], Int32]] = {}  # elements by the parameters, by id of their array
        self._last: tuple[Scene, dict[int, Split]] | None = None

    def of(self, scene: Scene, index: int) -> Split:
        """Returns what a scene has made of a body that may be split. Raises InputError."""
        last = self._last
        if last is None or last[0] is not scene:
            last = self._last = scene, {k: split_of(scene, k, each) for k, each in self.splitters.items()}
        return last[1][index]

    def tets(self, scene: Scene, body: Body) -> Int32:
        """Returns the elements of any body (m, 4), in node numbers of the scene."""
        if body.index not in self.splitters:
            return body.tets
        return self.of(scene, body.index).tets + np.int32(body.first)

    def nodes(self, scene: Scene, what: str) -> Int32:
        """Returns `origin` or `root` of all nodes, in numbers of the scene, (nodes,)."""
        found = np.arange(self._nodes, dtype=np.int32)
        for index in self.splitters:
            own, first = getattr(self.of(scene, index), what), self._first[index]
            found[first : first + len(own)] = np.where(own < 0, -1, own + first)
        return found

    def note(self, elements: Int32, compute: Callable[[Scene], Int32]) -> None:
        """Takes note of an array of elements that follows the scene."""
        self._follows[id(elements)] = compute

    def elements(self, scene: Scene, elements: Any) -> Any:
        """Returns elements by the parameters of a scene; those that do not follow it as they are."""
        compute = self._follows.get(id(elements))
        return elements if compute is None else compute(scene)


def split_of(scene: Scene, index: int, splitter: Splitter) -> Split:
    """Returns what a scene has made of a body. Raises InputError."""
    params: Any = scene.objects[index].effects["cutting"]
    try:
        return splitter.split(params.opened)
    except ValueError as error:
        raise InputError(f"object {splitter.name!r}, effect cutting: opened: {error}") from None


def with_spares(mesh: Mesh, splitter: Splitter, split: Split) -> Mesh:
    """Returns the mesh with spare nodes behind its own: copies where they are in use, the others at the first node."""
    root = split.root[splitter.nodes :]
    there = np.where(root < splitter.nodes, root, 0)
    return replace(mesh, rest=np.concatenate([mesh.rest, mesh.rest[there]]))
