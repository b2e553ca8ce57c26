# SPDX-License-Identifier: MIT
"""Refuses scenes that are larger than the server is allowed to hold, before anything of theirs is allocated.

The bytes are an estimate for the CPU (the host's part on a GPU is less): a line in the elements, and for solves with
factors the copies of L that a server holds at a time. L of a body of n nodes is taken for 72 n^(4/3) values: the law of
nested dissection in 3D (George, Nested dissection of a regular finite element mesh, 1973), with the constant of bars of
1,500 to 1,029,000 tets by METIS, where it is 39 to 76. The rest is fitted to the largest resident memory of servers
with 1,500 to 202,272 tets, linear corotational, with a worker and a log (tests/scene/test_size_limits.py).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from protocol.shared_memory.limits import POOL_LIMIT, SLOT_SHARE
from sim_server.errors import InputError
from sim_server.scene.model import Scene, SceneObject
from sim_server.scene.sizes import SIZES, measure

BASE = 126e6  # bytes of the process
TET = 2e3  # bytes of an element: arrays of mesh, matrix, kernels and frames
FACTOR = 4 * 72.0  # bytes of L in single precision over nodes^(4/3)
HELD = 3  # copies of L in memory of the server's own: in use, the next one, and one that arrives
LENT = 3  # the same in slots of shared memory, as far as these may be lent
TETS_OF_A_CELL, TETS_OF_A_TET = 6, 8  # of a bar; of a quadratic element, which is split


class Size(NamedTuple):
    """Of an object, as it is simulated."""

    tets: int
    nodes: int


@dataclass(frozen=True)
class SizeLimits:
    """What a server may hold. bytes: of memory, estimated; None: no limit"""

    objects: int | None = None
    bytes: float | None = None

    @classmethod
    def of_options(cls, objects: int | None, memory: str | None) -> "SizeLimits":
        """Reads --max-objects and --max-memory. Raises InputError."""
        size = None if memory is None else measure(memory, SIZES)
        if memory is not None and (size is None or size < BASE):
            raise InputError(f"--max-memory {memory}: allowed is a size of at least {BASE / 1e6:g}MB, as 4GB or 500MiB")
        return cls(objects, size)

    def check(self, scene: Scene) -> None:
        """Raises InputError for a scene beyond them. Meshes of bars are counted, others are read one by one."""
        if self.objects is not None and len(scene.objects) > self.objects:
            raise InputError(f"has {len(scene.objects)} objects; --max-objects allows {self.objects}")
        if self.bytes is None:
            return
        sizes: list[Size] = []
        for o in scene.objects:
            sizes.append(_size(o))
            needed = estimate(sizes, scene.solver.wants_factors)
            if needed > self.bytes:
                of_all = "" if len(sizes) == len(scene.objects) else f" for the first {len(sizes)} of its objects alone"
                raise InputError(
                    f"needs about {needed / 1e9:.3g} GB of memory for {sum(size.tets for size in sizes)} tets{of_all}; "
                    f"--max-memory allows {self.bytes / 1e9:.2g} GB"
                )


NO_LIMITS = SizeLimits()


def estimate(sizes: Sequence[Size], factors: bool) -> float:
    """Returns the bytes that a server takes. sizes: of each object; factors: solves use them"""
    needed = BASE + TET * sum(size.tets for size in sizes)
    if not factors:
        return needed
    each = [FACTOR * size.nodes ** (4 / 3) for size in sizes]
    lent = sum(size for size in each if size <= POOL_LIMIT / SLOT_SHARE)  # larger ones travel in parts
    return needed + HELD * sum(each) + min(LENT * lent, POOL_LIMIT)


def _size(o: SceneObject) -> Size:
    bar = o.mesh.bar
    if bar is None:
        mesh = o.load_mesh()
        return Size(len(mesh.tets), len(mesh.rest))
    quadratic = o.elements == "quadratic"
    cells = [2 * cells for cells in bar] if quadratic else bar
    tets = TETS_OF_A_CELL * math.prod(bar) * (TETS_OF_A_TET if quadratic else 1)
    return Size(tets, math.prod(count + 1 for count in cells))
