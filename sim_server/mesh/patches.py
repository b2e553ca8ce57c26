# SPDX-License-Identifier: MIT
"""Compact patches of neighbouring tetrahedra, over which the change of volume is averaged."""

from collections import deque

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.mesh.surface import FACES

SIZE = 8  # tetrahedra of a patch
LEAST = 4  # a smaller one is merged into a neighbour


def patches(rest: Float64, tets: Int32, region: Int32) -> Int32:
    """Returns the number of the patch of each tetrahedron, (m,): 0 to patches - 1, without gaps.

    Each patch grows over faces, by the tetrahedron that brings no new node, of these by the nearest one; a patch that
    could not grow to LEAST joins its smallest neighbour. None reaches over faces between regions or parts.

    rest (n, 3): nodes at rest [m]; tets (m, 4); region (m,): number of the region of each tetrahedron
    """
    neighbours = face_neighbours(tets, region)
    corners = [set(tet) for tet in tets.tolist()]
    centroids = rest[tets].mean(axis=1)
    patch, members = [-1] * len(tets), list[list[int]]()
    waiting = deque(range(len(tets)))
    while waiting:
        seed = waiting.popleft()
        if patch[seed] < 0:
            members.append(_grown(seed, len(members), patch, neighbours, corners, centroids))
            # begin the next one beside it, so that few are left over in between
            waiting.extendleft(n for t in reversed(members[-1]) for n in neighbours[t] if patch[n] < 0)
    _merge(patch, members, neighbours)
    return np.unique(np.array(patch, np.int32), return_inverse=True)[1].ravel().astype(np.int32)


def face_neighbours(tets: Int32, region: Int32) -> list[list[int]]:
    """Returns the tetrahedra of the same region at the faces of each, in the order of their numbers."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = np.flatnonzero((np.diff(faces[order], axis=0) == 0).all(axis=1))
    pairs = np.stack([order[same], order[same + 1]], axis=1) // 4
    pairs = pairs[region[pairs[:, 0]] == region[pairs[:, 1]]]
    found: list[list[int]] = [[] for _ in tets]
    for a, b in pairs.tolist():
        found[a].append(b)
        found[b].append(a)
    return [sorted(each) for each in found]


def _grown(
    seed: int, number: int, patch: list[int], neighbours: list[list[int]], corners: list[set[int]], centroids: Float64
) -> list[int]:
    """Grows a patch from a tetrahedron; returns its members."""
    members, nodes, at = [seed], set(corners[seed]), centroids[seed]
    patch[seed] = number
    front = {n for n in neighbours[seed] if patch[n] < 0}
    while front and len(members) < SIZE:
        candidates = sorted(front)
        far = ((centroids[candidates] - at / len(members)) ** 2).sum(axis=1)
        _, _, best = min((len(corners[t] - nodes), d, t) for t, d in zip(candidates, far.tolist(), strict=True))
        members.append(best)
        patch[best] = number
        nodes |= corners[best]
        at = at + centroids[best]
        front = (front | {n for n in neighbours[best] if patch[n] < 0}) - {best}
    return members


def _merge(patch: list[int], members: list[list[int]], neighbours: list[list[int]]) -> None:
    """Merges patches of fewer than LEAST tetrahedra into their smallest neighbours."""
    for number, own in enumerate(members):
        if len(own) >= LEAST:
            continue
        beside = {patch[n] for t in own for n in neighbours[t]} - {number}
        if not beside:
            continue
        other = min(beside, key=lambda p: (len(members[p]), p))
        for t in own:
            patch[t] = other
        members[other] += own
        members[number] = []
