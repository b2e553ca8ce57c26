# SPDX-License-Identifier: MIT
"""Named groups of a mesh: physical groups of gmsh, sets of cells and points of other formats.

A group of volume cells has elements, and their nodes; one of faces, edges or points has nodes. A name that stands for
several of these has all of them. Cells that have a number and no name are the group of that number, as "3".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64
from sim_server.errors import InputError
from sim_server.mesh.cells import per_tetrahedron
from sim_server.mesh.quadratic import EDGES

TAGS = ("gmsh:physical", "medit:ref", "tetgen:ref")  # numbers of cells by which files tell groups
NAMED = 40  # groups named in a message
MOST_NUMBERS = 100  # more numbers without names are no groups: they count something
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
Mask = NDArray[np.bool_]


NONE, NO_FACES = np.zeros(0, np.int32), np.zeros((0, 4), np.int32)


@dataclass(frozen=True)
class Group:
    """What a group of a mesh has.

    elements: int32 (k,), numbers of tetrahedra, of a quadratic mesh the eight of each element
    faces: int32 (f, 4), corners of its triangles, the last one twice, and quadrilaterals
    nodes: int32 (p,), nodes beside those of its elements and faces
    """

    elements: Int32 = field(default_factory=lambda: NONE)
    faces: Int32 = field(default_factory=lambda: NO_FACES)
    nodes: Int32 = field(default_factory=lambda: NONE)

    def holds(self, tets: Int32, count: int) -> Mask:
        """Returns which of `count` nodes it has, (count,). tets: of the mesh, (m, 4)"""
        held = np.zeros(count, bool)
        for nodes in (tets[self.elements], self.faces, self.nodes):
            held[nodes] = True
        return held

    def with_mid_nodes(self, quadratic: Int32) -> "Group":
        """Returns it in the mesh with a node in the middle of each edge. quadratic: the elements, (m, 10)"""
        elements = (8 * self.elements[:, None] + np.arange(8)).ravel().astype(np.int32)
        if not len(self.faces):
            return replace(self, elements=elements)
        own, ends = np.sort(self.faces[:, np.array(PAIRS)], axis=2), np.sort(quadratic[:, np.array(EDGES)], axis=2)
        code = np.array([int(quadratic.max()) + 1, 1])
        middle = quadratic[:, 4:][np.isin(ends @ code, own @ code)]
        nodes = np.unique(np.concatenate([self.nodes, middle])).astype(np.int32)
        return replace(self, elements=elements, nodes=nodes)


def unknown(name: str, groups: Mapping[str, Group], mesh: str) -> InputError:
    """Returns the error of a name that is no group, which lists those that there are."""
    return InputError(f"no group {name!r} in {mesh}; groups of it: {listed(groups)}")


def listed(groups: Mapping[str, Group]) -> str:
    """Returns the names of groups and what they have, for a message."""
    words = [f"{name} ({'elements' if len(g.elements) else 'nodes'})" for name, g in list(groups.items())[:NAMED]]
    return ", ".join(words) + (f", ... {len(groups)} in all" if len(groups) > NAMED else "") if words else "none"


def read_groups(data: Any, numbers: Int64, eightfold: bool) -> dict[str, Group]:
    """Returns the groups of what meshio read, by name.

    numbers: number of each node of the file in the mesh, -1 where it was dropped
    eightfold: elements are quadratic, of eight tetrahedra each; else as `cells.tetrahedra` makes them
    """
    return {name: _group(data.cells, members, numbers, eightfold) for name, members in sorted(_members(data).items())}


@dataclass
class _Members:
    """Members of a group in a file: which cells of each block (by its number) are, and numbers of points."""

    cells: dict[int, Mask] = field(default_factory=dict)
    points: list[Int64] = field(default_factory=list)

    def add(self, number: int, block: Any, chosen: Any) -> None:
        """Adds cells of a block, by their numbers or a mask."""
        self.cells.setdefault(number, np.zeros(len(block.data), bool))[chosen] = True


def _members(data: Any) -> dict[str, _Members]:
    names = {(int(dim), int(tag)): name for name, (tag, dim) in _physical(data)}
    found = {name: _Members() for name in names.values()}
    for key in TAGS:
        tagged = list(zip(data.cells, map(np.asarray, data.cell_data.get(key, ())), strict=False))
        values = np.unique(np.concatenate([tags for _, tags in tagged])) if tagged else np.zeros(0)
        numbers = np.setdiff1d(values, [0]).tolist()
        for k, (block, tags) in enumerate(tagged):
            for tag in numbers:
                name = names.get((block.dim, int(tag)), str(int(tag)) if len(numbers) <= MOST_NUMBERS else "")
                if name and len(tags) == len(block.data) and (chosen := tags == tag).any():
                    found.setdefault(name, _Members()).add(k, block, chosen)
    for name, parts in data.cell_sets.items():
        if not name.startswith("gmsh:"):
            _add_set(found.setdefault(name, _Members()), data.cells, parts)
    for name, points in data.point_sets.items():
        found.setdefault(name, _Members()).points.append(np.asarray(points, np.int64).ravel())
    return found


def _physical(data: Any) -> list[tuple[str, Any]]:
    return [(name, value) for name, value in data.field_data.items() if np.shape(value) == (2,)]


def _add_set(members: _Members, blocks: Sequence[Any], parts: Sequence[Any]) -> None:
    """Adds a set of cells. parts: numbers in each block, None for none; or lists of such, of sets made of others."""
    if any(isinstance(part, list) and any(np.ndim(p) for p in part) for part in parts):
        for part in parts:
            _add_set(members, blocks, part)
        return
    for k, (block, part) in enumerate(zip(blocks, parts, strict=False)):
        if part is not None and np.size(part):
            members.add(k, block, np.asarray(part, np.int64))


def _group(blocks: Sequence[Any], members: _Members, numbers: Int64, eightfold: bool) -> Group:
    masks = [members.cells.get(k, np.zeros(len(block.data), bool)) for k, block in enumerate(blocks)]
    chosen = per_tetrahedron(blocks, masks)
    if eightfold:
        chosen = np.concatenate([mask for block, mask in zip(blocks, masks, strict=True) if block.dim == 3])
    elements = np.flatnonzero(np.repeat(chosen, 8) if eightfold else chosen)
    faces, nodes = [np.zeros((0, 4), np.int64)], [*members.points, np.zeros(0, np.int64)]
    for block, mask in zip(blocks, masks, strict=True):
        if block.dim == 3 or not mask.any():
            continue
        cells = np.asarray(block.data)[mask].astype(np.int64)
        nodes.append(cells.ravel())
        if block.type.startswith("triangle"):
            faces.append(cells[:, [0, 1, 2, 2]])
        elif block.type.startswith("quad"):
            faces.append(cells[:, :4])
    corners, others = numbers[np.concatenate(faces)], np.unique(numbers[np.concatenate(nodes)])
    corners = corners[(corners >= 0).all(axis=1)]
    others = np.setdiff1d(others[others >= 0], corners)
    return Group(elements.astype(np.int32), corners.astype(np.int32), others.astype(np.int32))
