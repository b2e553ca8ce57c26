# SPDX-License-Identifier: MIT
"""Check that every part of a scene without inertia is held: a part that is not makes the matrix singular."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World

FLAT = 1e-9  # width over length below which points count as collinear


def check_held(world: World, elements: list[Int32]) -> None:
    """Raises InputError naming the object if nodes of it could move without resistance.

    elements: per effect, (m, c) node numbers. Tetrahedra connected by faces form a piece; it is held by three nodes
    that are not collinear and are fixed or belong to pieces that are held, or where these and rollers together leave
    it no rigid motion. Nodes connected by springs form a piece, too, so a mechanism of springs is not detected.
    """
    for body in world.bodies:
        pieces = [p for e in elements for p in _pieces(e[(e[:, 0] >= body.first) & (e[:, 0] < body.last)])]
        loose = _loose(world, body, pieces)
        if len(loose):
            fixed = int((world.free[body.nodes] == 0).sum())
            raise InputError(
                f"object {body.name!r}: integrator.scheme = 'quasi_static' needs every part held; its {fixed} fixed "
                f"nodes leave {len(loose)} of {body.last - body.first} nodes loose, first {int(loose[0]) - body.first} "
                "(needed: an elastic effect, and the effect fixed on three or more nodes that are not on one line, or "
                "rollers that leave no rigid motion)"
            )


def _loose(world: World, body: Body, pieces: list[Int32]) -> Int64:
    """Returns the nodes of the body that are not held, in numbers of the scene, ascending."""
    held = world.free == 0
    left = pieces
    while found := [p for p in left if _hold(world.rest[p[held[p]]]) or _rolls_nowhere(world, p, held)]:
        for p in found:
            held[p] = True
        left = [p for p in left if not held[p].all()]
    return body.first + np.flatnonzero(~held[body.nodes])


def _hold(points: Float64) -> bool:
    """True if three of the points are not collinear."""
    if len(points) < 3:
        return False
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[1] > FLAT * sizes[0])


def _rolls_nowhere(world: World, piece: Int32, held: NDArray[np.bool_]) -> bool:
    """True if fixed nodes and rollers of a piece leave it none of the six rigid motions, linearized at the start."""
    if world.rollers is None or not world.rollers.limited[piece].any():
        return False
    x = world.x[piece]
    arms = (x - x.mean(axis=0)) / max(float(np.ptp(x, axis=0).max()), 1e-300)
    none = np.zeros((0, 3))
    kept = [np.eye(3) if held[i] else world.rollers.directions.get(int(i), none) for i in piece]
    rows = [np.hstack([n, np.cross(arm, n)]) for n, arm in zip(kept, arms, strict=True) if len(n)]
    sizes = np.linalg.svd(np.concatenate(rows), compute_uv=False)
    return bool(len(sizes) == 6 and sizes[5] > FLAT * sizes[0])


def _pieces(elements: Int32) -> list[Int32]:
    """Returns the nodes of each set of elements connected by faces (four corners) or nodes (two corners)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    m, c = elements.shape
    if m == 0:
        return []
    shared = [elements[:, list(s)] for s in combinations(range(c), c - 1)]
    keys = np.sort(np.concatenate(shared), axis=1)
    _, number = np.unique(keys, axis=0, return_inverse=True)
    edges = (np.tile(np.arange(m), c), m + number.ravel())
    graph = coo_array((np.ones(len(edges[0]), np.int8), edges), shape=(m + number.max() + 1,) * 2)
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label[:m], kind="stable")
    split = np.flatnonzero(np.diff(label[:m][order])) + 1
    return [np.unique(elements[part]) for part in np.split(order, split)]
