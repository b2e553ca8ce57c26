# SPDX-License-Identifier: MIT
"""Orders of elimination on disk: a mesh is ordered once per machine, not once per start of a worker.

METIS takes a third of a second for 98,304 tetrahedra, seconds for a million. A file is named after the digest of the
graph and of what orders it. What is read is checked: a file of somebody else, one that others may write to, or one that
holds no permutation of the right size counts as not there. It could cost time, and never an answer.
"""

from collections.abc import Callable

import numpy as np
import xxhash

from precond_worker.arrays import Int32, Int64
from protocol.process.cache_folder import cache_folder
from protocol.process.kept_files import keep, read_kept

MOST_BYTES = 256 << 20  # of all files together; the ones that were used longest ago are deleted
LEAST_NODES = 2000  # of a graph that is kept: small ones are ordered faster than a file is written
SUFFIX = ".order"

Order = Callable[[Int32, Int32], Int64]


def cached(order: Order, name: str, start: Int32, neighbours: Int32) -> Int64:
    """Returns order(start, neighbours), from the disk if it is there. name: of what orders, with its version."""
    if len(start) <= LEAST_NODES:
        return order(start, neighbours)
    digest = xxhash.xxh3_128(name.encode())
    for array in (start, neighbours):
        digest.update(len(array).to_bytes(8, "little") + np.ascontiguousarray(array).tobytes())
    path = cache_folder() / "orders" / f"{digest.hexdigest()}{SUFFIX}"
    found = _checked(read_kept(path, 4 * (len(start) - 1)), len(start) - 1)
    if found is None:
        found = order(start, neighbours)
        keep(path, found.astype(np.int32).tobytes(), MOST_BYTES)
    return found


def _checked(data: bytes | None, nodes: int) -> Int64 | None:
    """Returns the order in a file; None if that holds no permutation of the nodes."""
    if data is None or len(data) != 4 * nodes:
        return None
    order = np.frombuffer(data, np.int32).astype(np.int64)
    in_range = order.min() >= 0 and order.max() < nodes
    return order if in_range and (np.bincount(order, minlength=nodes) == 1).all() else None
