# SPDX-License-Identifier: MIT
"""Refuses scenes that are larger than the server is allowed to hold, before anything of theirs is allocated.

The bytes are an estimate for the CPU (the host's part on a GPU is less): a line and the growth of a factor in 3D, tets
to the power 4/3, fitted to the largest resident memory of servers with 1,500, 12,000 and 39,936 tets, linear
corotational, with a worker and a log; it was within 8 % of each.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sim_server.errors import InputError
from sim_server.scene.model import Scene, SceneObject
from sim_server.scene.sizes import SIZES, measure

BASE = 80e6  # bytes of the process
TET = 16e3  # bytes of an element: arrays of mesh, matrix, kernels and frames
FACTOR = 150.0  # bytes times tets^(4/3): factors in use, waiting and in shared memory
TETS_OF_A_CELL = 6


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
        tets: list[int] = []
        for o in scene.objects:
            tets.append(_tets(o))
            needed = estimate(tets, scene.solver.wants_factors)
            if needed > self.bytes:
                of_all = "" if len(tets) == len(scene.objects) else f" for the first {len(tets)} of its objects alone"
                raise InputError(
                    f"needs about {needed / 1e9:.3g} GB of memory for {sum(tets)} tets{of_all}; --max-memory allows "
                    f"{self.bytes / 1e9:.2g} GB"
                )


NO_LIMITS = SizeLimits()


def estimate(tets: Sequence[int], factors: bool) -> float:
    """Returns the bytes that a server takes. tets: of each object; factors: solves use them"""
    grown = sum(float(count) ** (4 / 3) for count in tets)
    return BASE + TET * sum(tets) + (FACTOR * grown if factors else 0.0)


def _tets(o: SceneObject) -> int:
    bar = o.mesh.bar
    return TETS_OF_A_CELL * math.prod(bar) if bar is not None else len(o.load_mesh().tets)
