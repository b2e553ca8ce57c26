# SPDX-License-Identifier: MIT
"""Memory and launch of the persistent solver (pcg.cu): rows of the bodies in, rows of results out."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.gpu.device import DeviceModule, Gpu
from sim_server.gpu.expand import Expanded, Expansion

THREADS = 512

BODY = np.dtype(
    [
        ("first", "i4"), ("nodes", "i4"), ("block", "i4"), ("blocks", "i4"), ("kind", "i4"), ("max_iterations", "i4"),
        ("warm_start", "i4"), ("probe", "i4"), ("tolerance", "f8"), ("inverse", "u8"), ("factor_step", "i8"),
        ("scale", "u8"), ("stride", "i4"), ("unused", "i4"),
    ]
)  # fmt: skip
SETTINGS = BODY.fields["inverse"][1]  # type: ignore[index]  # bytes of a row before the factor: they change apart
RESULT = np.dtype(
    [
        ("residual", "f8"), ("seconds", "f8"), ("factor_step", "i8"), ("iterations", "i4"), ("status", "i4"),
        ("kind", "i4"), ("asked", "i4"), ("fallbacks", "i4"), ("bad_node", "i4"),
    ]
)  # fmt: skip
_POINTERS = (
    "row_start", "columns", "values", "b", "y", "r", "p", "z", "q", "diagonal", "partial", "arrived", "step", "results",
)  # fmt: skip
SOLVE = np.dtype(
    [
        ("bodies", "u8"),
        ("count", "i4"),
        ("capacity", "i4"),
        *((name, "u8") for name in _POINTERS),
        ("nodes", "i4"),
        ("shared", "i4"),
    ],
    align=True,
)


class Solver:
    """Solves the system of every body in one launch.

    ranges: nodes [first, last) of each body. arrays: host arrays by name (row_start, columns, values, b, y), solved for
    their twins. counter: device array (1,) of completed steps. capacity: steps whose results are kept.

    bodies: host rows (BODY), one per body; whoever runs the loop uploads them, settings (the first SETTINGS bytes) and
    factor (the rest) apart. results: device ring (capacity, bodies) of RESULT. arrived: zero at launch.
    """

    def __init__(
        self, gpu: Gpu, ranges: Sequence[tuple[int, int]], arrays: Mapping[str, NDArray[Any]], counter: Any,
        capacity: int,
    ):  # fmt: skip
        cp, nodes = gpu.cp, len(arrays["x"])
        self.gpu, self._arrays, self._capacity = gpu, arrays, capacity
        self.bodies = np.zeros(len(ranges), BODY)
        self.bodies["first"] = [first for first, _ in ranges]
        self.bodies["nodes"] = [last - first for first, last in ranges]
        self._share_blocks(gpu.properties["multiProcessorCount"])
        self._rows = cp.zeros(self.bodies.nbytes, np.uint8)
        self.results = cp.zeros(capacity * len(ranges) * RESULT.itemsize, np.uint8)
        self.arrived = cp.zeros(len(ranges), np.uint32)
        self._work = {
            "r": cp.zeros(6 * nodes), "p": cp.zeros(6 * nodes), "z": cp.zeros(3 * nodes), "q": cp.zeros(3 * nodes),
            "diagonal": cp.zeros(9 * nodes), "partial": cp.zeros(4 * self._grid * len(ranges)),
            "arrived": self.arrived, "results": self.results, "step": counter,
        }  # fmt: skip
        self._expansions: dict[tuple[int, int], Expansion] = {}
        self._shared = self._shared_memory()
        self._params = self._arguments(nodes)
        self._function = DeviceModule("gpu/pcg.cu", gpu, cooperative=True).function("pcg")
        self._function.max_dynamic_shared_size_bytes = self._shared

    @property
    def bodies_device(self) -> int:
        """Address of the rows that the solver reads."""
        return int(self._rows.data.ptr)

    def launch(self) -> None:
        """Puts a solve onto the current stream."""
        self._function((self._grid,), (THREADS,), (self._params,), shared_mem=self._shared)

    def expansion(self, body: int, pattern: FactorPattern) -> Expansion:
        """What makes factors of this pattern usable for a body. Raises ValueError if nothing does."""
        key = (body, pattern.id)
        if key not in self._expansions:
            self._expansions[key] = Expansion(self.gpu, pattern)
        return self._expansions[key]

    def use(self, body: int, pattern: FactorPattern, expanded: Expanded, step: int) -> None:
        """Writes a factor into the host row of a body; it holds once the row is uploaded."""
        row = self.bodies[body]
        row["inverse"], row["scale"], row["stride"] = expanded.inverse, expanded.scale, expanded.stride
        row["factor_step"] = step

    def factor_bytes(self, body: int) -> int:
        """What an application of the factor of a body's host row reads, 0 without one."""
        row = self.bodies[body]
        return int(row["stride"]) * 6 * int(row["nodes"]) if row["inverse"] else 0

    def _share_blocks(self, processors: int) -> None:
        """Thread blocks by size of body, at least one each; bodies beyond the processors queue."""
        nodes = self.bodies["nodes"].astype(float)
        count = len(nodes)
        self._grid = processors
        if count >= processors:
            self.bodies["block"] = np.arange(count) % processors
            self.bodies["blocks"] = 1
            return
        share = np.maximum(1, np.floor(nodes / nodes.sum() * (processors - count)).astype(int))
        self.bodies["blocks"] = share
        self.bodies["block"] = np.concatenate([[0], np.cumsum(share)[:-1]])

    def _arguments(self, nodes: int) -> NDArray[Any]:
        params = np.zeros((), SOLVE)
        params["bodies"], params["count"], params["capacity"] = self.bodies_device, len(self.bodies), self._capacity
        for name in ("row_start", "columns", "values", "b", "y"):
            params[name] = self.gpu.twin(self._arrays[name]).data.ptr
        for name, array in self._work.items():
            params[name] = array.data.ptr
        params["nodes"], params["shared"] = nodes, self._shared
        return params

    def _shared_memory(self) -> int:
        """Bytes per thread block for the residual and the rows of A of the body that needs most, if they fit."""
        start = self._arrays["row_start"].astype(np.int64)
        most = 0
        for row in self.bodies:
            first, nodes, parts = int(row["first"]), int(row["nodes"]), int(row["blocks"])
            cut = first + nodes * np.arange(parts + 1) // parts
            blocks, rows = int(np.diff(start[cut]).max()), int(np.diff(cut).max())
            most = max(most, 4 * (-(-3 * nodes // 8) * 8) + 76 * blocks + 4 * rows + 32)
        available = int(self.gpu.properties["sharedMemPerBlockOptin"]) - 1024
        return min(most, available)
