# SPDX-License-Identifier: MIT
"""Strain cells of linear tetrahedra: each by itself, or smoothed over edges.

Source: Bonet and Burton 1998 (averaged dilatation of linear tetrahedra); Nguyen-Thoi, Liu, Lam and Zhang 2009
(smoothing over faces of tetrahedra; here over edges); numbers of nodes and tetrahedra are those of the mesh.
"""

import numpy as np

from sim_server.arrays import Float64, Int32, Int64
from sim_server.mesh.patches import patches
from sim_server.mesh.shape_functions import shape_gradients
from sim_server.mesh.strain_cells import StrainCells

EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])  # of a tetrahedron


def tetrahedron_cells(rest: Float64, tets: Int32, region: Int32) -> StrainCells:
    """Each tetrahedron a cell, in patches of about eight. region (m,): of each tetrahedron; no patch has two."""
    volume, gradients = _all_gradients(rest, tets)
    start = np.arange(0, 4 * len(tets) + 1, 4, dtype=np.int32)
    element = np.arange(len(tets), dtype=np.int32)
    return StrainCells(
        start, tets.ravel().copy(), gradients.reshape(-1, 3), volume, element, patches(rest, tets, region)
    )


def edge_cells(rest: Float64, tets: Int32, region: Int32) -> StrainCells:
    """A cell around each edge, of a sixth of each tetrahedron at it, in the patch that has most of its volume.

    An edge between regions has a cell in each. region (m,): of each tetrahedron
    """
    volume, gradients = _all_gradients(rest, tets)
    share, tet_of = np.repeat(volume / 6, 6), np.repeat(np.arange(len(tets)), 6)
    ends = np.sort(tets[:, EDGES].reshape(-1, 2), axis=1).astype(np.int64)
    keys = np.concatenate([ends, region[tet_of, None]], axis=1)
    _, element, cell = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    cell, cells = cell.ravel(), len(element)
    total: Float64 = np.bincount(cell, share, cells).astype(np.float64)
    nodes = tets[tet_of]  # (6 m, 4), of the parts of cells
    pairs, place = np.unique(cell[:, None] * len(rest) + nodes, return_inverse=True)
    weighted = (share / total[cell])[:, None, None] * gradients[tet_of]
    summed = [np.bincount(place.ravel(), weighted[:, :, k].ravel(), len(pairs)) for k in range(3)]
    start = np.searchsorted(pairs, np.arange(cells + 1) * len(rest)).astype(np.int32)
    patch = _most_of(cell, patches(rest, tets, region)[tet_of].astype(np.int64), share, cells)
    return StrainCells(
        start, (pairs % len(rest)).astype(np.int32), np.stack(summed, axis=1), total, tet_of[element].astype(np.int32),
        patch,
    )  # fmt: skip


def _all_gradients(rest: Float64, tets: Int32) -> tuple[Float64, Float64]:
    """Volumes (m,) [m3] and gradients of the shape functions of all corners, (m, 4, 3) [1/m]."""
    volume, others = shape_gradients(rest, tets)
    return volume, np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)


def _most_of(cell: Int64, patch: Int64, share: Float64, cells: int) -> Int32:
    """Returns the patch with most of each cell's volume, (cells,), of several the first; numbered without gaps."""
    number = patch.max(initial=-1) + 1
    keys, place = np.unique(cell * number + patch, return_inverse=True)
    held = np.round(np.bincount(place.ravel(), share, len(keys)) / share.max(initial=1e-300), 9)  # equal ones are equal
    owner, which = np.divmod(keys, number)
    order = np.lexsort((which, -held, owner))
    first = order[np.searchsorted(owner[order], np.arange(cells))]
    return np.unique(which[first], return_inverse=True)[1].ravel().astype(np.int32)
