# SPDX-License-Identifier: MIT
"""Factors in memory that native code can apply, and the mailbox by which the loop of a CPU takes them up."""

import ctypes as c
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.cpu import structs
from sim_server.backends.cpu.library import loop_library

SHARED_SIZE = 600  # degrees of freedom from which on the solves of a factor are shared out between threads
KEPT = 16 << 20  # bytes of a factor above which its values are kept instead of copied


class NativePattern:
    """The pattern of a factor as native code reads it. threads: shares the solves out between so many, if it can and
    that pays; 0: not at all. Of one body: its solves work in memory that belongs to the pattern."""

    def __init__(self, pattern: FactorPattern, threads: int = 0):
        self.pattern = pattern
        self.native = structs.Pattern(
            size=pattern.size, supernodes=len(pattern.super_start) - 1, permutation=pattern.permutation.ctypes.data,
            super_start=pattern.super_start.ctypes.data, row_start=pattern.row_start.ctypes.data,
            rows=pattern.rows.ctypes.data, value_start=pattern.value_start.ctypes.data,
        )  # fmt: skip
        if threads and pattern.size >= SHARED_SIZE:
            library = loop_library()
            self.native.plan = library.wf_plan(c.byref(self.native), threads)
            weakref.finalize(self, library.wf_delete_plan, self.native.plan)

    @property
    def is_shared(self) -> bool:
        """True if threads share its solves."""
        return bool(self.native.plan)


class NativeFactor:
    """A factor in memory that native code can apply: to the given values, which are not copied."""

    def __init__(self, pattern: FactorPattern | NativePattern, values: NDArray[Any], step: int = -1):
        self._pattern = pattern if isinstance(pattern, NativePattern) else NativePattern(pattern)
        self.pattern = self._pattern.pattern
        self.values, self._taken = values, False
        self.native = structs.Factor(
            pattern=c.addressof(self._pattern.native), values=values.ctypes.data, step=step, bytes=values.itemsize
        )

    @classmethod
    def empty(cls, pattern: FactorPattern | NativePattern, dtype: np.dtype | type) -> "NativeFactor":
        """Room for a factor, to be filled."""
        full = pattern.pattern if isinstance(pattern, NativePattern) else pattern
        return cls(pattern, np.zeros(full.nonzeros, dtype))

    @property
    def address(self) -> int:
        """Address of the native struct, which a mailbox takes."""
        return c.addressof(self.native)

    def fill(self, values: NDArray[Any], step: int) -> None:
        """Takes the values of L made from the matrix of `step`: copies them, or keeps those of a large factor, which
        would fill the memory once more."""
        if values.nbytes > KEPT or self._taken:  # those that were taken over are not ours to write to
            self.take(values if values.nbytes > KEPT else values.copy(), step)
            return
        self.values[:] = values
        self.native.step = step

    def take(self, values: NDArray[Any], step: int) -> None:
        """Takes over the values, which do not change any more, instead of a copy: that of a large body takes as long as
        many rounds of the service thread."""
        self.values, self._taken = np.ascontiguousarray(values), True
        self.native.values, self.native.step = self.values.ctypes.data, step

    def apply(self, r: Float64, threads: int = 1) -> Float64:
        """P^-1 r, (size,), outside of any step, on so many threads at most. A probe for tests and benchmarks."""
        r = np.ascontiguousarray(r, dtype=np.float64)
        z, work = np.empty_like(r), np.empty(2 * len(r))
        loop_library().wf_apply_factor(c.byref(self.native), r.ctypes.data, z.ctypes.data, work.ctypes.data, threads)
        return z


class FactorMailbox:
    """Factor buffers of a body of a loop, two of them: one in use, the other waiting or to be filled."""

    def __init__(self, body: structs.Body, loop: structs.Loop):
        self._body, self._loop = body, loop
        self.buffers: list[NativeFactor] = []
        self._pattern: NativePattern | None = None  # of the newest buffer
        self._waiting: NativeFactor | None = None  # as posted last
        self._in_use: NativeFactor | None = None  # as far as the mailbox has told

    def post(self, buffer: NativeFactor) -> None:
        """Posts a buffer that `free_buffer` gave; the loop takes it up before its next solve of the body."""
        self._waiting = buffer
        loop_library().wf_post_factor(c.byref(self._body), buffer.address)

    def free_buffer(self, pattern: FactorPattern, dtype: np.dtype[Any]) -> NativeFactor:
        """Returns a buffer that the loop does not use. A waiting factor is taken back: a newer one comes.

        Which one the loop has follows from what the mailbox gives back. Its own pointer would not do: between taking
        a factor out of the mailbox and noting it there the loop has both.
        """
        taken_back = loop_library().wf_post_factor(c.byref(self._body), None)
        if not taken_back and self._waiting is not None:
            self._in_use = self._waiting
        self._waiting = None
        for i, buffer in enumerate(self.buffers):
            if buffer is self._in_use:
                continue
            if buffer.pattern is not pattern or buffer.values.dtype != dtype:
                self.buffers[i] = NativeFactor.empty(self._native(pattern), dtype)
            return self.buffers[i]
        self.buffers.append(NativeFactor.empty(self._native(pattern), dtype))
        return self.buffers[-1]

    def bytes_read(self) -> int:
        """Returns the bytes of values and rows that one application of the newest factor reads; 0 without one."""
        newest = self._waiting or self._in_use
        return newest.values.nbytes + newest.pattern.rows.nbytes if newest else 0

    def _native(self, pattern: FactorPattern) -> NativePattern:
        if self._pattern is None or self._pattern.pattern is not pattern:
            self._pattern = NativePattern(pattern, self._loop.threads)
        return self._pattern
