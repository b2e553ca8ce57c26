# SPDX-License-Identifier: MIT
"""From L to what the GPU applies: the dense inverse X = P^T L^-T L^-1 P in float16.

Triangular solves are chains of dependent rows and cost a GPU 100 times what a dense product of the same body does (up
to a few thousand degrees of freedom). X is kept as D S D with D the square root of its diagonal, so that the entries of
S are at most 1 and float16 neither overflows nor loses the stiff regions. Made on a stream of its own beside the steps.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.gpu.device import Gpu

LIMIT = 9000  # degrees of freedom: 160 MB of float16 and two float32 matrices of twice that while it is made


def entries(pattern: FactorPattern) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Row and column of L of each value, (nonzeros,) each."""
    rows, columns = [], []
    for s in range(len(pattern.super_start) - 1):
        c0, c1 = int(pattern.super_start[s]), int(pattern.super_start[s + 1])
        own = pattern.rows[pattern.row_start[s] : pattern.row_start[s + 1]]
        for k in range(c1 - c0):
            rows.append(own[k:])
            columns.append(np.full(len(own) - k, c0 + k, np.int32))
    return np.concatenate(rows).astype(np.int32), np.concatenate(columns)


BUFFERS = 2  # in use, being made


class Expanded(NamedTuple):
    """Device addresses of an inverse and its scale, entries per row, and the event after which they hold."""

    inverse: int
    scale: int
    stride: int
    event: Any


class Expansion:
    """Makes inverses for one pattern, into buffers that are made once. stride: entries per stored row."""

    def __init__(self, gpu: Gpu, pattern: FactorPattern):
        cp, n = gpu.cp, pattern.size
        if n > LIMIT:
            raise ValueError(f"{n} degrees of freedom, beyond {LIMIT}")
        self.gpu, self.pattern = gpu, pattern
        self._given = 0
        self.stride = -(-n // 8) * 8
        self.stream = cp.cuda.Stream(non_blocking=True, priority=0)
        row, column = entries(pattern)
        place = np.empty(n, np.int32)
        place[pattern.permutation] = np.arange(n, dtype=np.int32)
        self._values = np.zeros(pattern.nonzeros, np.float32)
        self._dense, self._inverse = np.zeros((n, n), np.float32), np.zeros((n, n), np.float32)
        self.scales = [np.ones(n, np.float32) for _ in range(BUFFERS)]
        self.stored = [np.zeros((n, self.stride // 2), np.int32) for _ in range(BUFFERS)]
        self._spread = gpu.module("gpu/inverse.cu").bind(
            "spread", pattern.nonzeros, values=self._values, row=row, column=column, size=n, dense=self._dense
        )
        module = gpu.module("gpu/inverse.cu")
        self._scale = [
            module.bind("scale", n, inverse=self._inverse, place=place, scale=scale) for scale in self.scales
        ]
        self._store = [
            module.bind(
                "store", n * self.stride // 2, inverse=self._inverse, place=place, scale=scale, size=n,
                stride=self.stride, stored=stored,
            )
            for stored, scale in zip(self.stored, self.scales, strict=True)
        ]  # fmt: skip
        self._pinned = cp.cuda.alloc_pinned_memory(self._values.nbytes)
        self._staged = np.frombuffer(self._pinned, np.float32, pattern.nonzeros)

    def target(self) -> int:
        """One of the buffers, each once."""
        self._given += 1
        return self._given - 1

    def expand(self, values: NDArray[Any], back: int) -> "Expanded":
        """Starts making the inverse in a buffer."""
        cp = self.gpu.cp
        from cupyx.scipy.linalg import solve_triangular

        self._staged[:] = values
        dense, inverse = self.gpu.twin(self._dense), self.gpu.twin(self._inverse)
        with self.stream:
            self.gpu.twin(self._values).set(self._staged, stream=self.stream)
            self._spread()
            half = solve_triangular(dense, cp.eye(self.pattern.size, dtype=np.float32), lower=True, check_finite=False)
            cp.matmul(half.T, half, out=inverse)
            self._scale[back]()
            self._store[back]()
            event = self.stream.record()
        twin = self.gpu.twin
        return Expanded(twin(self.stored[back]).data.ptr, twin(self.scales[back]).data.ptr, self.stride, event)
