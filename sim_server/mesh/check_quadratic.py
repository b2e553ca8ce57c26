# SPDX-License-Identifier: MIT
"""Checks of quadratic tetrahedra before anything is computed on them; complaints as in check.py."""

from collections.abc import Iterator
from typing import cast

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.mesh.check import (
    FLAT,
    coordinates,
    duplicate_nodes,
    duplicate_tets,
    flat_tets,
    indices,
    named,
    repeated_corners,
    unused_nodes,
)
from sim_server.mesh.check import shapes as linear_shapes
from sim_server.mesh.quadratic import EDGES, MIRRORED, sub_tetrahedra
from sim_server.mesh.shape_functions import quadratic_gradients
from sim_server.mesh.surface import volumes

Cells = NDArray[np.integer]


def quadratic_complaints(rest: Float64, cells: Cells) -> Iterator[str]:
    """Yields what is wrong with the elements (m, 10), most basic first; numbers are those of elements."""
    for basic in (shapes, coordinates, indices, repeated_corners, node_roles, edge_nodes):
        if text := basic(rest, cells):
            yield text
            return
    corners = cells[:, :4]
    found = [f(rest, corners) for f in (flat_tets, duplicate_tets)]
    found += [f(rest, cells) for f in (duplicate_nodes, unused_nodes)]
    yield from (text for text in found if text)
    if not any(found) and (text := curved_too_much(rest, wound(rest, cells))):
        yield text


def wound(rest: Float64, cells: Cells) -> Int32:
    """Returns the elements with their corners in the order of a positive volume."""
    out = cells.astype(np.int32)
    turned = volumes(rest, cells[:, :4]) < 0
    out[turned] = out[turned][:, MIRRORED]
    return out


def shapes(rest: Float64, cells: Cells) -> str | None:
    if cells.ndim != 2 or cells.shape[1] != 10:
        return f"quadratic tetrahedra have shape {cells.shape}: must be (m, 10)"
    return linear_shapes(rest, cells[:, :4])


def node_roles(rest: Float64, cells: Cells) -> str | None:
    both = np.isin(cells[:, 4:], cells[:, :4])
    bad = np.flatnonzero(both.any(axis=1))
    reason = "is a corner of another element: neighbours must share whole edges"
    return named("tet", bad, reason, lambda i: f"node {cells[i, 4:][both[i]][0]} on an edge of it")


def edge_nodes(rest: Float64, cells: Cells) -> str | None:
    """Describes edges with several nodes on them, and nodes on several edges."""
    ends = np.sort(cells[:, np.array(EDGES)].reshape(-1, 2), axis=1)
    edge = np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1)
    middle = cells[:, 4:].ravel()
    pairs = np.unique(np.stack([edge, middle], axis=1), axis=0)
    several = np.bincount(pairs[:, 0], minlength=edge.max() + 1)[edge] > 1
    shared = np.bincount(pairs[:, 1], minlength=len(rest))[middle] > 1
    odd = (several | shared).reshape(-1, 6)

    def place(i: int) -> str:
        k = int(odd[i].argmax())
        return f"node {cells[i, 4 + k]} on the edge of nodes {cells[i, list(EDGES[k])].tolist()}"

    return named("tet", np.flatnonzero(odd.any(axis=1)), "an edge must have one node, a node one edge", place)


def curved_too_much(rest: Float64, cells: Int32) -> str | None:
    """Describes elements that are turned over at a point of integration, or cannot be split into sub-tetrahedra."""
    parts = quadratic_gradients(rest, cells)[0] / np.abs(volumes(rest, cells[:, :4]))[:, None]
    split = volumes(rest, sub_tetrahedra(rest, cells)).reshape(-1, 8) / np.abs(volumes(rest, cells[:, :4]))[:, None]
    least = cast(Float64, np.minimum(4 * parts.min(axis=1), 8 * split.min(axis=1)))
    bad = np.flatnonzero(~(least > FLAT))
    reason = 'curved so much that it is turned over inside (straighten its edges, or elements = "linear")'
    return named("tet", bad, reason, lambda i: f"least volume {least[i]:.3g} of that between its corners")
