# SPDX-License-Identifier: MIT
"""Faces of a tetrahedral mesh with the elements on both sides, from which surfaces follow when elements are removed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.mesh.surface import FACES, grouped_faces


@dataclass(frozen=True)
class Faces:
    """corners (f, 2, 3): nodes of each face as each of its two elements has them, outward; owners (f, 2): these, -1:
    there is none."""

    corners: Int32
    owners: Int64

    @classmethod
    def of(cls, tets: Int32) -> "Faces":
        """Returns the faces of elements (m, 4) of positive volume."""
        corners = tets[:, FACES].reshape(-1, 3)
        order, first = grouped_faces(tets)
        number = np.cumsum(first) - 1
        second = np.flatnonzero(~first)
        both = np.full((number[-1] + 1, 2), -1)
        both[:, 0] = order[first]
        both[number[second], 1] = order[second]
        return cls(corners[both].astype(np.int32), np.where(both < 0, -1, both // 4))

    def surface(self, present: Float64 | NDArray[np.bool_]) -> Int32:
        """Returns the triangles (t, 3) that one present element has alone, outward. present: (m,), not 0 where so."""
        there = (np.append(present, 0) != 0)[self.owners]
        alone, side = there.sum(axis=1) == 1, there.argmax(axis=1)
        return self.corners[alone, side[alone]]
