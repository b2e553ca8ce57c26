# SPDX-License-Identifier: MIT
"""The partitioned inverse in NumPy: matrices of a plan from L, and their application as the GPU does it.

`stored` fills the chunks of a plan from dense blocks in float64; `apply` knows only what the kernel knows: segments,
tiles and the chunks, block by block.
"""

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

from protocol.factor import FactorPattern
from sim_server.backends.gpu.inverse.expansion_batches import EDGE, BuildBatch, WorkspaceLayout
from sim_server.backends.gpu.inverse.plan import FORM, GATHER, READ, WRITE, Plan
from tests.reference.supernodal import lower

Reals = NDArray[np.float64]
ROWS, COLUMNS = 8, 32
STEP = 2048.0  # between a float16 number and what the second plane adds to it


def matrices(pattern: FactorPattern, values: NDArray, plan: Plan) -> tuple[list[tuple[Reals, Reals]], Reals]:
    """(S~, W~) of every part, (v, v) and (v, b), and the scale in packed order, (N + 1,)."""
    low = lower(pattern, np.asarray(values, np.float64))
    scale, found = np.zeros(plan.size + 1), []
    halves = []
    for start, v, b, edge in zip(plan.parts.start, plan.parts.v, plan.parts.b, plan.parts.boundary, strict=True):
        inside = plan.column[start : start + v]
        outside = plan.column[plan.boundary[edge : edge + b]]
        half, failed = dtrtri(low[np.ix_(inside, inside)], lower=1)
        assert not failed
        halves.append((half, low[np.ix_(outside, inside)] @ half))
        scale[start : start + v] = np.sqrt((half**2).sum(axis=0))
    scale[-1] = scale.max()
    for p, (half, below) in enumerate(halves):
        start, v = plan.parts.start[p], plan.parts.v[p]
        edge, b = plan.parts.boundary[p], plan.parts.b[p]
        d = scale[start : start + v]
        found.append(((half.T @ half) / np.outer(d, d), below.T / d[:, None] * scale[plan.boundary[edge : edge + b]]))
    return found, scale


def stored(pattern: FactorPattern, values: NDArray, plan: Plan, dtype: type = np.float64) -> tuple[NDArray, Reals]:
    """Chunks (chunks, 8, 32) in float64 (exact) or float16, and the scale (N + 1,). NaN where nothing belongs."""
    made, scale = matrices(pattern, values, plan)
    chunks = np.full((plan.chunks, ROWS, COLUMNS), np.nan, dtype)
    v_of, b_of = plan.parts.v, plan.parts.b
    for phase in range(plan.phases):
        forward, backward = phase < plan.groups - 1, phase >= plan.groups
        starts = (plan.parts.out if forward else plan.parts.start).tolist()
        group = min(phase, plan.phases - 1 - phase)
        members = np.flatnonzero((plan.parts.group == group) & (b_of > 0 if forward else v_of > 0)).tolist()
        members.sort(key=lambda p: starts[p])
        begins, wide = [starts[p] for p in members], {}
        for chunk, _, count, out in _tiles(plan, phase).tolist():
            p = members[bisect_right(begins, out) - 1]
            if p not in wide:
                inverse, coupling = made[p]
                whole = coupling.T if forward else inverse
                wide[p] = np.hstack([_padded(m) for m in ([whole] if not backward else [whole, -coupling])])
            row = out - starts[p]
            tile = wide[p][row : row + ROWS]
            assert tile.shape == (ROWS, COLUMNS * count)
            planes = tile.reshape(ROWS, count, COLUMNS).transpose(1, 0, 2)
            chunks[chunk : chunk + count] = planes
            if plan.planes == 2:
                rest = planes - chunks[chunk : chunk + count].astype(float)
                chunks[chunk + count : chunk + 2 * count] = rest * STEP
    return chunks, scale


def _padded(matrix: Reals) -> Reals:
    rows, columns = matrix.shape
    return np.pad(matrix, ((0, -rows % ROWS), (0, -columns % COLUMNS)))


def _tiles(plan: Plan, phase: int, block: int | None = None) -> NDArray:
    first, last = (phase, phase + 1) if block is None else (0, 0)
    if block is None:
        return plan.tiles[plan.tile_start[first * plan.blocks] : plan.tile_start[last * plan.blocks]]
    at = phase * plan.blocks + block
    return plan.tiles[plan.tile_start[at] : plan.tile_start[at + 1]]


