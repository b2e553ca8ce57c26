# SPDX-License-Identifier: MIT
"""Rotations of nodes by shape matching, for the warp of bodies whose elements have none of their own.

The rotation of node i is the one nearest to::

    A_i = sum_j m_j (x_j - x_c) (X_j - X_c)^T

over i and its neighbours j, X at rest and x now, X_c and x_c their centres of mass (Müller, Heidelberger, Teschner and
Gross, Meshless Deformations Based on Shape Matching, 2005; Courtecuisse et al. 2010, section 6). Neighbours of level 1
share an element with i, those of level 2 one with a neighbour of level 1.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.errors import InputError
from sim_server.mechanics.removal import masses_left, present_nodes, whole_masses
from sim_server.mechanics.splitting import Splitting
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene


class ShapeMatching:
    """Shape matching of some bodies.

    start (nodes + 1,), neighbour (k,): neighbours of each node, none at nodes of other bodies
    arm (k, 3): m_j (X_j - X_c), scaled so that the trace of A_i at rest is 1
    Where bodies may be split, all three follow the scene.
    """

    def __init__(self, world: World, bodies: Sequence[Body], level: int):
        self.world, self._bodies, self._level = world, bodies, level
        splitting = world.splitting
        if splitting is None or not any(body.index in splitting.splitters for body in bodies):
            self.start, self.neighbour, self.arm = world.at_start(self._of)
            return
        most = self._room(splitting)
        self._last: tuple[list[str], tuple[Int32, Int32]] | None = None  # by the faces that are open
        self._last_arm: tuple[list[str], Float64] | None = None  # by these and the elements that were removed
        self.start, self.neighbour, self.arm = (
            world.follow("cutting", compute=partial(self._followed, part, most)) for part in range(3)
        )

    def _of(self, scene: Scene) -> tuple[Int32, Int32, Float64]:
        """Returns start, neighbour and arm by the parameters of a scene."""
        start, neighbour = self._neighbours(scene)
        return start, neighbour, self._arm(scene, start, neighbour)

    def _neighbours(self, scene: Scene) -> tuple[Int32, Int32]:
        splitting = self.world.splitting
        tets = [body.tets if splitting is None else splitting.tets(scene, body) for body in self._bodies]
        return neighbours(np.concatenate(tets), self.world.nodes, self._level)

    def _arm(self, scene: Scene, start: Int32, neighbour: Int32) -> Float64:
        w, mass, rest = self.world, self.world.uncut_mass, self.world.rest
        if w.splitting is not None:
            root = w.splitting.nodes(scene, "root")
            mass, rest = masses_left(present_nodes(scene, w), whole_masses(scene, w, mass)), rest[root]
        return _arms(rest, mass, start, neighbour)

    def _followed(self, part: int, most: int, scene: Scene) -> NDArray[Any]:
        """Returns one of these three arrays with room for `most` neighbours.

        Neighbours are found again where other faces are open, but not where elements were removed, which arms tell.
        """
        opened, removed = self._texts(scene, "opened"), self._texts(scene, "removed")
        if self._last is None or self._last[0] != opened:
            self._last = opened, self._neighbours(scene)
        start, neighbour = self._last[1]
        if part == 0:
            return start.copy()
        if len(neighbour) > most:
            raise InputError(f"the frames of nodes need room for {len(neighbour)} neighbours, {most} is what there is")
        if part == 1:
            return np.concatenate([neighbour, np.zeros(most - len(neighbour), neighbour.dtype)])
        if self._last_arm is None or self._last_arm[0] != [*opened, *removed]:
            self._last_arm = [*opened, *removed], self._arm(scene, start, neighbour)
        return np.concatenate([self._last_arm[1], np.zeros((most - len(neighbour), 3))])

    def _texts(self, scene: Scene, key: str) -> list[str]:
        """Returns what a parameter of cutting says of each body, nothing of those that are not cut."""
        return [getattr(scene.objects[b.index].effects.get("cutting"), key, "") for b in self._bodies]

    def _room(self, splitting: Splitting) -> int:
        """Returns how many neighbours there is room for: those in the whole meshes, and for each spare node twice as
        many as nodes there at most have, its own and itself as that of others."""
        room = 0
        for body in self._bodies:
            splitter = splitting.splitters.get(body.index)
            start, _ = neighbours(body.mesh.tets, len(body.mesh.rest), self._level)
            room += int(start[-1]) + (2 * splitter.spares * int(np.diff(start).max()) if splitter else 0)
        return room

    def launch(self, mean: Float64) -> Launch:
        """Launch that writes A_i in place of the sum of rotations `mean` (n, 10) at the bodies' nodes."""
        return self.world.backend.module("kernels/shape_matching.cu").bind(
            "match", self.world.nodes, start=self.start, neighbour=self.neighbour, arm=self.arm, x=self.world.x,
            mean=mean,
        )  # fmt: skip


def neighbours(tets: Int32, nodes: int, level: int) -> tuple[Int32, Int32]:
    """Returns start (nodes + 1,) and the neighbours of each node up to `level`, ascending, without the node itself."""
    from scipy.sparse import coo_array

    one = np.ones(tets.size, bool)
    element = np.repeat(np.arange(len(tets)), 4)
    touching: Any = coo_array((one, (tets.ravel(), element)), shape=(nodes, len(tets))).tocsr()
    beside = touching @ touching.T
    reached = beside
    for _ in range(level - 1):
        reached = reached @ beside
    reached.sort_indices()
    row = np.repeat(np.arange(nodes), np.diff(reached.indptr))
    others = reached.indices != row
    start = np.concatenate([[0], np.cumsum(np.bincount(row[others], minlength=nodes))])
    return start.astype(np.int32), reached.indices[others].astype(np.int32)


def _arms(rest: Float64, mass: Float64, start: Int32, neighbour: Int32) -> Float64:
    """Returns the scaled arms (k, 3) of ShapeMatching."""
    n = len(rest)
    node = np.repeat(np.arange(n), np.diff(start))
    offset = rest[neighbour] - rest[node]  # relative to the node: no cancellation far from the origin
    weight = mass[neighbour]
    total = mass + np.bincount(node, weights=weight, minlength=n)
    centre = np.stack([np.bincount(node, weights=weight * o, minlength=n) for o in offset.T], axis=1) / total[:, None]
    arm = weight[:, None] * (offset - centre[node])
    trace = np.bincount(node, weights=(arm * offset).sum(axis=1), minlength=n)
    return np.ascontiguousarray(arm / trace[node][:, None])
