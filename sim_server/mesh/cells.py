# SPDX-License-Identifier: MIT
"""Cells of a mesh file as tetrahedra: corners of quadratic cells, hexahedra, wedges and pyramids split.

A convex cell is split by cones from its node of smallest number to the faces that do not hold it; a quadrilateral
face is split along the diagonal from its node of smallest number. Both cells at a face thus use the same diagonal, and
neighbours match independently (Dompierre, Labbé, Vallet, Camarero 1999). A hexahedron gives 6
tetrahedra, a wedge 3, a pyramid 2.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int64
from sim_server.errors import InputError
from sim_server.mesh.surface import EDGES, volumes

# Faces by corner numbers, normals outward, in the order of nodes that meshio has for every format (VTK's).
FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
CORNERS = {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5}
TETS = {"tetra": 1, "hexahedron": 6, "wedge": 3, "pyramid": 2}  # that each is split into
SHAPE = {  # of each type of cell that is read; the corners of quadratic ones come first
    "tetra": "tetra", "tetra10": "tetra",
    "hexahedron": "hexahedron", "hexahedron20": "hexahedron", "hexahedron27": "hexahedron",
    "wedge": "wedge", "wedge15": "wedge", "wedge18": "wedge",
    "pyramid": "pyramid", "pyramid13": "pyramid", "pyramid14": "pyramid",
}  # fmt: skip


def tetrahedra(rest: Float64, blocks: Sequence[Any]) -> tuple[Int64, list[str]]:
    """Returns the tetrahedra (m, 4) of all volume cells in meshio's `blocks`, and one sentence per change.

    Raises InputError: no volume cells, other ones than those of SHAPE, node numbers out of range, or a cell that is
    too warped to be split.
    """
    counts: Counter[str] = Counter()
    for b in blocks:
        counts[b.type] += len(b.data)
    found = ", ".join(f"{n} {kind}" for kind, n in sorted(counts.items()) if n) or "none"
    solid = [b for b in blocks if b.dim == 3 and len(b.data)]
    if not solid:
        raise InputError(f"no tetrahedra or other volume cells; cells in it: {found}; allowed: {', '.join(SHAPE)}")
    if unknown := sorted({b.type for b in solid} - set(SHAPE)):
        raise InputError(f"cells of type {', '.join(unknown)} cannot be used ({found}); allowed: {', '.join(SHAPE)}")
    cells = {shape: _corners(shape, solid) for shape in CORNERS}
    said = [f"{n} {kind} cells reduced to their corners" for kind, n in counts.items() if SHAPE.get(kind, kind) != kind]
    tets = [cells.pop("tetra")]
    for shape, corners in cells.items():
        if len(corners):
            tets.append(split(rest, shape, corners))
            said.append(f"{len(corners)} {shape} cells split into {len(tets[-1])} tetrahedra")
    _check_diagonals(np.concatenate(tets), cells)
    return np.concatenate(tets), said


def per_tetrahedron(blocks: Sequence[Any], values: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Returns what each tetrahedron of `tetrahedra` has of the values of its cell, (m,). values: of each block"""
    parts = []
    for shape, count in TETS.items():
        own = [v for b, v in zip(blocks, values, strict=True) if b.dim == 3 and SHAPE.get(b.type) == shape]
        parts += [np.repeat(v, count) for v in own]
    return np.concatenate(parts)


def _corners(shape: str, blocks: Sequence[Any]) -> Int64:
    count = CORNERS[shape]
    parts = [np.asarray(b.data)[:, :count] for b in blocks if SHAPE[b.type] == shape]
    return np.concatenate([np.empty((0, count), np.int64), *parts]).astype(np.int64)


def split(rest: Float64, shape: str, corners: Int64) -> Int64:
    """Splits cells (m, c) of a shape, not tetra, into tetrahedra of positive volume, (k m, 4), k per cell."""
    if ((corners < 0) | (corners >= len(rest))).any():
        bad = int(np.flatnonzero(((corners < 0) | (corners >= len(rest))).any(axis=1))[0])
        raise InputError(f"{shape} {bad} has nodes {corners[bad].tolist()}: must be 0 to {len(rest) - 1}")
    least = corners.argmin(axis=1)
    tets = np.empty((len(corners), TETS[shape], 4), np.int64)
    for apex in range(CORNERS[shape]):
        here = corners[least == apex]
        opposite = [_triangles(here, face) for face in FACES[shape] if apex not in face]
        cones = np.concatenate(opposite, axis=1)[:, :, [0, 2, 1]]  # the base of positive volume is seen from inside
        tets[least == apex] = np.dstack([cones, np.repeat(here[:, apex, None], cones.shape[1], axis=1)])
    side = np.sign(volumes(rest, tets.reshape(-1, 4))).reshape(len(corners), -1)
    if (mixed := np.flatnonzero((side * side[:, :1] < 0).any(axis=1))).size:
        bad = int(mixed[0])
        raise InputError(
            f"{shape} {bad} (nodes {corners[bad].tolist()}) is too warped to be split into tetrahedra ({mixed.size} "
            "such cells): it must be convex"
        )
    turned = side[:, 0] < 0  # writers do not agree on the order of a wedge
    tets[turned] = tets[turned][:, :, [0, 2, 1, 3]]
    return tets.reshape(-1, 4)


def _triangles(corners: Int64, face: Sequence[int]) -> Int64:
    """Returns the triangles (m, 1 or 2, 3) of one face of cells (m, c)."""
    nodes = corners[:, list(face)]
    if len(face) == 3:
        return nodes[:, None]
    turn = (nodes.argmin(axis=1)[:, None] + np.arange(4)) % 4
    a, b, c, d = np.take_along_axis(nodes, turn, axis=1).T
    return np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1)


def _check_diagonals(tets: Int64, cells: dict[str, Int64]) -> None:
    """Raises InputError where a tetrahedron has the diagonal of a quadrilateral face that is split along the other."""
    quads = np.concatenate([cells[s][:, list(f)] for s in cells for f in FACES[s] if len(f) == 4])
    if not len(quads):
        return
    start = (quads.argmin(axis=1)[:, None] + np.array([1, 3])) % 4
    other = np.sort(np.take_along_axis(quads, start, axis=1), axis=1)
    edges = np.sort(np.concatenate([tets[:, list(e)] for e in EDGES]), axis=1)
    n = int(max(tets.max(), quads.max())) + 1
    crossed = np.flatnonzero(np.isin(other @ [n, 1], edges @ [n, 1]))
    if crossed.size:
        raise InputError(
            f"a tetrahedron meets the quadrilateral face of nodes {quads[crossed[0]].tolist()} along another diagonal "
            f"than the cell on the other side ({crossed.size} such faces): pyramids must stand between them"
        )