class Application:
    """Vectors of one application in packed order; NaN where nothing has been written, so that no read goes unseen."""

    def __init__(self, plan: Plan, chunks: NDArray, scale: Reals):
        self.plan, self.chunks, self.scale = plan, chunks.astype(np.float64), scale
        self.writes: list[NDArray] = []  # per phase, how often each position was written

    def __call__(self, r: Reals) -> Reals:
        """z (n,) of the residual r (n,)."""
        plan = self.plan
        at = (plan.place[:, None] + np.arange(3)).ravel()
        self.r = np.zeros(plan.size + COLUMNS)
        self.r[at] = r
        self.formed = np.full(plan.size + COLUMNS, np.nan)
        self.c = np.full(plan.contributions, np.nan)
        self.y = np.full(plan.size + COLUMNS, np.nan)
        self.y[plan.size :] = 0
        for phase in range(plan.phases):
            self._phase(phase)
        return self.scale[:-1][at] * self.y[at]

    def _phase(self, phase: int) -> None:
        plan, forward = self.plan, phase < self.plan.groups - 1
        target = np.full(plan.contributions if forward else plan.size + COLUMNS, np.nan)
        written = np.zeros(len(target), int)
        for block in range(plan.blocks):
            self._form(phase, block)
        for block in range(plan.blocks):
            x = self._area(phase, block)
            for chunk, at, count, out in _tiles(plan, phase, block):
                tile = self.chunks[chunk : chunk + count]
                if plan.planes == 2:
                    tile = tile + self.chunks[chunk + count : chunk + 2 * count] / STEP
                target[out : out + ROWS] = np.einsum("crk,ck->r", tile, x[at : at + COLUMNS * count].reshape(count, -1))
                written[out : out + ROWS] += 1
        mine = self.c if forward else self.y
        mine[written > 0] = target[written > 0]
        self.writes.append(written)

    def _segments(self, phase: int, block: int) -> NDArray:
        at = phase * self.plan.blocks + block
        return self.plan.segments[self.plan.segment_start[at] : self.plan.segment_start[at + 1]]

    def _form(self, phase: int, block: int) -> None:
        """What a block leaves for all, once."""
        for kind, start, count, _ in self._segments(phase, block):
            if kind == FORM | WRITE:
                assert np.isnan(self.formed[start : start + count]).all()
                self.formed[start : start + count] = self._formed(start, count)

    def _area(self, phase: int, block: int) -> Reals:
        x, forming = np.full(self.plan.x_area, np.nan), True
        for kind, start, count, to in self._segments(phase, block):
            if kind & ~WRITE == FORM:
                assert forming, "a block that waits for others before it forms its own could wait for ever"
                x[to : to + count] = self._formed(start, count)
            elif kind == READ:
                x[to : to + count] = self.formed[start : start + count]
            else:
                assert kind == GATHER
                x[to : to + count] = self.y[self.plan.boundary[start : start + count]]
            forming = kind & ~WRITE == FORM
        return x

    def _formed(self, start: int, count: int) -> Reals:
        """The scaled residual less the contributions of parts before, at positions one after another."""
        bounds = self.plan.slot_start[start : start + count + 1]
        contributions, position = np.zeros(count), np.repeat(np.arange(count), np.diff(bounds))
        np.add.at(contributions, position, self.c[self.plan.slots[bounds[0] : bounds[-1]]])
        return self.scale[start : start + count] * self.r[start : start + count] - contributions


