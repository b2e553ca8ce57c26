# SPDX-License-Identifier: MIT
"""Refuses scenes that are larger than the server is allowed to hold, before anything of theirs is allocated.

The bytes are an estimate for the CPU: a line in the elements and spare nodes, and for solves with factors the copies of
L that a server holds at a time. On a GPU the host's part of these is less, and the page-locked copies of matrices come
to it. L of a body of n nodes is taken for 72 n^(4/3) values: the law of nested dissection in 3D (George, Nested
dissection of a regular finite element mesh, 1973), with the constant of bars of 1,500 to 1,029,000 tets by METIS, where
it is 39 to 76. Nodes of smoothed and patch elements have neighbours two elements away, so that separators are thicker:
the constant is larger, and the smaller the body the more of a separator lies at its surface. The rest is fitted to the
largest resident memory of servers with 1,500 to 202,272 tets, corotational, with a worker and a log
(tests/scene/test_size_limits.py).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from protocol.shared_memory.limits import POOL_LIMIT, SLOT_SHARE
from sim_server.errors import InputError
from sim_server.scene.elements import kind_of_elements
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.model import Scene, SceneObject
from sim_server.scene.sizes import SIZES, measure

Copies = Callable[[Sequence[float]], float]

BASE = 126e6  # bytes of the process
# Bytes of an element: arrays of mesh, matrix, kernels and frames; by kind of element. Of quadratic ones: of their parts
TET = {"linear": 2e3, "patch": 3.5e3, "smoothed": 5.8e3, "quadratic": 2e3}
SPARE = 5e3  # bytes of a node that is kept for splits: the same, and room for blocks of A
VALUES = 72.0  # numbers of L over nodes^(4/3)
THICK = {"patch": (145.0, 700.0), "smoothed": (270.0, 1740.0)}  # the same; numbers less for each node
HELD = 3  # copies of L in memory of the server's own: in use, the next one, and one that arrives
LENT = 3  # the same in slots of shared memory, as far as these may be lent
BLOCKS = {"linear": 15, "patch": 31, "smoothed": 46, "quadratic": 29}  # of A over nodes of a bar, by kind of element
TETS_OF_A_CELL, TETS_OF_A_TET = 6, 8  # of a bar; of a quadratic element, which is split
EDGES = 6  # of an element


class Size(NamedTuple):
    """Of an object, as it is simulated."""

    tets: int
    nodes: int  # but for spare ones
    blocks: int = 0  # of A
    kind: str = "linear"  # of its elements
    spares: int = 0


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

    def check(self, scene: Scene, copies: Copies | None = None) -> None:
        """Raises InputError for a scene beyond them. Meshes of bars are counted, others are read one by one.

        copies: as of `estimate`
        """
        if self.objects is not None and len(scene.objects) > self.objects:
            raise InputError(f"has {len(scene.objects)} objects; --max-objects allows {self.objects}")
        if self.bytes is None:
            return
        sizes: list[Size] = []
        for o in scene.objects:
            sizes.append(_size(o, scene.integrator))
            needed = estimate(sizes, scene.solver.wants_factors, copies)
            if needed > self.bytes:
                of_all = "" if len(sizes) == len(scene.objects) else f" for the first {len(sizes)} of its objects alone"
                raise InputError(
                    f"needs about {needed / 1e9:.3g} GB of memory for {sum(size.tets for size in sizes)} tets{of_all}; "
                    f"--max-memory allows {self.bytes / 1e9:.2g} GB"
                )


NO_LIMITS = SizeLimits()


def estimate(sizes: Sequence[Size], factors: bool, copies: Copies | None = None) -> float:
    """Returns the bytes that a server takes.

    sizes: of each object
    factors: solves use them
    copies: returns the bytes of memory for copies of matrices with so many blocks; None: who needs one makes it
    """
    needed = BASE + sum(TET[size.kind] * size.tets + SPARE * size.spares for size in sizes)
    if not factors:
        return needed
    each = [4 * values(size) for size in sizes]
    lent = sum(size for size in each if size <= POOL_LIMIT / SLOT_SHARE)  # larger ones travel in parts
    copied = 0.0 if copies is None else copies([size.blocks for size in sizes])
    return needed + HELD * sum(each) + min(LENT * lent, POOL_LIMIT) + copied


def values(size: Size) -> float:
    """Returns how many values L of a body about has, at most."""
    most, less = THICK.get(size.kind, (VALUES, 0.0))
    return max(most * size.nodes ** (4 / 3) - less * size.nodes, 4.5 * size.blocks)  # as many as half of A at least


def expected_values(nodes: int, blocks: int) -> float:
    """Returns how many values L of a matrix with so many 3x3 blocks has at most by nested dissection: the law above for
    linear elements, in proportion to the blocks of a node for others (tests/link/test_inflated_patterns.py)."""
    return float(VALUES * nodes ** (1 / 3) * blocks / BLOCKS["linear"])


def _size(o: SceneObject, integrator: IntegratorOptions) -> Size:
    bar, mesh = o.mesh.bar, None
    if bar is None:
        mesh = o.load_mesh()
        tets, nodes = len(mesh.tets), len(mesh.rest)
    else:
        quadratic = o.elements == "quadratic"
        cells = [2 * cells for cells in bar] if quadratic else bar
        tets = TETS_OF_A_CELL * math.prod(bar) * (TETS_OF_A_TET if quadratic else 1)
        nodes = math.prod(count + 1 for count in cells)
    kind, spares = kind_of_elements(o, mesh, integrator), getattr(o.effects.get("cutting"), "spare", 0)
    beside = BLOCKS[kind] - 1
    room = spares + 2 * min(spares * beside, max(EDGES * tets - beside * nodes // 2, 0))  # split_pattern.py
    return Size(tets, nodes, BLOCKS[kind] * nodes + room, kind, spares)
