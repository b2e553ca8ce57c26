# SPDX-License-Identifier: MIT
"""Clusters of any number of nodes that couple all of their nodes, and their places in the system."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.mechanics.world import World

Couplings = tuple[Int64, Int32, Int32]
Places = tuple[Int32, Int32, Int32, Int32, Int32, Int32]
SLICE = 32  # clusters of a slice: threads of a warp (kernels/strain_cells.cuh)


@dataclass(frozen=True)
class Clusters:
    """Nodes of clusters, none twice in one.

    start: (m + 1,), where the nodes of each begin; nodes: (start[m],), of the scene
    slots: (start[m],), places that kernels have the results of each node at
    number: (m,), the cell or patch that each is; None: 0, 1, 2, ...
    """

    start: Int32
    nodes: Int32
    slots: Int32
    number: Int32 | None = None

    @property
    def owner(self) -> Int32:
        """Number of the cluster of each of the nodes, (start[m],)."""
        number = np.arange(len(self.start) - 1, dtype=np.int32) if self.number is None else self.number
        return np.repeat(number, np.diff(self.start))

    @property
    def first_nodes(self) -> Int32:
        """First node of each, (m,)."""
        return self.nodes[self.start[:-1]]

    def taken(self, mask: NDArray[np.bool_]) -> "Clusters":
        """Returns some of them, with the numbers that they have here. mask: (m,)"""
        sizes = np.diff(self.start)
        kept = np.repeat(mask, sizes)
        start = np.concatenate([[0], np.cumsum(sizes[mask])]).astype(np.int32)
        return Clusters(start, self.nodes[kept], self.slots[kept], np.flatnonzero(mask).astype(np.int32))


@dataclass(frozen=True)
class PatchedCells:
    """Clusters of an effect: strain cells with a deviator, patches, and cells that have a dilatation alone; patches
    couple whatever these do."""

    cells: Clusters
    patches: Clusters
    dilating: Clusters


@dataclass(frozen=True)
class PatchedTetrahedra:
    """Tetrahedra (m, 4) that write the blocks of their edges, and clusters of the nodes of their patches."""

    elements: Int32
    patches: Clusters


def couplings(clusters: Clusters, world: World, free: Float64) -> Couplings:
    """Keys row * n + column, corners (k, 2) and owners (k,) of all couplings above the diagonal between free nodes.

    Those of a held row and a free column have the key (row + n) * n + column. corners: into clusters.nodes
    free (nodes,): not 0 at nodes that may move
    """
    n, parts = world.nodes, []
    for first, size in _by_size(clusters.start):
        corner = first[:, None] + np.arange(size)
        shape = (len(first), size, size)
        a, b = (np.broadcast_to(c, shape).ravel() for c in (corner[:, :, None], corner[:, None, :]))
        i, j = (clusters.nodes[c].astype(np.int64) for c in (a, b))
        here = (i < j) & (free[i] > 0) & (free[j] > 0)
        held = (world.held[i] > 0) & (free[j] > 0)
        parts += [(i * n + j, a, b, here), ((i + n) * n + j, a, b, held)]
    keys = [key[mask] for key, _, _, mask in parts]
    corners = [np.stack([a[mask], b[mask]], axis=1).astype(np.int32) for _, a, b, mask in parts]
    every = np.concatenate([np.zeros((0, 2), np.int32), *corners])
    return np.concatenate([np.zeros(0, np.int64), *keys]), every, clusters.owner[every[:, 0]]


def places(clusters: Clusters, found: Couplings, n: int, blocks: Int64) -> Places:
    """Returns the members of a Stencil (system.py) but for patches.

    found: couplings of the clusters; n: nodes; blocks: keys of all blocks, ascending
    """
    order = np.argsort(clusters.nodes, kind="stable")
    corner_start = np.concatenate([[0], np.cumsum(np.bincount(clusters.nodes, minlength=n))]).astype(np.int32)
    keys, corners, owners = found
    by_block = np.lexsort((owners, keys))
    pair_start = np.searchsorted(keys[by_block], np.append(blocks, 2 * np.int64(n) * n)).astype(np.int32)
    pairs = np.ascontiguousarray(clusters.slots[corners[by_block]])
    corner = np.ascontiguousarray(clusters.slots[order])
    return corner_start, corner, pair_start, pairs, clusters.owner[order], owners[by_block]


def united(clusters: Clusters, group: Int32, groups: int) -> tuple[Clusters, Int32, Int32]:
    """Returns one cluster per group of clusters, with slots 0, 1, 2, ...; and which corners of which group's clusters
    are at each slot: start (slots + 1,) into corners of `clusters`, which comes second.

    group (m,): of each cluster
    """
    n = int(clusters.nodes.max(initial=0)) + 1
    keys = group[clusters.owner].astype(np.int64) * n + clusters.nodes
    slots, of = np.unique(keys, return_inverse=True)
    start = np.searchsorted(slots, np.arange(groups + 1) * n).astype(np.int32)
    made = Clusters(start, (slots % n).astype(np.int32), np.arange(len(slots), dtype=np.int32))
    counts = np.concatenate([[0], np.cumsum(np.bincount(of.ravel(), minlength=len(slots)))]).astype(np.int32)
    return made, counts, np.argsort(of.ravel(), kind="stable").astype(np.int32)


def members(group: Int32, groups: int) -> tuple[Int32, Int32]:
    """Returns the members of groups: start (groups + 1,) into them, and their numbers, ascending in each group.

    group (m,): of each item
    """
    order = np.argsort(group, kind="stable").astype(np.int32)
    return np.searchsorted(group[order], np.arange(groups + 1)).astype(np.int32), order


def _by_size(start: Int32) -> Iterator[tuple[Int64, int]]:
    """Yields where clusters of each size begin, and the size."""
    sizes = np.diff(start)
    for size in np.unique(sizes):
        yield start[:-1][sizes == size].astype(np.int64), int(size)


@dataclass(frozen=True)
class Slices:
    """Nodes of clusters in slices of 32 clusters: node k of all of a slice, one cluster after another, then node k + 1.

    first, width: (m,) slot of a cluster's first node, and the number of its slots, as many as of the largest one of its
    slice. nodes: (slots,); gradients: (3, slots), 0 where a cluster has no more nodes. The last slot is of none.
    """

    first: Int32
    width: Int32
    nodes: Int32
    gradients: Float64
    clusters: Clusters


def sliced(start: Int32, nodes: Int32, gradients: Float64) -> Slices:
    """Lays out clusters; gradients (start[m], 3)."""
    m, sizes = len(start) - 1, np.diff(start)
    widest = np.zeros(-(-m // SLICE), np.int64)
    np.maximum.at(widest, np.arange(m) // SLICE, sizes)
    begin = np.concatenate([[0], np.cumsum(SLICE * widest)])
    number = np.arange(m)
    first, width = (begin[:-1][number // SLICE] + number % SLICE).astype(np.int32), widest[number // SLICE]
    owner = np.repeat(number, sizes)
    slots = (first[owner] + SLICE * (np.arange(len(nodes)) - start[:-1][owner])).astype(np.int32)
    total = int(begin[-1]) + SLICE
    laid = np.zeros(total, np.int32)
    every = first[:, None] + SLICE * np.arange(int(widest.max(initial=0)))
    inside = np.arange(every.shape[1]) < width[:, None]
    laid[every[inside]] = np.broadcast_to(nodes[start[:-1], None], every.shape)[inside]
    laid[slots] = nodes
    rows = np.zeros((3, total))
    rows[:, slots] = gradients.T
    return Slices(first, width.astype(np.int32), laid, rows, Clusters(start, nodes, slots))
