# SPDX-License-Identifier: MIT
"""The linear system of a step: arrays of A' and b', their pattern, and the launches that begin and finish them.

A is block CSR with 3x3 blocks over all nodes of the scene, both triangles, columns ascending; bodies do not couple, so
a body's blocks are one range of it. Rows of fixed nodes hold their diagonal block alone (the identity). Effects add to
    b (n, 3) [N s], diagonal (n,) [kg], block (n, 6) [kg]: upper triangle of the nodes' own blocks,
    sums (blocks above the diagonal, 3, 3) [kg], mean (n, 10): sums of q q^T over the quaternions q of the rotations,
all in the world frame; kernels/nodes.cu (`rotate`) and kernels/rotate_blocks.cu then take b and A into the material
frame, where the solve happens.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sim_server.arrays import Float64, Int32, Int64
from sim_server.backends.base import Launch
from sim_server.mechanics import clusters
from sim_server.mechanics.clusters import Couplings, PatchedCells, PatchedTetrahedra
from sim_server.mechanics.guess import Guess
from sim_server.mechanics.split_pattern import FollowedPattern, Numbering
from sim_server.mechanics.world import World


@dataclass(frozen=True)
class Stencil:
    """Places of the elements of an effect in the system.

    An element has c corners, 2 (a spring), 4 (a tetrahedron), or as many as it couples.
    corner_start (nodes + 1,), corners: slots c e + a of the elements at each node.
    pair_start (blocks above the diagonal + 1,), pairs (k,): c^2 e + c a + b, the corners of e that couple in a block.

    Of strain cells with any number of nodes (clusters.py) corners are their slots, pairs (k, 2) the slots that couple;
    corner_owners, pair_owners: the cell of each; patches: the same of their patches; dilating: of cells that have a
    dilatation alone, None if there are none. Of tetrahedra in patches corners and pairs are those of elements.
    """

    corner_start: Int32
    corners: Int32
    pair_start: Int32
    pairs: Int32
    corner_owners: Int32 | None = None
    pair_owners: Int32 | None = None
    patches: "Stencil | None" = None
    dilating: "Stencil | None" = None


Coupled = Int32 | PatchedCells | PatchedTetrahedra


class System:
    """Pattern and arrays of A' and b' for a world and the elements of its effects.

    elements: per effect, (m, c) node numbers of the elements that couple their corners, or strain cells or tetrahedra
        and their patches.

    moving (bodies,): 1 if a node of the body does not rest, so that the step is solved; set by `rotate`
        (kernels/nodes.cu) and cleared by the loop
    row, column: nodes of the blocks above the diagonal
    sums (blocks, 3, 3): these, world frame, and after them those that couple nodes of holders to free ones, which are
        not in A; held_columns (blocks,): their free nodes
    extent (n,): diagonal of the box around the node's body at rest [m]
    rotation (n, 3, 3): frames of the nodes
    guess: of dv, from which a solve starts; None: it starts from the last one; set before the launches are made
    warped (bodies,): 1 where frames follow the nodes' rotations, 0 where they stay the identity; set before the
        launches are made
    """

    def __init__(self, world: World, elements: Sequence[Coupled]):
        n = world.nodes
        self.world = world
        places = [places_of(e, world, world.free) for e in elements]
        keys = np.unique(np.concatenate([np.zeros(0, np.int64), *(each for place in places for each in place.keys)]))
        rows, columns = (part.astype(np.int32) for part in np.divmod(keys, n))
        above = rows < n
        self.row, self.column = rows[above], columns[above]
        self.held_rows, self.held_columns = rows - np.int32(n), columns
        self.stencils = [place.stencil(n, keys) for place in places]
        self.followed: FollowedPattern | None = None
        if world.splitting is None:
            self._take(vars(Numbering.of(self.row, self.column, n)))
            blocks, most = len(keys), len(self.columns)
        else:  # which has no holders beside it
            self.followed = FollowedPattern(world, elements, self.row)
            self._most = _most_above(world, elements, self.row, self.column, self.followed.blocks)
            arrays, self.stencils = self.followed.follow()
            self._take(arrays)
            blocks, most = self.followed.blocks, self.followed.places + 1

        self.sums = np.zeros((blocks, 3, 3))
        self.values = np.zeros((most, 3, 3))
        self.diagonal = np.zeros(n)
        self.block = np.zeros((n, 6))
        self.b = np.zeros((n, 3))
        self.mean = np.zeros((n, 10))
        self.body = np.repeat([b.index for b in world.bodies], [b.last - b.first for b in world.bodies]).astype(
            np.int32
        )
        self.warped = np.ones(len(world.bodies), np.int32)
        self.moving = np.zeros(len(world.bodies), np.int32)
        extents = np.array([np.linalg.norm(np.ptp(world.rest[b.nodes], axis=0)) for b in world.bodies])
        self.extent = extents[self.body]
        self._inverse_times: dict[float, Float64] = {}  # by world.dx_dv
        self.rotation = np.tile(np.eye(3), (n, 1, 1))
        self.b_material, self.last_b = np.zeros((n, 3)), np.zeros((n, 3))
        self.y = np.zeros((n, 3))
        self.dv = np.zeros((n, 3))
        self.guess: Guess | None = None
        self.clock = np.zeros(1)
        world.backend.keep(self.clock, exact=True)
        world.backend.keep(*(a for o in (world, self) for a in vars(o).values() if isinstance(a, np.ndarray)))

    @property
    def inverse_time(self) -> Float64:
        """1 / (dx_dv + beta) at each node, (n,) [1/s]."""
        w = self.world
        if w.dx_dv not in self._inverse_times:
            self._inverse_times[w.dx_dv] = w.inverse_time(self.body)
        return self._inverse_times[w.dx_dv]

    def held_couplings(self, node: Int32) -> tuple[Int32, Int32]:
        """Returns where in `sums` the blocks of held nodes begin and end, (len(node),) each."""
        first, last = (np.searchsorted(self.held_rows, node, side) for side in ("left", "right"))
        return first.astype(np.int32), last.astype(np.int32)

    def _take(self, numbering: Mapping[str, Int32]) -> None:
        """Keeps the places in block CSR of the blocks above, below and on the diagonal."""
        self.row, self.column = numbering["row"], numbering["column"]
        self.row_start, self.own = numbering["row_start"], numbering["own"]
        self.upper, self.lower, self.columns = numbering["upper"], numbering["lower"], numbering["columns"]

    def start(self, mass: Float64) -> Launch:
        """Sets b = 0 and the diagonal to mass (n,) [kg]."""
        return self.world.backend.module("kernels/nodes.cu").bind(
            "start", self.world.nodes, mass=mass, diagonal=self.diagonal, b=self.b, block=self.block,
            mean=self.mean,
        )  # fmt: skip

    def finish(self, matrix: bool = True, guessed: bool = True) -> list[Launch]:
        """Takes the system into the material frame, A' = R^T A R and b' = R^T b, and sets the start of the solve.

        matrix: A', too. Rollers (mechanics/rollers.py) come first. guessed: the solve starts from the guess, which is
        of a whole step; else from the last dv.
        """
        w = self.world
        start = self.guess.next if self.guess and guessed else self.dv
        velocity = w.v if w.inertia else w.predictor  # without inertia v is only the last displacement over dt
        rotate = self.world.backend.module("kernels/nodes.cu").bind(
            "rotate", w.nodes, free=w.free, body=self.body, warped=self.warped, place=self.own,
            mean=self.mean, b=self.b, diagonal=self.diagonal, block=self.block, dv=self.dv,
            guess=start, x=w.x, v=velocity, extent=self.extent, inverse_time=self.inverse_time, h=w.dt,
            whole=int(matrix), moving=self.moving, rotation=self.rotation, b_material=self.b_material,
            last_b=self.last_b, y=self.y, values=self.values,
        )  # fmt: skip
        kept = self.keep_directions(frames=True)
        if not matrix:
            return [*kept, rotate]
        rotate_blocks = self.world.backend.module("kernels/rotate_blocks.cu").bind(
            "rotate_blocks", len(self.row), row=self.row, column=self.column, upper=self.upper, lower=self.lower,
            sums=self.sums, rotation=self.rotation, values=self.values,
        )  # fmt: skip
        if w.rollers is not None:
            own, others = w.rollers.keep_matrix(self.block, self.sums, self.row, self.column)
            return [*kept, own, rotate, others, rotate_blocks]
        return [rotate, rotate_blocks]

    def keep_directions(self, frames: bool) -> list[Launch]:
        """Takes b to the directions in which nodes may move; nothing in a scene without rollers. frames: these, too."""
        rollers = self.world.rollers
        if rollers is None:
            return []
        return [rollers.keep_force(self.b), *([rollers.keep_frame(self.mean)] if frames else [])]

    def advance(self, before: Float64) -> Launch:
        """Advances by backward Euler: v += R y, x += dx_dv v. before (n, 3): gets x at the start of the step [m]."""
        w = self.world
        return self.world.backend.module("kernels/nodes.cu").bind(
            "advance", w.nodes, rotation=self.rotation, y=self.y, h=w.dx_dv, dv=self.dv, v=w.v, x=w.x, before=before,
        )  # fmt: skip

    def couples(self, first: int, last: int) -> bool:
        """True if any two nodes of a body are coupled."""
        return bool(self.row_start[last] - self.row_start[first] > last - first)

    def body_pattern(self, first: int, last: int) -> tuple[Int32, Int32]:
        """Returns row_start and columns of one body, numbered from 0."""
        start = self.row_start[first : last + 1]
        return (start - start[0]).astype(np.int32), (self.columns[start[0] : start[-1]] - first).astype(np.int32)

    def most_blocks(self, first: int, last: int) -> int:
        """Returns the blocks that a body has at most, however it is split."""
        if self.followed is None:
            return int(self.row_start[last] - self.row_start[first])
        return last - first + 2 * self._most[first]

    def body_values(self, first: int, last: int) -> Float64:
        """Returns a view of the blocks of one body, (blocks, 3, 3)."""
        return self.values[self.row_start[first] : self.row_start[last]]


def _most_above(world: World, elements: Sequence[Coupled], row: Int32, column: Int32, room: int) -> dict[int, int]:
    """Returns how many blocks above the diagonal each body can have, by its first node.

    row, column: of the blocks at the start; room: for those of all bodies. Bodies that are not split keep theirs.
    Others have at most what is left if the others are whole, and no more than their elements couple.
    """
    n, splitting = world.nodes, world.splitting
    assert splitting is not None
    root = world.at_start(lambda scene: splitting.nodes(scene, "root"))
    ends = np.sort([root[row], root[column]], axis=0).astype(np.int64)
    whole = np.unique(ends[0] * n + ends[1]) // n  # rows of the blocks if no body is split
    most = {body.first: int(((body.first <= whole) & (whole < body.last)).sum()) for body in world.bodies}
    for index in splitting.splitters:
        body = world.bodies[index]
        coupled = 0
        for each in elements:
            if not isinstance(each, np.ndarray):  # patches couple what no list of elements tells
                coupled += room
            elif each.size:
                own = (body.first <= each[:, 0]) & (each[:, 0] < body.last)
                coupled += int(own.sum()) * (each.shape[1] * (each.shape[1] - 1) // 2)
        most[body.first] = min(most[body.first] + room - len(whole), coupled)
    return most


def _couplings(elements: Int32, world: World, n: int, free: Float64) -> tuple[Int64, Int32]:
    """Keys row * n + column and pairs c c e + c a + b of all couplings above the diagonal between free corners.

    Those of a held row and a free column have the key (row + n) * n + column, so they come last.
    """
    keys, pairs = [], []
    held = world.held
    corners = elements.shape[1]
    element = corners**2 * np.arange(len(elements), dtype=np.int32)
    for a in range(corners):
        for b in range(corners):
            i, j = elements[:, a], elements[:, b]
            here = (i < j) & (free[i] > 0) & (free[j] > 0)
            keys.append(i[here].astype(np.int64) * n + j[here])
            pairs.append((element + np.int32(corners * a + b))[here])
            if held.any():
                here = (held[i] > 0) & (free[j] > 0)
                keys.append((i[here].astype(np.int64) + n) * n + j[here])
                pairs.append((element + np.int32(corners * a + b))[here])
    return np.concatenate(keys), np.concatenate(pairs)


@dataclass(frozen=True)
class Places:
    """What an effect couples.

    keys: of its blocks, row * nodes + column; stencil: makes its places from the number of nodes and the keys of all
    """

    keys: list[Int64]
    stencil: Callable[[int, Int64], Stencil]


def places_of(coupled: Coupled, world: World, free: Float64) -> Places:
    """Returns what elements couple. free (nodes,): not 0 at nodes that may move"""
    if isinstance(coupled, PatchedCells):
        found = [clusters.couplings(c, world, free) for c in (coupled.cells, coupled.patches, coupled.dilating)]
        return Places([keys for keys, *_ in found], partial(_patched_stencil, coupled, found))
    if isinstance(coupled, PatchedTetrahedra):
        pairs = _couplings(coupled.elements, world, world.nodes, free)
        of_patches = clusters.couplings(coupled.patches, world, free)
        return Places([pairs[0], of_patches[0]], partial(_stencil_of_tetrahedra, coupled, pairs, of_patches))
    pairs = _couplings(coupled, world, world.nodes, free)
    return Places([pairs[0]], partial(_stencil, coupled, pairs))


def _patched_stencil(elements: PatchedCells, found: list[Couplings], n: int, blocks: Int64) -> Stencil:
    groups = elements.cells, elements.patches, elements.dilating
    cells, patches, dilating = (clusters.places(g, f, n, blocks) for g, f in zip(groups, found, strict=True))
    alone = Stencil(*dilating) if len(elements.dilating.nodes) else None
    return Stencil(*cells, Stencil(*patches), alone)


def _stencil_of_tetrahedra(
    coupled: PatchedTetrahedra, pairs: tuple[Int64, Int32], of_patches: Couplings, n: int, blocks: Int64
) -> Stencil:
    patches = Stencil(*clusters.places(coupled.patches, of_patches, n, blocks))
    return replace(_stencil(coupled.elements, pairs, n, blocks), patches=patches)


def _stencil(elements: Int32, couplings: tuple[Int64, Int32], n: int, blocks: Int64) -> Stencil:
    corners = np.argsort(elements.ravel(), kind="stable").astype(np.int32)
    corner_start = np.concatenate([[0], np.cumsum(np.bincount(elements.ravel(), minlength=n))]).astype(np.int32)
    keys, pairs = couplings
    order = np.lexsort((pairs, keys))
    pair_start = np.searchsorted(keys[order], np.append(blocks, 2 * np.int64(n) * n)).astype(np.int32)
    return Stencil(corner_start, corners, pair_start, pairs[order])
