# SPDX-License-Identifier: MIT
"""Topology and State messages as checked arrays, safe to index with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.refused import Refused
from protocol.validate import array, check_range

SUM_ERROR = 1e-6  # of the weights of a vertex of a skin
MOST_WEIGHT = 4.0  # magnitude of such a weight, as servers bound it


@dataclass(frozen=True)
class Skin:
    """A finer surface that moves with a mesh: vertex k is the sum over c of weights[k, c] x[nodes[k, c]]."""

    nodes: NDArray[np.int32]  # (s, 4) of the mesh
    weights: NDArray[np.float64]  # (s, 4), sums 1
    triangles: NDArray[np.int32]  # (t, 3) of vertices

    def positions(self, x: NDArray) -> NDArray[np.float64]:
        """Returns the positions (s, 3) [m] of the vertices, x (n, 3): of all nodes; velocities from velocities."""
        return self.values(x)

    def values(self, nodal: NDArray) -> NDArray[np.float64]:
        """Returns what nodes have (n, ...) at the vertices, (s, ...)."""
        found: NDArray[np.float64] = np.einsum("sc,sc...->s...", self.weights, nodal[self.nodes])
        return found


@dataclass(frozen=True)
class Mesh:
    """An object from one change of its mesh to the next: a topology epoch, or a part of it without what was cut.

    epoch: grows with each change; tets, young and poisson are of the elements that are there
    """

    object: str
    epoch: int
    rest: NDArray[np.float64]  # (n, 3) posed rest positions [m]
    tets: NDArray[np.int32]  # (m, 4)
    triangles: NDArray[np.int32]  # (t, 3) outer surface
    fixed: NDArray[np.int32]  # (k,)
    young: NDArray[np.float32]  # (m,) [Pa]; empty = not elastic
    poisson: NDArray[np.float32]  # (m,)
    skin: Skin | None = None
    uncut: Mesh | None = None  # without any cut; None: this one


@dataclass(frozen=True)
class Frame:
    """Positions and velocities of an object after a step."""

    object: str
    epoch: int
    step: int
    time: float  # s
    x: NDArray[np.float64]  # (n, 3) [m]
    v: NDArray[np.float64]  # (n, 3) [m/s]


def mesh_of(message: pb.Topology, before: Mesh | None = None) -> Mesh:
    """Checks a topology and returns its arrays. Raises Refused.

    before: any mesh of the object in this epoch, which has what a topology of a log leaves out after a cut
    """
    name = f"Topology of {message.header.object!r}"
    if message.nodes == 0:
        raise Refused(f"{name}: nodes is 0; allowed: at least 1", "shape")
    if not message.cut:
        return _whole(message, name)
    uncut = (before.uncut or before) if before is not None and not message.tets else _whole(message, name)
    return _cut(uncut, message, name)


def _cut(uncut: Mesh, message: pb.Topology, name: str) -> Mesh:
    """Returns a mesh without the elements that were removed, and with the surface that is left."""
    removed = array(message.removed, np.int32, (-1,), f"{name}: removed")
    triangles = array(message.triangles, np.int32, (-1, 3), f"{name}: triangles")
    if message.nodes != len(uncut.rest):
        raise Refused(
            f"{name}: nodes is {message.nodes}; allowed: {len(uncut.rest)}, of the mesh that was cut", "shape"
        )
    check_range(removed, 0, len(uncut.tets), f"{name}: removed")
    check_range(triangles, 0, len(uncut.rest), f"{name}: triangles")
    there = np.ones(len(uncut.tets), bool)
    there[removed] = False
    skin = uncut.skin
    if skin is not None:
        corners = array(message.skin_triangles, np.int32, (-1, 3), f"{name}: skin_triangles")
        check_range(corners, 0, len(skin.nodes), f"{name}: skin_triangles")
        skin = _with_faces(replace(skin, triangles=corners), _bare(uncut.tets[removed], triangles))
    return replace(
        uncut, epoch=message.header.epoch + message.cut, tets=uncut.tets[there], triangles=triangles, skin=skin,
        uncut=uncut, young=uncut.young[there[: len(uncut.young)]], poisson=uncut.poisson[there[: len(uncut.poisson)]],
    )  # fmt: skip


def _bare(removed: NDArray[np.int32], triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Returns the triangles of a surface that were faces of removed elements (r, 4) as well, (t, 3)."""
    faces = removed[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    _, number = np.unique(np.sort(np.concatenate([faces, triangles]), axis=1), axis=0, return_inverse=True)
    number = number.reshape(-1)
    return triangles[np.isin(number[len(faces) :], number[: len(faces)])]


def _with_faces(skin: Skin, faces: NDArray[np.int32]) -> Skin:
    """Returns a skin with faces of elements beside it, which a cut has laid bare; their nodes are further vertices."""
    nodes, corner = np.unique(faces, return_inverse=True)
    weights = np.tile([1.0, 0, 0, 0], (len(nodes), 1))
    places = corner.reshape(-1, 3).astype(np.int32) + len(skin.nodes)
    return Skin(
        np.concatenate([skin.nodes, np.repeat(nodes[:, None], 4, axis=1).astype(np.int32)]),
        np.concatenate([skin.weights, weights]), np.concatenate([skin.triangles, places]),
    )  # fmt: skip


def _whole(message: pb.Topology, name: str) -> Mesh:
    n = message.nodes
    tets = array(message.tets, np.int32, (-1, 4), f"{name}: tets")
    triangles = array(message.triangles, np.int32, (-1, 3), f"{name}: triangles")
    fixed = array(message.fixed, np.int32, (-1,), f"{name}: fixed")
    for values, what in ((tets, "tets"), (triangles, "triangles"), (fixed, "fixed")):
        check_range(values, 0, n, f"{name}: {what}")
    return Mesh(
        object=message.header.object,
        epoch=message.header.epoch,
        rest=array(message.rest, np.float64, (n, 3), f"{name}: rest", finite=True),
        tets=tets,
        triangles=triangles,
        fixed=fixed,
        young=_per_tet(message.young, len(tets), f"{name}: young"),
        poisson=_per_tet(message.poisson, len(tets), f"{name}: poisson"),
        skin=_skin_of(message, name),
    )


def _skin_of(message: pb.Topology, name: str) -> Skin | None:
    if not message.skin_nodes and not message.skin_weights and not message.skin_triangles:
        return None
    nodes = array(message.skin_nodes, np.int32, (-1, 4), f"{name}: skin_nodes")
    weights = array(message.skin_weights, np.float64, (len(nodes), 4), f"{name}: skin_weights", finite=True)
    triangles = array(message.skin_triangles, np.int32, (-1, 3), f"{name}: skin_triangles")
    check_range(nodes, 0, message.nodes, f"{name}: skin_nodes")
    check_range(triangles, 0, len(nodes), f"{name}: skin_triangles")
    if len(weights) and not (error := float(abs(weights.sum(axis=1) - 1).max())) <= SUM_ERROR:
        raise Refused(f"{name}: skin_weights have sums off 1 by {error:.3g}; allowed: {SUM_ERROR:g}", "number")
    if len(weights) and (largest := float(abs(weights).max())) > MOST_WEIGHT + SUM_ERROR:
        raise Refused(f"{name}: skin_weights of magnitude {largest:.3g}; allowed: {MOST_WEIGHT:g}", "number")
    return Skin(nodes, weights, triangles)


def frame_of(message: pb.State) -> Frame:
    """Checks a state and returns its arrays; after a solve that diverged they may hold NaN. Raises Refused."""
    n, name = message.nodes, f"State of {message.header.object!r} at step {message.step}"
    if n == 0:
        raise Refused(f"{name}: nodes is 0; allowed: at least 1", "shape")
    x = array(message.x, np.float64, (n, 3), f"{name}: x")
    v = array(message.v, np.float64, (n, 3), f"{name}: v")
    return Frame(message.header.object, message.header.epoch + message.cut, message.step, message.time, x, v)


def _per_tet(data: bytes, tets: int, what: str) -> NDArray[np.float32]:
    return array(data, np.float32, (tets if data else 0,), what)
