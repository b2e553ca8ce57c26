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
    there is none; sides (f, 2): 4 times the element + row of FACES, -1: there is none."""

    corners: Int32
    owners: Int64
    sides: Int64

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
        return cls(corners[both].astype(np.int32), np.where(both < 0, -1, both // 4), both)

    def surface(
        self, present: Float64 | NDArray[np.bool_], tets: Int32 | None = None, closed: NDArray[np.bool_] | None = None
    ) -> Int32:
        """Returns the triangles (t, 3) that one present element has alone, outward. present: (m,), not 0 where so.

        tets, closed: of a mesh that was split, its elements, and the faces (f,) that hold two of them together
        """
        there = (np.append(present, 0) != 0)[self.owners]
        alone, side = there.sum(axis=1) == 1, there.argmax(axis=1)
        if tets is None or closed is None:
            return self.corners[alone, side[alone]]
        opened = there.all(axis=1) & ~closed
        sides = np.concatenate([self.sides[alone, side[alone]], self.sides[opened].ravel()])
        return tets[sides[:, None] // 4, FACES[sides % 4]].astype(np.int32)
