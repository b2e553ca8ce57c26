# SPDX-License-Identifier: MIT
"""Copies of many arrays in one call of native code, with their checksums.

Python's lock is let go once for all of them, not several times for each: with other threads at work, getting it back
takes longer than to copy a small array.
"""

import ctypes as c
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from protocol.shared_memory.located import address
from protocol.validate import ALONE, checksum, copied, helping_threads

SOURCE = Path(__file__).with_name("copies.cpp")
SHARED = ALONE // 2  # bytes from where on threads share the work: a millisecond, of which they take a tenth to start
HASH = c.CFUNCTYPE(c.c_uint64, c.c_char_p, c.c_size_t)
NAMES = ("XXH3_64bits_dispatch", "XXH3_64bits")  # the first one chooses the best instructions of the processor


@cache
def hash_address() -> int | None:
    """Address of xxh3_64 in the library of the package xxhash; None if it does not offer it to others."""
    library, sample = c.CDLL(import_module("xxhash._xxhash").__file__), bytes(range(256)) * 9
    for name in NAMES:
        try:
            address = c.cast(getattr(library, name), c.c_void_p).value
        except AttributeError:
            continue
        if address and HASH(address)(sample, len(sample)) == xxhash.xxh3_64_intdigest(sample):
            return address
    return None


class Parts(NamedTuple):
    """Parts of an array, by columns. array: contiguous; begin (k,): first byte of each part"""

    array: NDArray[Any]
    begin: NDArray[np.int64]

    def addresses(self, size: NDArray[np.int64]) -> NDArray[np.uintp]:
        """Returns the addresses of the parts, of `size` bytes each (k,). Raises ValueError unless all lie inside."""
        if not self.array.flags.c_contiguous or self.begin.shape != size.shape:
            raise ValueError(f"{size.shape} sizes of {self.begin.shape} parts of an array, which must be contiguous")
        most = self.array.nbytes
        inside = (size >= 0) & (size <= most) & (self.begin >= 0) & (self.begin <= most - size)  # no sum may overflow
        if not inside.all():
            raise ValueError(f"parts of an array lie outside of its {most} bytes")
        return (address(self.array) + self.begin).astype(np.uintp)

    def split(self, size: NDArray[np.int64]) -> list[NDArray[np.uint8]]:
        """Returns the bytes of each part. Raises as `addresses`."""
        self.addresses(size)
        flat = self.array.reshape(-1).view(np.uint8)
        return [flat[a:b] for a, b in zip(self.begin.tolist(), (self.begin + size).tolist(), strict=True)]


class Copies:
    """Copies, or only sums up, arrays, each contiguous.

    library: of copies.cpp; None: there is no compiler, and NumPy copies one after another
    """

    def __init__(self, library: c.CDLL | None):
        self._library = library if hash_address() is not None else None
        if self._library is not None:
            i, p = c.c_int32, c.c_void_p
            arguments: list[Any] = [c.c_int64, p, p, p, i, p, p, i]
            self._library.copy_all.restype, self._library.copy_all.argtypes = None, arguments

    def gather(
        self, sources: NDArray[np.int64], size: NDArray[np.int64], target: NDArray[np.uint8]
    ) -> list[int]:  # fmt: skip
        """Copies memory one piece behind the other to the begin of a target. Returns the `checksum` of each copy.
        Raises ValueError if there is no room for them.

        sources, size: addresses of the pieces, which must be there until this returns, and their bytes (k,)
        """
        parts = Parts(target, np.cumsum(size) - size)
        if self._library is None:
            pieces = [_at(*each) for each in zip(sources.tolist(), size.tolist(), strict=True)]
            return [copied(s, t, t)[0] for s, t in zip(pieces, parts.split(size), strict=True)]
        return self._call(sources.astype(np.uintp), parts.addresses(size), size, False)

    def copy_parts(
        self, source: Parts, target: Parts, size: NDArray[np.int64], own_sources: bool = False
    ) -> list[int]:  # fmt: skip
        """Copies parts of an array to parts of another one, of `size` bytes each (k,); returns the `checksum` of each.
        Raises ValueError if a part lies outside of its array.

        own_sources: other processes may write to the targets, so that of the sources is told; else these may be
        written to meanwhile
        """
        begin, to = source.addresses(size), target.addresses(size)
        if self._library is None:
            pairs = zip(source.split(size), target.split(size), strict=True)
            return [copied(s, t, s if own_sources else t)[0] for s, t in pairs]
        return self._call(begin, to, size, own_sources)

    def sum_parts(self, source: Parts, size: NDArray[np.int64]) -> list[int]:
        """Returns the `checksum` of parts of an array, of `size` bytes each (k,). Raises as `copy_parts`."""
        if self._library is None:
            return [checksum(each) for each in source.split(size)]
        return self._call(source.addresses(size), None, size, True)

    def _call(
        self, begin: NDArray[np.uintp], targets: NDArray[np.uintp] | None, size: NDArray[np.int64], own_sources: bool
    ) -> list[int]:  # fmt: skip
        assert self._library is not None
        count, size = len(begin), np.ascontiguousarray(size, np.int64)
        sums = np.empty(count, np.uint64)
        threads = 1 + min(helping_threads(), count - 1) if int(size.sum()) > SHARED else 1
        self._library.copy_all(
            count, begin.ctypes.data, None if targets is None else targets.ctypes.data, size.ctypes.data, own_sources,
            hash_address(), sums.ctypes.data, threads,
        )  # fmt: skip
        return list(sums.tolist())


def _at(address: int, size: int) -> NDArray[np.uint8]:
    """Returns the bytes at an address."""
    return np.ctypeslib.as_array((c.c_uint8 * size).from_address(address))
