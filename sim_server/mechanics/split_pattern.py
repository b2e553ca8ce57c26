# SPDX-License-Identifier: MIT
"""The pattern of A and the places of elements in it, where bodies may be split while steps run.

All arrays have room for the pattern with every spare node in use, and follow the parameters of the scene. Blocks above
the diagonal that there are not yet sum no elements, and lie in the last place of `values`, beyond all rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64, distinct
from sim_server.errors import InputError
from sim_server.mechanics.splitting import Splitting
from sim_server.mechanics.world import World

if TYPE_CHECKING:
    from sim_server.mechanics.system import Coupled, Stencil
    from sim_server.scene import Scene

NAMES = ("row", "column", "row_start", "own", "upper", "lower", "columns")


@dataclass(frozen=True)
class Numbering:
    """Blocks above the diagonal, row and column (blocks,), and their places in block CSR, as of `System`."""

    row: Int32
    column: Int32
    row_start: Int32
    own: Int32
    upper: Int32
    lower: Int32
    columns: Int32

    @classmethod
    def of(cls, row: Int32, column: Int32, n: int) -> Numbering:
        """Numbers the places of the blocks above, below and on the diagonal. row, column: ascending"""
        below = np.argsort(column, kind="stable")  # row after row of the lower triangle, columns ascending
        lower = np.bincount(column, minlength=n)
        upper = np.bincount(row, minlength=n)
        start = np.concatenate([[0], np.cumsum(lower + 1 + upper)])
        own = (start[:-1] + lower).astype(np.int32)
        places_above = _runs(row, own.astype(np.int64) + 1, upper)
        places_below = np.empty_like(places_above)
        places_below[below] = _runs(column[below], start[:-1], lower)
        columns = np.empty(start[-1], dtype=np.int32)
        columns[own] = np.arange(n, dtype=np.int32)
        columns[places_above], columns[places_below] = column, row
        return cls(row, column, start.astype(np.int32), own, places_above, places_below, columns)

    def padded(self, blocks: int, places: int) -> dict[str, Int32]:
        """Returns the arrays with room for so many blocks above the diagonal, and so many places in block CSR."""
        sizes = {"row": blocks, "column": blocks, "upper": blocks, "lower": blocks, "columns": places}
        rest = {"upper": places, "lower": places}
        return {k: _padded(getattr(self, k), sizes.get(k), rest.get(k, 0)) for k in NAMES}


def _runs(group: Int32, begin: Int64, count: Int64) -> Int32:
    """Assigns consecutive places to the members of each group, from begin[group] on; groups ascend."""
    first = np.cumsum(count) - count
    return (np.arange(len(group)) - first[group] + begin[group]).astype(np.int32)


def _padded(array: NDArray[Any], size: int | None, value: int) -> NDArray[Any]:
    if size is None:
        return array
    return np.concatenate([array, np.full(size - len(array), value, array.dtype)])


class FollowedPattern:
    """The arrays of the pattern and of the stencils by the parameters of a scene.

    blocks: room for blocks above the diagonal; places: the same of block CSR, but for the last one
    """

    def __init__(self, world: World, coupled: Sequence[Coupled], row: Int32):
        assert world.splitting is not None
        self._world, self._coupled, self._splitting = world, coupled, world.splitting
        self._free = world.free.copy()
        self._last: tuple[Scene, dict[str, NDArray[Any]], list[Stencil]] | None = None
        others = np.ones(world.nodes, bool)
        for index in world.splitting.splitters:
            others[world.bodies[index].nodes] = False
        self.blocks = int(others[row].sum()) + _room(world.splitting)
        self.places = world.nodes + 2 * self.blocks

    def follow(self) -> tuple[dict[str, Any], list[Stencil]]:
        """Returns the arrays of `System` by name, and the stencils, all of which follow the scene from now on."""
        start = self._world.at_start(self._of)[1]
        arrays = {k: self._world.follow("cutting", compute=partial(self._array, k)) for k in NAMES}
        stencils = [self._followed(k, stencil, ()) for k, stencil in enumerate(start)]
        self._last = None  # its arrays are those that the loop changes
        return arrays, stencils

    def body_pattern(self, scene: Scene, first: int, last: int) -> tuple[Int32, Int32]:
        """Returns row_start and columns of a body by the parameters of a scene, numbered from 0."""
        arrays = self._of(scene)[0]
        start = arrays["row_start"][first : last + 1]
        return (start - start[0]).astype(np.int32), (arrays["columns"][start[0] : start[-1]] - first).astype(np.int32)

    def _followed(self, number: int, part: Any, path: tuple[str, ...]) -> Any:
        """Returns a stencil, or one in it, whose arrays follow the scene."""
        new: dict[str, Any] = {}
        for field in fields(part):
            value, place = getattr(part, field.name), (*path, field.name)
            if isinstance(value, np.ndarray):
                new[field.name] = self._world.follow("cutting", compute=partial(self._in_stencil, number, place))
            elif value is not None:
                new[field.name] = self._followed(number, value, place)
        return replace(part, **new)

    def _array(self, name: str, scene: Scene) -> NDArray[Any]:
        return self._of(scene)[0][name]

    def _in_stencil(self, number: int, place: tuple[str, ...], scene: Scene) -> NDArray[Any]:
        value: Any = self._of(scene)[1][number]
        for name in place:
            value = getattr(value, name)
        return _padded(value, self.blocks + 1, value[-1]) if place[-1] == "pair_start" else value

    def _of(self, scene: Scene) -> tuple[dict[str, NDArray[Any]], list[Stencil]]:
        last = self._last
        if last is None or last[0] is not scene:
            from sim_server.mechanics.system import places_of

            n, root = self._world.nodes, self._splitting.nodes(scene, "root")
            free = self._free[root]
            places = [places_of(self._splitting.elements(scene, e), self._world, free) for e in self._coupled]
            keys = distinct(np.concatenate([np.zeros(0, np.int64), *(k for place in places for k in place.keys)]))
            row, column = (part.astype(np.int32) for part in np.divmod(keys, n))
            if len(row) > self.blocks:
                raise InputError(
                    f"effect cutting: A would have {len(row)} blocks above the diagonal, there is room for "
                    f"{self.blocks}; more with a larger cutting.spare"
                )
            arrays = Numbering.of(row, column, n).padded(self.blocks, self.places)
            last = self._last = scene, arrays, [place.stencil(n, keys) for place in places]
        return last[1:]


def _room(splitting: Splitting) -> int:
    """Returns for how many blocks above the diagonal of bodies that may be split there is room.

    Those of the whole mesh, and for each spare node as many as the nodes there at most have. Only copies beside copies
    of a node can have more.
    """
    room = 0
    for splitter in splitting.splitters.values():
        tets = splitter.whole.tets
        keys = np.unique(np.concatenate([tets[:, a] * np.int64(splitter.nodes) + tets[:, b]
                                         for a in range(4) for b in range(4) if a != b]))  # fmt: skip
        degree = np.bincount(keys // splitter.nodes, minlength=splitter.nodes)
        room += min(len(keys) // 2 + splitter.spares * int(degree.max()), 6 * len(tets))
    return room
