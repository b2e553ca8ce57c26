# SPDX-License-Identifier: MIT
"""Surfaces of the bodies that list an effect, for forces on their triangles."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sim_server.arrays import Float64, Int32
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.mesh.surface import surface_triangles
from sim_server.scene import Scene, where


class Surfaces:
    """Triangles of the surfaces of bodies, and what each node has of them.

    The parameters of each body may have `where`, which chooses its triangles; without it they are those that `outside`
    returns. Raises InputError where there are none.

    corners (t, 3): nodes of the scene, outward by the right-hand rule. start (n + 1,), slot (start[n],): entries
    3 t + a of each node that is corner a of triangle t
    """

    def __init__(self, world: World, effect: str, listed: Sequence[tuple[Body, Any]]):
        self._effect, self._bodies = effect, [body for body, _ in listed]
        parts = [_chosen(effect, body, params.where) for body, params in listed]
        self._counts = [len(part) for part in parts]
        self.corners: Int32 = np.concatenate(parts)
        self.slot = np.argsort(self.corners.ravel(), kind="stable").astype(np.int32)
        counts = np.bincount(self.corners.ravel(), minlength=world.nodes)
        self.start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        world.backend.keep(self.corners, self.slot, self.start)

    def of_triangles(self, rows: Callable[[Any], Sequence[float]]) -> Callable[[Scene], Float64]:
        """Returns the function of a scene that gives rows(parameters of the body) of each triangle, (t, k)."""

        def compute(scene: Scene) -> Float64:
            given = [rows(scene.objects[body.index].effects[self._effect]) for body in self._bodies]
            return np.repeat(np.array(given, np.float64), self._counts, axis=0)

        return compute


def _chosen(effect: str, body: Body, chosen: str | None) -> Int32:
    triangles = surface_triangles(body.mesh.tets)
    if chosen is None:
        return outside(body.mesh.rest, triangles) + np.int32(body.first)
    inside = where.nodes(chosen, body.mesh)[triangles].all(axis=1)
    if not inside.any():
        raise InputError(
            f"object {body.name!r}: {effect} where = {chosen!r} holds all nodes of 0 of {len(triangles)} triangles of "
            "the surface; it must hold those of one or more"
        )
    return triangles[inside] + np.int32(body.first)


def outside(rest: Float64, triangles: Int32) -> Int32:
    """Returns the triangles of a surface without the walls of closed cavities, which enclose a negative volume."""
    pairs = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(rest), len(rest)))
    part = connected_components(graph, directed=False)[1][triangles[:, 0]]
    volume = np.bincount(part, weights=np.linalg.det(rest[triangles] - rest.mean(axis=0)))
    return triangles[volume[part] > 0]
