# SPDX-License-Identifier: MIT
"""Pattern and values of a sparse Cholesky factor L, supernode by supernode."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from protocol.messages_pb2 import FactorPattern as PatternMessage
from protocol.messages_pb2 import Header
from protocol.refused import Refused
from protocol.validate import all_finite, array, check_range, checksum

__all__ = ["Factor", "FactorPattern", "Refused", "check_values", "pattern_id"]

ROOM_ALIGNMENT = 64  # bytes to which the room of a factor in the slot of a batch is rounded up
MOST_VALUES = (1 << 31) - 1  # of a factor, 8 GiB in float32: what a pattern may make its receiver prepare for

Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]


def pattern_id(permutation: Int32, super_start: Int32, row_start: Int64, rows: Int32) -> int:
    """Returns xxh3_64 of the four arrays in this order."""
    digest = xxhash.xxh3_64()
    for values in (permutation, super_start, row_start, rows):
        digest.update(np.ascontiguousarray(values).tobytes())
    return int(digest.intdigest())


@dataclass(frozen=True, eq=False)
class FactorPattern:
    """The pattern of L. Values are stored column by column, each from its diagonal down.

    permutation (n,): row i of L is degree of freedom permutation[i].
    super_start (s + 1,): first column of each supernode.
    row_start (s + 1,): start of its row list in rows; its own columns first, then the rows below, ascending.
    Column k of the supernode with columns c0..c1 and row list R has the entries of rows R[k - c0:].
    """

    id: int
    permutation: Int32
    super_start: Int32
    row_start: Int64
    rows: Int32

    @classmethod
    def build(cls, permutation: Any, super_start: Any, row_start: Any, rows: Any) -> "FactorPattern":
        """Makes a pattern of arrays of any integer type, computes its id and checks it."""
        p, s = np.ascontiguousarray(permutation, np.int32), np.ascontiguousarray(super_start, np.int32)
        r, w = np.ascontiguousarray(row_start, np.int64), np.ascontiguousarray(rows, np.int32)
        pattern = cls(pattern_id(p, s, r, w), p, s, r, w)
        pattern.check()
        return pattern

    @property
    def size(self) -> int:
        """Number of degrees of freedom."""
        return len(self.permutation)

    @cached_property
    def nonzeros(self) -> int:
        """Number of stored values."""
        width, height = np.diff(self.super_start).astype(np.int64), np.diff(self.row_start)
        return int((width * height - width * (width - 1) // 2).sum())

    @cached_property
    def value_start(self) -> Int64:
        """Index of the first value of each supernode among the values, (s,)."""
        width, height = np.diff(self.super_start).astype(np.int64), np.diff(self.row_start)
        sizes = width * height - width * (width - 1) // 2
        return np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)

    @cached_property
    def diagonal(self) -> Int64:
        """Index of the diagonal value of each column among the values, (n,)."""
        width = np.diff(self.super_start).astype(np.int64)
        within = np.arange(self.size) - np.repeat(self.super_start[:-1].astype(np.int64), width)
        length = np.repeat(np.diff(self.row_start), width) - within  # entries of each column
        return np.concatenate(([0], np.cumsum(length)[:-1]))

    def check(self) -> None:
        """Raises Refused unless every index is in range and ordered: native code indexes with these arrays."""
        self._check_types()
        _check_starts(self.super_start, self.size, "super_start", "size")
        _check_starts(self.row_start, len(self.rows), "row_start", "number of rows")
        check_range(self.permutation, 0, self.size, "FactorPattern.permutation")
        if not np.bincount(self.permutation, minlength=self.size).all():
            raise Refused("FactorPattern.permutation names a degree of freedom twice; allowed: once each", "pattern")
        check_range(self.rows, 0, self.size, "FactorPattern.rows")
        self._check_supernodes()
        if self.id != pattern_id(self.permutation, self.super_start, self.row_start, self.rows):
            raise Refused(f"FactorPattern.id is {self.id:016x}, not the checksum of its arrays", "checksum")

    def _check_types(self) -> None:
        wanted = {"permutation": np.int32, "super_start": np.int32, "row_start": np.int64, "rows": np.int32}
        for name, dtype in wanted.items():
            values = getattr(self, name)
            if not isinstance(values, np.ndarray) or values.dtype != dtype or values.ndim != 1:
                raise Refused(f"FactorPattern.{name} is not a vector of {np.dtype(dtype).name}", "shape")
            if not values.flags.c_contiguous:
                raise Refused(f"FactorPattern.{name} is not contiguous", "shape")
        if self.size < 1:
            raise Refused("FactorPattern.size is 0; allowed: at least 1", "shape")
        if len(self.super_start) != len(self.row_start):
            raise Refused(
                f"FactorPattern.super_start has {len(self.super_start)} entries, row_start {len(self.row_start)}; "
                "allowed: supernodes + 1 each",
                "shape",
            )

    def _check_supernodes(self) -> None:
        width, height = np.diff(self.super_start), np.diff(self.row_start)
        if (height < width).any():
            raise Refused("FactorPattern.rows: a supernode has fewer rows than columns", "pattern")
        shift = self.row_start[:-1] - self.super_start[:-1]
        columns = np.arange(self.size)
        if not np.array_equal(self.rows[np.repeat(shift, width) + columns], columns):
            raise Refused("FactorPattern.rows: a row list does not begin with its supernode's columns", "pattern")
        ascends = np.diff(self.rows) > 0
        ascends[self.row_start[1:-1] - 1] = True  # not checked from one supernode to the next
        if not ascends.all():
            raise Refused("FactorPattern.rows: a row list does not ascend strictly", "pattern")

    def message(self, header: Header) -> PatternMessage:
        """Returns the pattern as a message."""
        return PatternMessage(
            header=header,
            id=self.id,
            size=self.size,
            supernodes=len(self.super_start) - 1,
            nonzeros=self.nonzeros,
            permutation=self.permutation.tobytes(),
            super_start=self.super_start.tobytes(),
            row_start=self.row_start.tobytes(),
            rows=self.rows.tobytes(),
        )

    @classmethod
    def from_message(cls, message: PatternMessage) -> "FactorPattern":
        """Checks an untrusted message and returns its pattern; raises Refused."""
        n, s = message.size, message.supernodes
        pattern = cls(
            message.id,
            array(message.permutation, np.int32, (n,), "FactorPattern.permutation"),
            array(message.super_start, np.int32, (s + 1,), "FactorPattern.super_start"),
            array(message.row_start, np.int64, (s + 1,), "FactorPattern.row_start"),
            array(message.rows, np.int32, (-1,), "FactorPattern.rows"),
        )
        pattern.check()
        if message.nonzeros != pattern.nonzeros:
            raise Refused(f"FactorPattern.nonzeros is {message.nonzeros}; allowed: {pattern.nonzeros}", "pattern")
        if pattern.nonzeros > MOST_VALUES:
            raise Refused(f"FactorPattern.nonzeros is {pattern.nonzeros}; allowed: at most {MOST_VALUES}", "size")
        return pattern


def _check_starts(starts: NDArray[Any], end: int, name: str, what: str) -> None:
    if len(starts) < 2 or starts[0] != 0 or starts[-1] != end or (starts[1:] <= starts[:-1]).any():
        raise Refused(f"FactorPattern.{name} does not ascend strictly from 0 to the {what}, {end}", "pattern")


@dataclass(frozen=True, eq=False)
class Factor:
    """L of one object at one step. values (pattern.nonzeros,) float32 or float64; seconds: what it took to make;
    remedy: what was done to a matrix that was not positive definite, in a few words; ahead, later, method: as in
    FactorUse."""

    object: str
    epoch: int
    step: int
    warp: bool
    pattern: FactorPattern
    values: NDArray[Any]
    worker: str
    seconds: float
    remedy: str = ""
    ahead: float = 0.0
    later: bool = False
    method: str = ""

    def checksum(self) -> int:
        """Returns xxh3_64 of the values."""
        told = getattr(self.values, "checksum", None)  # of values on a device
        return int(checksum(self.values) if told is None else told())


def check_values(
    values: NDArray[Any], pattern: FactorPattern, expected: int | None, seen: tuple[int, bool] | None = None,
    positive: bool | None = None,
) -> None:  # fmt: skip
    """Raises Refused unless values are a factor of this pattern with this checksum: finite, diagonal positive.

    seen: checksum of the values and whether all are finite, where that is known already (validate.copied)
    positive: whether the diagonal is, where that is known already
    """
    if values.shape != (pattern.nonzeros,) or values.dtype not in (np.float32, np.float64):
        raise Refused(
            f"Factor values are {values.dtype.name} of shape {values.shape}; allowed: float32 or float64 of shape "
            f"({pattern.nonzeros},)",
            "shape",
        )
    if expected is not None and (checksum(values) if seen is None else seen[0]) != expected:
        raise Refused("Factor.checksum does not match the values", "checksum")
    if not (all_finite(values) if seen is None else seen[1]):
        raise Refused("Factor values hold NaN or infinite numbers; allowed: finite", "not_finite")
    if not ((values[pattern.diagonal] > 0).all() if positive is None else positive):
        raise Refused("Factor values: a diagonal entry of L is not positive", "not_positive")
