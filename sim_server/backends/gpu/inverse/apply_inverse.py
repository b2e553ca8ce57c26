# SPDX-License-Identifier: MIT
"""Applies a partitioned inverse once, beside the steps, to check it before it is used (apply_inverse.cu)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import Event, KernelFunction, Stream
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.inverse.partition import COLUMNS, ROWS, padded
from sim_server.backends.gpu.inverse.plan import Plan
from sim_server.backends.gpu.pinned import pinned_array

APPLICATION = Declarations("backends/gpu/inverse/apply_inverse.cu")
TILE = APPLICATION.dtype("Tile")
WARPS, BLOCKS = 8, 4  # of a thread block; thread blocks on a multiprocessor
KERNELS = ("form", "product", "scale_back")


def application_kernels(gpu: Gpu) -> dict[str, KernelFunction]:
    """Returns the kernels of apply_inverse.cu by name, compiled. Raises CompileError."""
    module = gpu.module("backends/gpu/inverse/apply_inverse.cu")
    return {name: module.function(name) for name in KERNELS}


class Applied(NamedTuple):
    """z = P^-1 r on its way to the host. z: in packed order, complete after `event`. place: of each entry of r in it"""

    z: NDArray[np.float32]
    event: Event
    place: NDArray[np.int64]

    def result(self) -> Float64:
        """Returns z (n,), once it is there."""
        self.event.synchronize()
        return self.z[self.place].astype(np.float64)


def phase_tiles(plan: Plan) -> list[NDArray[np.void]]:
    """Returns the tiles of each phase, as apply_inverse.cu reads them."""
    parts, made = plan.parts, []
    for phase in range(plan.phases):
        forward, backward = phase < plan.groups - 1, phase >= plan.groups
        first, last = (plan.tile_start[k * plan.blocks] for k in (phase, phase + 1))
        chunk, _, chunks, out = plan.tiles[first:last].T
        members = np.flatnonzero(parts.group == min(phase, plan.phases - 1 - phase))
        members = members[(parts.b if forward else parts.v)[members] > 0]
        starts = (parts.out if forward else parts.start)[members]
        order = np.argsort(starts)
        part = members[order[np.searchsorted(starts[order], out, side="right") - 1]]
        found = np.zeros(last - first, TILE)
        found["chunk"], found["chunks"], found["out"] = chunk, chunks, out
        found["inside"] = padded(parts.v[part], COLUMNS) // COLUMNS
        found["start"], found["boundary"] = parts.start[part], parts.boundary[part]
        assert (chunks == found["inside"] + backward * (padded(parts.b[part], COLUMNS) // COLUMNS)).all()
        made.append(found)
    return made


class InverseApplication:
    """Applies the inverses of one plan, one after another on one stream."""

    def __init__(self, gpu: Gpu, plan: Plan):
        cp, self._gpu, self._plan = gpu.cp, gpu, plan
        self._tiles = [cp.asarray(tiles.view(np.uint8)) for tiles in phase_tiles(plan)]
        self._counts = [len(tiles) // TILE.itemsize for tiles in self._tiles]
        arrays = {"boundary": plan.boundary, "slot_start": plan.slot_start, "slots": plan.slots}
        self._tables = {name: cp.asarray(np.append(a, 0).astype(np.int32)) for name, a in arrays.items()}
        length = plan.size + COLUMNS  # a part's columns are padded
        self._r, self._s, self._y, self._z = (cp.zeros(length, np.float32) for _ in range(4))
        self._contributed = cp.zeros(plan.contributions + ROWS, np.float32)
        self._functions = application_kernels(gpu)
        self._place = (plan.place[:, None].astype(np.int64) + np.arange(3)).ravel()
        self._sent = pinned_array(cp, length, np.dtype(np.float32))
        self._sent[:] = 0
        cp.cuda.get_current_stream().synchronize()

    def begin(self, matrix: int, scale: int, r: Float64, stream: Stream, multiprocessors: int) -> Applied:
        """Begins to apply an inverse that the stream has made before, to r (n,), the same in all calls.

        matrix, scale: addresses of its storage
        """
        cp, n, plan = self._gpu.cp, self._plan.size, self._plan
        self._sent[self._place] = r
        z = self._received = pinned_array(cp, n, np.dtype(np.float32))  # kept: nobody may wait for the copy to it
        copy, kinds = cp.cuda.runtime.memcpyAsync, cp.cuda.runtime
        most = BLOCKS * multiprocessors
        with stream:
            copy(self._r.data.ptr, self._sent.ctypes.data, self._sent.nbytes, kinds.memcpyHostToDevice, stream.ptr)
            for vector in (self._contributed, self._y):
                cp.cuda.runtime.memsetAsync(vector.data.ptr, 0, vector.nbytes, stream.ptr)
            for phase, (tiles, count) in enumerate(zip(self._tiles, self._counts, strict=True)):
                if phase < plan.groups:
                    self._launch(
                        "form", n, most, np.int32(n), np.uint64(scale), self._r, self._tables["slot_start"],
                        self._tables["slots"], self._contributed, self._s,
                    )  # fmt: skip
                to = self._contributed if phase < plan.groups - 1 else self._y
                self._launch(
                    "product", 32 * count, most, tiles, np.int32(count), np.uint64(matrix), np.int32(plan.planes),
                    self._s, self._tables["boundary"], self._y, to,
                )  # fmt: skip
            self._launch("scale_back", n, most, np.int32(n), np.uint64(scale), self._y, self._z)
            copy(z.ctypes.data, self._z.data.ptr, z.nbytes, kinds.memcpyDeviceToHost, stream.ptr)
            return Applied(z, stream.record(), self._place)

    def _launch(self, name: str, threads: int, most: int, *arguments: object) -> None:
        if threads:
            blocks = min(-(-threads // (32 * WARPS)), most)
            self._functions[name]((blocks,), (32 * WARPS,), arguments)
