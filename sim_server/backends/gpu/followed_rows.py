# SPDX-License-Identifier: MIT
"""Lists of the solver that follow the pattern of A, where bodies may be split while steps run.

The pattern changes between two steps, and graphs that were captured keep their addresses: so all arrays have room for
the pattern with the most blocks, and are made anew on the host, beside the steps.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64
from sim_server.backends.gpu.row_partition import Halo, halo, lists_of


class FollowedRows:
    """Lists of the solver (row_partition.Halo) by the pattern of A, in arrays of one size.

    ranges (bodies, 2): nodes [first, last) of each body. blocks (bodies,): its thread blocks. most (bodies,): blocks of
    A that it has at most
    halo: entries of all lists of nodes that thread blocks read, at most. places: blocks of A, at most
    """

    def __init__(self, ranges: Int64, blocks: Int64, most: Sequence[int]):
        self._ranges, self._blocks = ranges, blocks
        nodes = ranges[:, 1] - ranges[:, 0]
        # a thread block reads its own nodes, and for each block of A off the diagonal one other at most
        self.halo = int(np.minimum(blocks * nodes, np.asarray(most)).sum())
        self.places = int(np.sum(most))

    def of(self, row_start: Int32, columns: Int32) -> dict[str, NDArray[np.int32]]:
        """Returns the arrays by their names in PcgArguments. Raises ValueError for more blocks than there is room."""
        found = self.partition(row_start, columns)
        if len(found.nodes) > self.halo or len(found.local) > self.places:
            raise ValueError(
                f"{len(found.local)} blocks of A and {len(found.nodes)} nodes that are read; room: {self.places} and "
                f"{self.halo}"
            )
        lists, room = lists_of(found), {"halo": self.halo, "local_column": self.places}
        return {name: _padded(array, room.get(name, len(array))) for name, array in lists.items()}

    def partition(self, row_start: Int32, columns: Int32) -> Halo:
        """Returns the rows of each thread block. columns: with any room behind the last row."""
        return halo(self._ranges, self._blocks, row_start, columns[: row_start[-1]])


def changed_bodies(
    ranges: Sequence[tuple[int, int]], before: tuple[Int32, Int32], after: tuple[Int32, Int32]
) -> NDArray[np.bool_]:
    """Returns which bodies have another pattern, (bodies,). before, after: row_start and columns of A."""
    found = np.zeros(len(ranges), bool)
    for k, (first, last) in enumerate(ranges):
        (old, old_columns), (new, new_columns) = before, after
        found[k] = not (
            np.array_equal(old[first : last + 1] - old[first], new[first : last + 1] - new[first])
            and np.array_equal(old_columns[old[first] : old[last]], new_columns[new[first] : new[last]])
        )
    return found


def _padded(values: NDArray[np.int32], size: int) -> NDArray[np.int32]:
    return np.concatenate([values, np.zeros(size - len(values), np.int32)])