def by_tasks(layout: WorkspaceLayout, values: NDArray, plan: Plan) -> tuple[NDArray, Reals]:
    """Chunks in float64 and scale as build_inverse.cu makes them, task by task. NaN where nobody writes."""
    chunks, scale = np.full((plan.chunks, ROWS, COLUMNS), np.nan), np.zeros(plan.size + 1)
    for batch in layout.batches:
        memory = np.full(layout.size // 4, np.nan)
        memory[: batch.cleared // 4] = 0
        for column in layout.columns[batch.first : batch.last]:
            part = layout.parts[column["part"]]
            to = layout.place[column["row"] : column["row"] + column["length"]]
            at = part["g"] + int(column["within"]) * int(part["pitch_g"]) + to
            memory[at] = values[column["value"] : column["value"] + column["length"]]
        _inverted(layout, batch, memory)
        for p, i, _, _ in batch.diagonal:
            part = layout.parts[p]
            inside = slice(i * EDGE, min((i + 1) * EDGE, part["v"]))
            lengths = np.sqrt((np.tril(_whole(part, memory)[:, : part["pitch_t"]])[:, inside] ** 2).sum(axis=0))
            scale[part["start"] + inside.start : part["start"] + inside.stop] = lengths
        _finished(layout, batch, memory, plan, scale, chunks)
    scale[-1] = scale.max()
    return chunks, scale


def _whole(part: NDArray, memory: Reals) -> Reals:
    v, pitch = int(part["pitch_t"]), int(part["pitch_g"])
    return memory[part["g"] : part["g"] + v * pitch].reshape(v, pitch)


def _tile(i: int) -> slice:
    return slice(i * EDGE, (i + 1) * EDGE)


def _inverted(layout: WorkspaceLayout, batch: BuildBatch, memory: Reals) -> None:
    for p, i, _, _ in batch.diagonal:
        part = layout.parts[p]
        block, real = _whole(part, memory)[_tile(i), _tile(i)], min(EDGE, int(part["v"]) - i * EDGE)
        block[:real, :real] = np.linalg.inv(block[:real, :real].T)
    for level in batch.merges:
        products = []
        for p, i, j, end in level:
            part, g = layout.parts[p], _whole(layout.parts[p], memory)
            v, depth = int(part["pitch_t"]), slice(j * EDGE, end * EDGE)
            t = memory[part["t"] : part["t"] + v * v].reshape(v, v)
            t[_tile(i), _tile(j)] = g[depth, _tile(i)].T @ g[depth, _tile(j)]
            products.append((g, t, i, j, slice(end * EDGE, (i + 1) * EDGE)))
        for g, t, i, j, depth in products:
            g[_tile(i), _tile(j)] = -g[_tile(i), depth] @ t[depth, _tile(j)]


def _finished(
    layout: WorkspaceLayout, batch: BuildBatch, memory: Reals, plan: Plan, scale: Reals, chunks: NDArray
) -> None:
    for p, i, j, _ in batch.finish:
        part, g = layout.parts[p], _whole(layout.parts[p], memory)
        v, b, start, inside = int(part["v"]), int(part["b"]), int(part["start"]), int(part["pitch_t"])
        tile = g[i * EDGE :, _tile(i)].T @ g[i * EDGE :, _tile(j)]
        rows, edge = np.arange(v)[_tile(i)], j * EDGE - inside
        own, wide, high = layout.row_chunk[start // ROWS :], -(-v // COLUMNS) * COLUMNS, -(-v // ROWS) * ROWS
        d = scale[start + rows]
        if edge < 0:
            columns = np.arange(v)[_tile(j)]
            tile = tile[: len(rows), : len(columns)] / np.outer(d, scale[start + columns])
            _put(chunks, own, tile, i * EDGE, j * EDGE, high, wide)
            _put(chunks, own, tile.T, j * EDGE, i * EDGE, high, wide)
        else:
            at = int(part["boundary"]) + np.arange(b)[edge : edge + EDGE]
            tile = tile[: len(rows), : len(at)] / d[:, None] * scale[plan.boundary[at]]
            _put(chunks, own, -tile, i * EDGE, wide + edge, high, wide + -(-b // COLUMNS) * COLUMNS)
            out = layout.out_chunk[int(part["out"]) // ROWS :]
            _put(chunks, out, tile.T, edge, i * EDGE, -(-b // ROWS) * ROWS, wide)


def _put(chunks: NDArray, home: NDArray, tile: Reals, row: int, column: int, rows: int, columns: int) -> None:
    """A tile at (row, column) of a padded matrix of rows x columns, zeros around it."""
    full = np.zeros((min(EDGE, rows - row), min(EDGE, columns - column)))
    full[: tile.shape[0], : tile.shape[1]] = tile
    for r in range(0, full.shape[0], ROWS):
        for c in range(0, full.shape[1], COLUMNS):
            chunks[home[(row + r) // ROWS] + (column + c) // COLUMNS] = full[r : r + ROWS, c : c + COLUMNS]
