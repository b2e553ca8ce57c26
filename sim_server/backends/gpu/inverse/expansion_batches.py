# SPDX-License-Identifier: MIT
"""Input of the kernels of build_inverse.cu: layout of the workspace and lists of tasks.

Parts are built in batches that fit into the workspace, from the top of the tree down, since the scale of a boundary
belongs to parts above. Runs on the host, once per pattern and plan.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Int32, Int64
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.inverse.partition import ROWS, padded
from sim_server.backends.gpu.inverse.plan import Plan, ranges

INVERSE = Declarations("backends/gpu/inverse/build_inverse.cu")
EDGE: int = INVERSE.constant("EDGE")  # rows and columns of a tile of the kernels
WORKSPACE = 256 << 20  # bytes, unless a single part needs more

MOST_BUILDS: int = INVERSE.constant("MOST_BUILDS")

PART, COLUMN = INVERSE.dtype("Part"), INVERSE.dtype("Column")
BUILDS, STRIDES, INVERSE_STORAGE = (INVERSE.dtype(name) for name in ("Builds", "Strides", "InverseStorage"))


@dataclass(frozen=True)
class BuildBatch:
    """Parts that are built together.

    first, last: range of the table of columns
    cleared: bytes at the beginning of the workspace that are set to zero
    diagonal, finish: tasks (k, 4): part, tile row, tile column, end of the first run
    merges: tasks, level by level
    """

    first: int
    last: int
    cleared: int
    diagonal: Int32
    merges: list[Int32]
    finish: Int32


@dataclass(frozen=True)
class WorkspaceLayout:
    """Layout of the workspace, and tasks.

    parts, columns: tables of PART and COLUMN
    place (rows of the pattern,): column of each entry of L's row lists in the matrix G of its part
    row_chunk (N / 8,), out_chunk (contributions / 8,): first chunk of each tile
    size: bytes of workspace
    """

    parts: NDArray[Any]
    columns: NDArray[Any]
    place: Int32
    row_chunk: Int32
    out_chunk: Int32
    batches: list[BuildBatch]
    size: int


def workspace_layout(pattern: FactorPattern, plan: Plan, workspace: int = WORKSPACE) -> WorkspaceLayout:
    """Lays out the workspace in which the parts of a plan are built."""
    parts, members = _parts(plan, workspace)
    columns, first = _columns(pattern, plan)
    batches = [_batch(parts, p, first) for p in members]
    row_chunk, out_chunk = _chunks(plan)
    return WorkspaceLayout(
        parts, columns, _place(pattern, plan), row_chunk, out_chunk, batches, max(_end(parts, p) for p in members)
    )


def _end(parts: NDArray[Any], members: Int64) -> int:
    last = parts[members[-1]]
    return 4 * int(last["t"] + int(last["pitch_t"]) ** 2)


def _parts(plan: Plan, workspace: int) -> tuple[NDArray[Any], list[Int64]]:
    """Returns the table of parts, and the parts of each batch."""
    table = np.zeros(len(plan.parts.v), PART)
    for name in ("v", "b", "start", "boundary", "out"):
        table[name] = getattr(plan.parts, name)
    table["pitch_t"] = padded(plan.parts.v, EDGE)
    table["pitch_g"] = table["pitch_t"] + padded(plan.parts.b, EDGE)
    v, pitch = table["pitch_t"].astype(np.int64), table["pitch_g"].astype(np.int64)
    g, t = v * pitch, v * v
    members: list[list[int]] = []
    batch: list[int] = []
    used = 0
    for p in range(len(table) - 1, -1, -1):  # the last group first
        if batch and used + int(g[p] + t[p]) > workspace // 4:
            members.append(batch)
            batch, used = [], 0
        batch.append(p)
        used += int(g[p] + t[p])
    members.append(batch)
    found = [np.array(b) for b in members]
    for b in found:
        table["g"][b] = np.cumsum(g[b]) - g[b]  # all G first: they are cleared at once
        table["t"][b] = g[b].sum() + np.cumsum(t[b]) - t[b]
    return table, found


def _columns(pattern: FactorPattern, plan: Plan) -> tuple[NDArray[Any], Int64]:
    """Returns the table of columns in packed order, and the first entry of each part, (parts + 1,)."""
    width = np.diff(pattern.super_start).astype(np.int64)
    supernode = np.repeat(np.arange(len(width)), width)
    within = np.arange(pattern.size) - pattern.super_start[:-1].astype(np.int64)[supernode]
    column = plan.column[plan.column >= 0]
    table = np.zeros(pattern.size, COLUMN)
    table["value"] = pattern.diagonal[column]
    table["row"] = (pattern.row_start[:-1][supernode] + within)[column]
    table["length"] = (np.diff(pattern.row_start)[supernode] - within)[column]
    table["part"] = plan.part[supernode][column]
    first = np.concatenate([[0], np.cumsum(plan.parts.v.astype(np.int64))])
    table["within"] = np.arange(pattern.size) - first[table["part"]]
    return table, first


def _place(pattern: FactorPattern, plan: Plan) -> Int32:
    owner = np.repeat(plan.part, np.diff(pattern.row_start)).astype(np.int64)
    position = np.empty(pattern.size, np.int64)  # packed, of each column of L
    position[plan.column[plan.column >= 0]] = np.flatnonzero(plan.column >= 0)
    packed = position[pattern.rows]
    local = packed - plan.parts.start[owner]
    inside = (local >= 0) & (local < plan.parts.v[owner])
    count = plan.parts.b.astype(np.int64)
    entries = ranges(plan.parts.boundary.astype(np.int64), count)
    keys = np.repeat(np.arange(len(count)), count) * (plan.size + 1) + plan.boundary[entries]
    order = np.argsort(keys)
    out = ~inside
    found = order[np.searchsorted(keys[order], owner[out] * (plan.size + 1) + packed[out])]
    within = found - (np.cumsum(count) - count)[owner[out]]
    local[out] = within + padded(plan.parts.v.astype(np.int64), EDGE)[owner[out]]
    return local.astype(np.int32)


def _chunks(plan: Plan) -> tuple[Int32, Int32]:
    forward = plan.tile_start[(plan.groups - 1) * plan.blocks]
    row_chunk = np.zeros(plan.size // ROWS, np.int32)
    out_chunk = np.zeros(max(1, plan.contributions // ROWS), np.int32)
    out_chunk[plan.tiles[:forward, 3] // ROWS] = plan.tiles[:forward, 0]
    row_chunk[plan.tiles[forward:, 3] // ROWS] = plan.tiles[forward:, 0]
    return row_chunk, out_chunk


def _batch(parts: NDArray[Any], members: Int64, first: Int64) -> BuildBatch:
    inside, edge = parts["pitch_t"][members] // EDGE, (parts["pitch_g"] - parts["pitch_t"])[members] // EDGE
    lower = [_lower(int(n)) for n in inside]
    part = np.repeat(members, [len(pairs) for pairs in lower])
    pairs = np.concatenate(lower)
    diagonal = pairs[:, 0] == pairs[:, 1]
    square = np.column_stack([part, pairs, np.zeros(len(part), np.int64)])
    rows = np.concatenate([np.repeat(np.arange(n), e) for n, e in zip(inside, edge, strict=True)])
    across = np.concatenate([np.tile(n + np.arange(e), n) for n, e in zip(inside, edge, strict=True)])
    coupling = np.column_stack([np.repeat(members, inside * edge), rows, across, np.zeros_like(rows)])
    finish = np.concatenate([square, coupling])
    depth = (parts["pitch_t"] // EDGE)[finish[:, 0]] - finish[:, 1]
    low, high = int(first[members.min()]), int(first[members.max() + 1])  # members are consecutive
    return BuildBatch(
        low,
        high,
        4 * int(parts["t"][members[0]]),
        _tasks(square[diagonal]),
        [_tasks(level) for level in _levels(square[~diagonal])],
        _tasks(finish[np.argsort(-depth, kind="stable")]),  # the long ones first
    )


def _tasks(tasks: NDArray[Any]) -> Int32:
    return np.ascontiguousarray(tasks, np.int32)


@lru_cache(64)
def _lower(n: int) -> Int64:
    """Returns (i, j) of the lower triangle of n x n tiles, the diagonal included."""
    return np.column_stack(np.tril_indices(n))


def _levels(pairs: Int64) -> list[Int64]:
    """Groups tiles (part, i, j, end) below the diagonal by level, the highest bit in which i and j differ.

    On a level, runs of 2^level tiles are merged in pairs; `end` is the end of the first of the two.
    """
    differ = pairs[:, 1] ^ pairs[:, 2]
    levels = []
    for level in range(int(differ.max(initial=0)).bit_length()):
        chosen = pairs[(differ >> level) == 1].copy()
        chosen[:, 3] = ((chosen[:, 2] >> (level + 1)) << (level + 1)) + (1 << level)
        levels.append(chosen)
    return levels
