# SPDX-License-Identifier: MIT
"""Plan of the partitioned inverse on a GPU: storage of the matrices in tiles, phases, and their thread blocks.

With parts (partition.py) V, their boundaries B and A_VV as it is once everything below has been eliminated, the factor
is applied as, S~ = D^-1 A_VV^-1 D^-1 and W~ = D^-1 A_VV^-1 A_VB D with D the square root of the diagonal of A_VV^-1,

    s~ = D r;  forward, groups 1 .. P-1: s~_B -= W~^T s~_V;  top: y_V = S~ s~_V;
    backward, P-1 .. 1: y_V = S~ s~_V - W~ y_B;  z = D y

in 2 P - 1 phases, each a set of independent dense products. |S~| <= 1, so float16 neither overflows nor loses the stiff
regions. P = 1 is the dense inverse.

Vectors are in packed order: part after part, in a part the order of elimination, each part padded to a multiple of 32
with zeros; N in all, then 32 more zeros. Matrices are kept in chunks of 8 rows x 32 columns, row-major, float16; a tile
is 8 rows by all columns, its chunks one after another; with planes = 2 as many more follow, of the remainders
(value - float16(value)) * 2048. Columns of a part and of its boundary are padded to 32 each, rows to 8, with zeros.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from protocol.factor import FactorPattern
from sim_server.arrays import Int32, Int64
from sim_server.backends.gpu.inverse.load_balance import TilePartition, balance
from sim_server.backends.gpu.inverse.partition import COLUMNS, NODE, ROWS, Partition, Tree, padded, partition, tree_of
from sim_server.backends.gpu.inverse.tree_cuts import SHARED_MEMORY, choose_thresholds, phase_work

FORM, READ, GATHER, WRITE = 0, 1, 2, 4  # kinds of segments
CHUNK_BYTES = 2 * ROWS * COLUMNS  # bytes
TRIP_ENTRIES, TRIP_SLOTS = 512, 6  # entries of a part, and contributions to each, that a block loads in one trip
TRIPS = 2  # above it each block of a part forms some of its entries and reads those of the other blocks
_CACHED = 64  # plans


class Parts(NamedTuple):
    """Parts of the partition, (parts,) each.

    group
    start: packed position of the first degree of freedom
    v, b: number of degrees of freedom inside and in the boundary
    boundary: first entry in Plan.boundary
    out: first entry of its contributions
    """

    group: Int32
    start: Int32
    v: Int32
    b: Int32
    boundary: Int32
    out: Int32


@dataclass(frozen=True, eq=False)
class Plan:
    """Plan for one pattern and number of thread blocks. Arrays are int32; [phase, block] means phase * blocks + block.

    segments (k, 4): kind, from, count, to: what a block brings into its x area before a phase, `to` entries from its
        beginning; count and to are multiples of 32. kind FORM: s~ at packed positions from.. out of residual and
        contributions (| WRITE: and stores it for the others, exactly one block does); READ: s~ formed earlier, or in
        this phase by another block; GATHER: y at boundary[from..]. Those that are FORM come first.
    tiles (m, 4): chunk (the first one), x (offset in the x area, a multiple of 32), chunks (columns / 32), out (the
        first of 8 packed positions; forward: of 8 contributions). Sorted by [phase, block].
    segment_start, tile_start (phases * blocks + 1,): of each [phase, block].
    boundary: packed positions, N for padding; 32 k per part.
    slot_start (N + 1,), slots: the contributions that each packed position subtracts, in this order.
    chunk_start (blocks + 1,): of each block in the storage, which is sorted by block, phase, tile.
    place (nodes,): packed position of a node's first degree of freedom. column (N,): column of L, -1 for padding.
    part (supernodes,): of each supernode. parts: of each part.
    size N, phases, blocks, groups P, contributions, chunks; x_area: entries of the largest; bytes of the matrices.
    """

    segments: Int32
    tiles: Int32
    segment_start: Int32
    tile_start: Int32
    boundary: Int32
    slot_start: Int32
    slots: Int32
    chunk_start: Int32
    place: Int32
    column: Int32
    part: Int32
    parts: Parts
    size: int
    phases: int
    blocks: int
    groups: int
    planes: int
    contributions: int
    chunks: int
    x_area: int

    @property
    def bytes(self) -> int:
        """Size of the stored matrices."""
        return CHUNK_BYTES * self.chunks

    @property
    def nbytes(self) -> int:
        """Size of the arrays of the plan."""
        return sum(v.nbytes for v in vars(self).values() if isinstance(v, np.ndarray))


_plans: dict[tuple[int, int, int | None, int, int], Plan] = {}


def plan(
    pattern: FactorPattern, blocks: int, groups: int | None = None, planes: int = 1, shared: int = SHARED_MEMORY
) -> Plan:
    """The plan of least predicted time, with `groups` groups (or as many as the tree has) if given. planes: 1 or 2
    float16 numbers per entry. shared: bytes of shared memory of a thread block. Cached by pattern.id.

    Raises ValueError for a pattern that is not one of whole nodes of a Cholesky factor.
    """
    key = (pattern.id, blocks, groups, planes, shared)
    if key not in _plans:
        if len(_plans) >= _CACHED:
            _plans.clear()
        tree = _tree(pattern)
        _plans[key] = lay_out(tree, choose_thresholds(tree, blocks, groups, planes, shared), blocks, planes)
    return _plans[key]


@lru_cache(4)
def _tree(pattern: FactorPattern) -> Tree:
    return tree_of(pattern)


def lay_out(tree: Tree, thresholds: tuple[int, ...], blocks: int, planes: int = 1) -> Plan:
    """Makes the plan for given thresholds (partition.partition)."""
    cut = partition(tree, thresholds)
    parts, column, contributions = _packed(tree, cut)
    size = len(column)
    position = np.empty(tree.pattern.size, np.int64)  # packed, of each column of L
    position[column[column >= 0]] = np.flatnonzero(column >= 0)
    boundary = _boundaries(tree, cut, parts, position, size)
    slot_start, slots = _slots(parts, boundary, size)
    work = _partition_work(cut, parts, blocks, planes, _depth(parts, slot_start))
    return Plan(
        boundary=boundary, slot_start=slot_start, slots=slots, place=_places(tree.pattern, position), column=column,
        part=cut.part.astype(np.int32), parts=parts, size=size, phases=2 * cut.groups - 1,
        blocks=blocks, groups=cut.groups, planes=planes, contributions=contributions, **work,
    )  # fmt: skip


def _packed(tree: Tree, cut: Partition) -> tuple[Parts, Int32, int]:
    """Returns the parts, the column of L at each packed position, and the number of contributions."""
    span, edge, out = padded(cut.v, COLUMNS), padded(cut.b, COLUMNS), padded(cut.b, ROWS)
    start = np.cumsum(span) - span
    of = np.repeat(cut.part, tree.width)  # part of each column
    order = np.argsort(of, kind="stable")  # columns by part, ascending in each
    within = np.arange(len(of)) - np.repeat(np.cumsum(cut.v) - cut.v, cut.v)
    column = np.full(int(span.sum()), -1, np.int32)
    column[np.repeat(start, cut.v) + within] = order
    fields = (cut.group, start, cut.v, cut.b, np.cumsum(edge) - edge, np.cumsum(out) - out)
    return Parts(*(np.asarray(f, np.int32) for f in fields)), column, int(out.sum())


def _places(pattern: FactorPattern, position: Int64) -> Int32:
    place = np.empty(pattern.size // NODE, np.int32)
    place[pattern.permutation[::NODE] // NODE] = position[::NODE]
    return place


def ranges(first: Int64, count: Int64) -> Int64:
    """Concatenates the ranges [first[i], first[i] + count[i])."""
    return np.repeat(first - np.cumsum(count) + count, count) + np.arange(int(count.sum()))


def _boundaries(tree: Tree, cut: Partition, parts: Parts, position: Int64, size: int) -> Int32:
    rows = ranges(tree.pattern.row_start[cut.root] + tree.width[cut.root], cut.b)
    boundary = np.full(int(padded(cut.b, COLUMNS).sum()), size, np.int32)
    boundary[ranges(parts.boundary.astype(np.int64), cut.b)] = position[tree.pattern.rows[rows]]
    return boundary


def _slots(parts: Parts, boundary: Int32, size: int) -> tuple[Int32, Int32]:
    b = parts.b.astype(np.int64)
    target = boundary[ranges(parts.boundary.astype(np.int64), b)]
    source = ranges(parts.out.astype(np.int64), b)
    order = np.argsort(target, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(target, minlength=size))])
    return start.astype(np.int32), source[order].astype(np.int32)


def _depth(parts: Parts, slot_start: Int32) -> Int64:
    """Returns the largest number of contributions to an entry of each part, (parts,)."""
    order = np.argsort(parts.start, kind="stable")
    depth = np.zeros(len(order), np.int64)
    depth[order] = np.maximum.reduceat(np.append(np.diff(slot_start), 0), parts.start[order])
    return depth


def _partition_work(cut: Partition, parts: Parts, blocks: int, planes: int, depth: Int64) -> dict[str, Any]:
    """Returns segments and tiles of all phases, and the first chunk of each block."""
    segments, tiles, keys, areas = [], [], [], [0]
    for phase, (which, work) in enumerate(phase_work(cut, planes)):
        pieces = balance(work, blocks)
        found = _Phase(phase, cut.groups, parts, which, pieces, depth)
        segments.append(found.segments())
        tiles.append(found.tiles())
        keys.append((phase * blocks + segments[-1][:, 0], phase * blocks + tiles[-1][:, 0]))
        areas.append(found.area)
    segment, tile = np.concatenate(segments), np.concatenate(tiles)
    storage = np.argsort(tile[:, 0], kind="stable")  # by block, phase, tile
    length = tile[storage, 3] * planes
    tile[storage, 1] = np.cumsum(length) - length
    per_block = np.bincount(tile[:, 0], tile[:, 3] * planes, blocks).astype(np.int64)
    total = (2 * cut.groups - 1) * blocks
    return {
        "segments": np.ascontiguousarray(segment[:, 1:], np.int32),
        "tiles": np.ascontiguousarray(tile[:, 1:], np.int32),
        "segment_start": _starts(np.concatenate([k[0] for k in keys]), total),
        "tile_start": _starts(np.concatenate([k[1] for k in keys]), total),
        "chunk_start": np.concatenate([[0], np.cumsum(per_block)]).astype(np.int32),
        "chunks": int(per_block.sum()),
        "x_area": int(max(areas)),
    }


def _starts(keys: Int64, count: int) -> Int32:
    return np.concatenate([[0], np.cumsum(np.bincount(keys, minlength=count))]).astype(np.int32)


class _Phase:
    """Segments and tiles of one phase; the first column is their block."""

    def __init__(self, phase: int, groups: int, parts: Parts, which: Int64, pieces: TilePartition, depth: Int64):
        self.forward, self.backward = phase < groups - 1, phase >= groups
        self.pieces = pieces
        part = which[pieces.matrix]
        self.start, self.boundary = parts.start[part].astype(np.int64), parts.boundary[part].astype(np.int64)
        self.out = (parts.out if self.forward else parts.start)[part].astype(np.int64)
        self.inside = padded(parts.v[part].astype(np.int64), COLUMNS)
        self.outside = padded(parts.b[part].astype(np.int64), COLUMNS) * self.backward
        length = self.inside + self.outside
        total, opens = np.cumsum(length) - length, np.searchsorted(pieces.block, pieces.block)
        self.x = total - total[opens]
        self.area = int((self.x + length).max(initial=0))
        trips = -(-self.inside // TRIP_ENTRIES) * -(-depth[part] // TRIP_SLOTS)
        self.shared_forming = (trips > TRIPS) & (phase > 0) & (not self.backward)

    def segments(self) -> Int64:
        """Returns the segments, (k, 5): block, kind, from, count, to."""
        if self.backward:
            own, edge = np.full(len(self.x), READ), np.full(len(self.x), GATHER)
            found = np.stack([self._segments(own, 0 * self.x, self.inside), self._edges(edge)], axis=1).reshape(-1, 5)
            return found[found[:, 3] > 0]
        kind = np.full(len(self.x), FORM)
        if self.forward:
            kind[(self.pieces.first == 0) & ~self.shared_forming] |= WRITE
        low, high = 0 * self.x, self.inside.copy()
        low[self.shared_forming], high[self.shared_forming] = self._slices()
        kind[self.shared_forming & (high > low)] |= WRITE
        formed = self._segments(kind, low, high)
        read = np.full(len(self.x), READ)
        below, above = self._segments(read, 0 * low, low), self._segments(read, high, self.inside)
        found = np.concatenate([formed, below, above])
        found = found[found[:, 3] > 0]
        return found[np.argsort(found[:, 0], kind="stable")]  # by block, what is formed first

    def _segments(self, kind: Int64, low: Int64, high: Int64) -> Int64:
        """Returns segments of the entries [low, high) of the part of each piece."""
        return np.stack([self.pieces.block, kind, self.start + low, high - low, self.x + low], axis=1)

    def _edges(self, kind: Int64) -> Int64:
        return np.stack([self.pieces.block, kind, self.boundary, self.outside, self.x + self.inside], axis=1)

    def _slices(self) -> tuple[Int64, Int64]:
        """Returns the range of entries of its part that each block forms for the others, in multiples of 32."""
        matrix, groups = self.pieces.matrix[self.shared_forming], self.inside[self.shared_forming] // COLUMNS
        order = np.argsort(matrix, kind="stable")
        count = np.bincount(matrix)
        first = np.cumsum(count) - count
        k = np.empty(len(matrix), np.int64)
        k[order] = np.arange(len(matrix)) - first[matrix[order]]
        of = count[matrix]
        return COLUMNS * (k * groups // of), COLUMNS * ((k + 1) * groups // of)

    def tiles(self) -> Int64:
        """Returns the tiles, (m, 5): block, 0 (set later to the chunk), x, chunks, out."""
        count = self.pieces.tiles
        tile = ranges(self.pieces.first, count)
        found = np.zeros((len(tile), 5), np.int64)
        found[:, 0] = np.repeat(self.pieces.block, count)
        found[:, 2] = np.repeat(self.x, count)
        found[:, 3] = np.repeat((self.inside + self.outside) // COLUMNS, count)
        found[:, 4] = np.repeat(self.out, count) + ROWS * tile
        return found
