# SPDX-License-Identifier: MIT
"""Bounding box and named points of an object while it moves.

tip: the free node farthest from the fixed ones (from the middle of the object if nothing is fixed) in the shape at
rest, so that it is the same node throughout. right, left, top, bottom, front, back: the free node that is now farthest
along +x, -x, +y, -y, +z, -z.

In scenes with bodies that may be split, box and tip leave out nodes without elements: spare nodes that wait, and those
that lost all of theirs.
"""

from collections.abc import Sequence
from functools import cached_property
from math import hypot

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.mechanics.world import Body, World

SIDES = {"right": (0, 1), "left": (0, -1), "top": (1, 1), "bottom": (1, -1), "front": (2, 1), "back": (2, -1)}
NAMES = ("tip", *SIDES)

Point = tuple[float, float, float]


class NamedPoints:
    """Named points and bounding box of one body, from its positions at the last call of `now`."""

    def __init__(self, world: World, body: Body):
        self.body = body
        self._world = world
        self._x: Float64 = np.zeros((0, 3))
        self._boxed: slice | NDArray[np.bool_] = slice(None)  # nodes in the box
        self._moves = (world.free[body.nodes] > 0) | self._without_elements()
        self.size = float(np.linalg.norm(np.ptp(body.mesh.rest, axis=0)))  # m, diagonal of the box at rest

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of its nodes move now, (nodes,)."""
        w = self._world
        live = w.splitting is not None  # copies move if what they are copies of does
        moves = w.backend.fetch(w.free)[self.body.nodes] > 0 if live else self._moves
        return moves & ~self._without_elements()

    def now(self, x: Float64 | None = None) -> Float64:
        """Copies and returns positions of its nodes [m], (nodes, 3). x: of all nodes of the scene; None: fetch them."""
        if self._world.splitting is not None:
            self._boxed = self._with_elements()  # before the positions, which a copy gets before it has elements
        fetched = self._world.backend.fetch(self._world.x) if x is None else x
        self._x = fetched[self.body.nodes].copy()
        return self._x

    def _without_elements(self) -> NDArray[np.bool_]:
        """Returns which of its nodes rest since all their elements were removed."""
        w, nodes = self._world, self.body.nodes
        if w.without_elements is None:
            return np.zeros(self.body.last - self.body.first, bool)
        return np.asarray(w.backend.fetch(w.without_elements)[nodes] > 0)

    def _with_elements(self) -> NDArray[np.bool_]:
        """Returns which of its nodes have elements; all in scenes without splitting, and if none has any."""
        without = self._without_elements()
        return np.ones_like(without) if self._world.splitting is None or without.all() else ~without

    def box(self) -> tuple[Point, Point]:
        """Returns the lowest and highest coordinates [m]."""
        x = self._x[self._boxed]
        low, high = [c.min() for c in x.T], [c.max() for c in x.T]  # over rows at once takes many times as long
        return _point(np.array(low)), _point(np.array(high))

    def where(self) -> str:
        """Returns the box in words."""
        low, high = self.box()
        spans = ", ".join(f"{c} from {a:.4g} to {b:.4g}" for c, a, b in zip("xyz", low, high, strict=True))
        return f"{self.body.name!r} now fills {spans} m"

    def distance(self, point: Point) -> float:
        """Returns the distance of a point from the box [m]; 0 within."""
        low, high = self.box()
        return hypot(*(max(a - p, p - b, 0.0) for a, p, b in zip(low, point, high, strict=True)))

    def named(self, name: str) -> Point:
        """Fetches positions and returns a named point [m]. Raises ValueError."""
        if name not in NAMES:
            raise ValueError(f"no point {name[:80]!r}; known: {', '.join(NAMES)}, or give coordinates")
        if name == "tip":
            tip = self.tip_node  # to find it takes time once, in which the body moves on
            return _point(self.now()[tip])
        x = self.now()
        axis, sign = SIDES[name]
        return _point(x[int(np.where(self.free, sign * x[:, axis], -np.inf).argmax())])

    def tip(self) -> Point:
        """Returns the position of the tip [m]."""
        return _point(self._x[self.tip_node])

    @cached_property
    def tip_node(self) -> int:
        """The number of the tip among the nodes of the body; no copy, whose place at rest is that of another node."""
        n = self._nodes_of_mesh
        rest, free, there = self.body.mesh.rest[:n], self.free[:n], self._with_elements()[:n]
        fixed = there & ~free
        if fixed.any():
            from scipy.spatial import cKDTree

            distance, _ = cKDTree(rest[fixed]).query(rest)
        else:
            distance = np.linalg.norm(rest - rest[there].mean(axis=0), axis=1)
        return int(np.where(free, distance, -np.inf).argmax())

    @property
    def _nodes_of_mesh(self) -> int:
        """Number of its nodes without spare ones, which are behind them."""
        splitting, index = self._world.splitting, self.body.index
        if splitting is None or index not in splitting.splitters:
            return self.body.last - self.body.first
        return splitting.splitters[index].nodes


def shown(point: Sequence[float] | Float64) -> str:
    """Formats coordinates with four digits."""
    return "(" + ", ".join(f"{float(c):.4g}" for c in point) + ")"


def _point(values: Float64) -> Point:
    x, y, z = values.tolist()
    return x, y, z
