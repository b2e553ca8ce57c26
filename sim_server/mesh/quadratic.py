# SPDX-License-Identifier: MIT
"""Quadratic tetrahedra: ten nodes, four corners and one on each edge, numbered as VTK, Abaqus and FEBio do."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.mesh.surface import volumes

EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))  # ends of the edges of the nodes 4 to 9
MIRRORED = (0, 1, 3, 2, 4, 8, 7, 6, 5, 9)  # the nodes of an element wound the other way round
# Tetrahedra at the corners, and those around each diagonal of the octahedron that is left between them
AT_CORNERS = ((0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3))
DIAGONALS = ((4, 9), (5, 7), (6, 8))
AROUND = tuple(
    tuple((a, b, ring[(k + 1) % 4], ring[k]) for k in range(4))
    for (a, b), ring in zip(DIAGONALS, ((5, 8, 7, 6), (4, 6, 9, 8), (4, 7, 9, 5)), strict=True)
)
PREFERRED = 1e-9  # part by which a later diagonal must be shorter: rounding does not choose among equal ones


def quadratic_cells_of(rest: Float64, blocks: Sequence[Any]) -> tuple[Int64, list[str]] | None:
    """Returns the cells (m, 10) of meshio's `blocks`, and one sentence per change; None unless all volume cells are
    quadratic tetrahedra.

    The nodes on the edges are put in order where the file, or meshio for its format, has them in another one: by the
    middles of edges that they are nearest to in most of the cells.
    """
    solid = [b for b in blocks if b.dim == 3 and len(b.data)]
    if not solid or any(b.type != "tetra10" for b in solid):
        return None
    cells = np.concatenate([np.asarray(b.data) for b in solid]).astype(np.int64)
    if cells.min() < 0 or cells.max() >= len(rest):
        return cells, []
    places, counts = np.unique(_nearest_edges(rest, cells), axis=0, return_counts=True)
    place = places[counts.argmax()]
    if (np.sort(place) != np.arange(6)).any() or (place == np.arange(6)).all():
        return cells, []
    ordered = cells.copy()
    ordered[:, 4 + place] = cells[:, 4:]
    return ordered, [f"the nodes on the edges of {len(cells)} tetra10 cells put in order"]


def _nearest_edges(rest: Float64, cells: Int64) -> Int64:
    """Returns the edge whose middle is nearest to each node on an edge, (m, 6)."""
    x = rest[cells]
    middles = x[:, np.array(EDGES)].mean(axis=2)
    distance = np.linalg.norm(x[:, 4:, None] - middles[:, None], axis=3)
    nearest: Int64 = distance.argmin(axis=2)
    return nearest


def with_mid_nodes(rest: Float64, tets: Int32) -> tuple[Float64, Int32]:
    """Returns nodes (n + e, 3) [m] and quadratic tetrahedra (m, 10) of linear ones (m, 4): the middles of the e edges
    come behind the nodes, in the order of the edges' ends."""
    ends = np.sort(tets[:, np.array(EDGES)].reshape(-1, 2), axis=1)
    edges, number = np.unique(ends, axis=0, return_inverse=True)
    middles = rest[edges].mean(axis=1)
    cells = np.concatenate([tets, len(rest) + number.reshape(-1, 6)], axis=1)
    return np.concatenate([rest, middles]), cells.astype(np.int32)


def sub_tetrahedra(rest: Float64, quadratic: NDArray[np.integer]) -> Int32:
    """Splits elements (m, 10) into linear tetrahedra on their nodes, (8 m, 4), the eight of an element in a row.

    Four are at the corners, four around the shortest diagonal of the octahedron between them; a diagonal with a
    tetrahedron of no positive volume is not taken if there is another. Faces are split by their edges' nodes alone, so
    neighbours match.
    """
    x = rest[quadratic]
    around = np.array(AROUND)
    lengths = np.stack([np.linalg.norm(x[:, a] - x[:, b], axis=1) for a, b in DIAGONALS], axis=1)
    lengths *= 1 + PREFERRED * np.arange(3)
    least = [volumes(rest, quadratic[:, tets].reshape(-1, 4)).reshape(-1, 4).min(axis=1) for tets in around]
    chosen = np.where(np.stack(least, axis=1) > 0, lengths, np.inf).argmin(axis=1)
    inner = np.take_along_axis(quadratic[:, None], around[chosen].reshape(len(x), 1, 16), axis=2).reshape(-1, 4, 4)
    return np.concatenate([quadratic[:, np.array(AT_CORNERS)], inner], axis=1).reshape(-1, 4).astype(np.int32)
