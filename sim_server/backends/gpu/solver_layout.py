# SPDX-License-Identifier: MIT
"""Distribution of the solves of all bodies over the multiprocessors of a device: threads, thread blocks, rows of A."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int64
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.followed_rows import FollowedRows
from sim_server.backends.gpu.row_partition import (
    COLUMN_BITS,
    SPARED,
    BlockAssignment,
    Halo,
    best_assignment,
    halo,
    initial_ranges,
    lists_of,
    mirrored,
)
from sim_server.backends.gpu.solver_features import SolverFeatures

# Bytes in shared memory of a block of A, of a node, and of the rest (spmv.cuh).
BLOCK_BYTES, NODE_BYTES, OTHER_BYTES = 76, 216, 5120
FILLING = 100  # nodes of a body that keep a multiprocessor busy
DECLARED, DECLARED_CORRECTED = 2048, 5120  # bytes of shared memory that pcg.cu declares
DECLARED_WARPS = 1024  # and what more than eight warps add to that
DRIVER = 1024  # bytes of it that the driver takes for each thread block


def threads_and_blocks(
    nodes: Int64, blocks: Int64, processors: int, shared: int, exchanges: bool = True
) -> tuple[int, int]:
    """Returns threads per thread block and thread blocks per multiprocessor.

    Bodies of many small ones have a multiprocessor for themselves, one after another, since its shared memory then
    holds half of A and much of the factor. Tiny ones do not fill one: four are on a multiprocessor, or two if that is
    what it takes to have their rows of A in its shared memory, which else pass through it in every iteration.

    nodes, blocks (bodies,): of each body and of its rows of A. shared: bytes of a multiprocessor. exchanges: True if a
    body may not be solved as one that exchanges nothing (block_group.cuh), which keeps half of A
    """
    if len(nodes) <= processors - SPARED:
        return 256, 1  # 255 registers a thread: spilling to local memory costs a trip to L2
    if not exchanges and len(nodes) > 1.5 * processors and np.median(nodes) >= FILLING:
        return 256, 1
    if len(nodes) <= 2 * processors or np.median(nodes) >= 300:
        return 128, 2
    needed = np.median(BLOCK_BYTES * blocks + NODE_BYTES * nodes) + OTHER_BYTES
    return (128, 2) if shared / 4 < needed <= shared / 2 else (64, 4)


def threads_alone(nodes: Int64, blocks: Int64, shared: int) -> int:
    """Returns threads of a thread block that has a multiprocessor and its body for itself.

    Where shared memory does not hold the half of A that is kept, that half and most of the factor are fetched in every
    iteration. Twice the warps, with half the registers each, then have more of it under way.

    nodes, blocks (bodies,): of each body and of its rows of A. shared: bytes of a multiprocessor
    """
    needed = np.median(BLOCK_BYTES / 2 * blocks + NODE_BYTES * nodes) + OTHER_BYTES
    return 256 if needed <= shared else 512


def alone(nodes: Int64, blocks: Int64, count: Int64) -> bool:
    """Returns whether each body is solved by one thread block, which then needs no exchanges (block_group.cuh).

    nodes, blocks, count (bodies,): of each body, of its rows of A, and thread blocks
    """
    fits = nodes.max() <= 1 << COLUMN_BITS and blocks.max() < 1 << 31 - COLUMN_BITS  # into a word of spmv.cuh
    return len(count) > 1 and bool(fits) and int(count.max()) == 1


@dataclass(frozen=True)
class SolverLayout:
    """Who solves what.

    spans: (bodies, 2) nodes [first, last) of each body
    threads: of a thread block; per_processor: thread blocks of a multiprocessor; grid: all thread blocks
    spared: multiprocessors that a launch leaves free; shared: bytes of the dynamic shared memory of a thread block
    assigned: thread blocks of each body; alone: True if none exchanges anything with another
    partition: rows of each thread block; lists: the same by names of PcgArguments
    halo: entries of the lists of nodes that thread blocks read, at most
    followed: what follows the pattern of A, where it changes
    """

    spans: Int64
    threads: int
    per_processor: int
    grid: int
    spared: int
    shared: int
    assigned: BlockAssignment
    alone: bool
    partition: Halo
    lists: Mapping[str, NDArray[np.int32]]
    halo: int
    followed: FollowedRows | None = None

    @classmethod
    def of(
        cls, gpu: Gpu, ranges: Sequence[tuple[int, int]], arrays: Mapping[str, NDArray[Any]], features: SolverFeatures
    ) -> "SolverLayout":
        """Returns that of a scene. arrays: of the host, row_start and columns of A among them."""
        spans, pattern = np.array(ranges, np.int64), (arrays["row_start"], arrays["columns"])
        nodes = spans[:, 1] - spans[:, 0]
        rows = np.diff(arrays["row_start"].astype(np.int64)[spans], axis=1)[:, 0]
        processors, memory = (gpu.properties[k] for k in ("multiProcessorCount", "sharedMemPerMultiprocessor"))
        threads, per_processor = threads_and_blocks(nodes, rows, processors, memory, features.exchanges)
        assigned, most = best_assignment(nodes, processors, per_processor)
        grid = most if assigned.pooled else int(assigned.blocks.sum())
        separate = not features.exchanges and alone(nodes, rows, assigned.blocks)
        if separate and per_processor == 1:
            threads = threads_alone(nodes, rows, memory)
        declared = (DECLARED_CORRECTED if features.correction else DECLARED) + (DECLARED_WARPS if threads > 256 else 0)
        partition = halo(spans, assigned.blocks, pattern[0], pattern[1][: pattern[0][-1]])
        made = cls(
            spans, threads, per_processor, grid, spared=processors - -(-grid // per_processor),
            shared=(memory // per_processor - declared - DRIVER) // 16 * 16, assigned=assigned,
            alone=separate, partition=partition,
            lists=lists_of(partition), halo=len(partition.nodes),
        )  # fmt: skip
        if features.most_blocks:
            followed = FollowedRows(spans, assigned.blocks, features.most_blocks)
            return replace(made, followed=followed, lists=followed.of(*pattern), halo=followed.halo)
        if made.alone:
            return replace(made, lists={**made.lists, **mirrored(partition, *pattern, threads // 32)})
        return made

    @property
    def nodes(self) -> Int64:
        """Nodes of each body, (bodies,)."""
        return self.spans[:, 1] - self.spans[:, 0]

    @property
    def order(self) -> NDArray[np.int32]:
        """Bodies with thread blocks of their own, then those of the pool, largest first; twice, (2 bodies,)."""
        return np.tile(self.assigned.order.astype(np.int32), 2)

    @property
    def initial_range(self) -> NDArray[np.int32]:
        """Range with which each thread block begins, -1 where it takes one of the pool, (grid,)."""
        return initial_ranges(self.assigned, self.partition, self.grid)
