# SPDX-License-Identifier: MIT
"""Strain cells of linear tetrahedra: each by itself, or smoothed over edges, and over patches for the dilatation.

Source: Bonet and Burton 1998 (averaged dilatation of linear tetrahedra); Nguyen-Thoi, Liu, Lam and Zhang 2009
(smoothing over faces of tetrahedra; here over edges); numbers of nodes and tetrahedra are those of the mesh.
"""

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.mesh.patches import patches
from sim_server.mesh.shape_functions import shape_gradients
from sim_server.mesh.strain_cells import DEVIATOR, DILATATION, StrainCells
from sim_server.mesh.surface import EDGES


def tetrahedron_cells(rest: Float64, tets: Int32, region: Int32) -> StrainCells:
    """Each tetrahedron a cell, in patches of about eight. region (m,): of each tetrahedron; no patch has two."""
    volume, gradients = _all_gradients(rest, tets)
    start = np.arange(0, 4 * len(tets) + 1, 4, dtype=np.int32)
    element = np.arange(len(tets), dtype=np.int32)
    return StrainCells(
        start, tets.ravel().copy(), gradients.reshape(-1, 3), volume, element, patches(rest, tets, region)
    )


def edge_cells(rest: Float64, tets: Int32, region: Int32) -> StrainCells:
    """A cell around each edge, of a sixth of each tetrahedron at it, for the deviator; behind them one of each patch of
    tetrahedra for the dilatation, since patches of edges would couple twice as many nodes. One, not one of
    each tetrahedron: less to compute, and on the linear theory the same.

    An edge between regions has a cell in each. region (m,): of each tetrahedron
    """
    volume, gradients = _all_gradients(rest, tets)
    patch, m = patches(rest, tets, region), len(tets)
    ends = np.sort(tets[:, EDGES].reshape(-1, 2), axis=1).astype(np.int64)
    keys = np.concatenate([ends, np.repeat(region, 6)[:, None]], axis=1)
    edge = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    edges = int(edge.max(initial=-1)) + 1
    cell = np.concatenate([edge, edges + patch])  # of 6 parts of each tetrahedron, and of all of it
    tet_of = np.concatenate([np.repeat(np.arange(m), 6), np.arange(m)])
    share = np.concatenate([np.repeat(volume / 6, 6), volume])
    first = np.unique(cell, return_index=True)[1]
    total, element = np.bincount(cell, share).astype(np.float64), tet_of[first].astype(np.int32)
    pairs, place = np.unique(cell[:, None] * len(rest) + tets[tet_of], return_inverse=True)
    weighted = (share / total[cell])[:, None, None] * gradients[tet_of]
    summed = [np.bincount(place.ravel(), weighted[:, :, k].ravel(), len(pairs)) for k in range(3)]
    start = np.searchsorted(pairs, np.arange(len(total) + 1) * len(rest)).astype(np.int32)
    return StrainCells(
        start, (pairs % len(rest)).astype(np.int32), np.stack(summed, axis=1), total, element, patch[element],
        np.where(np.arange(len(total)) < edges, DEVIATOR, DILATATION).astype(np.int32),
    )  # fmt: skip


def _all_gradients(rest: Float64, tets: Int32) -> tuple[Float64, Float64]:
    """Volumes (m,) [m3] and gradients of the shape functions of all corners, (m, 4, 3) [1/m]."""
    volume, others = shape_gradients(rest, tets)
    return volume, np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)
