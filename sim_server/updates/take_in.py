# SPDX-License-Identifier: MIT
"""Takes the factors of a message in: one call of native code copies them out of shared memory, where others may write
to them, and finds all that is asked about the copies (backends/cpu/native/factor_check.cpp).

Python's lock is let go once for a message: to get it back takes longer than to look at a factor of a small body.
"""

import ctypes as c
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from protocol.shared_memory.copies import Parts, hash_address
from protocol.shared_memory.located import address, rows
from protocol.validate import checksum
from sim_server.arrays import Int64
from sim_server.backends.cpu.factors import NativePattern
from sim_server.backends.factors_together import FactorsTogether
from sim_server.updates.checked_body import ARRIVING, WORK, CheckedBodies, library, sharing_threads

SHARED = 1 << 19  # bytes from where on threads share the work: a millisecond, of which they take a tenth to start


class BegunCheck(NamedTuple):
    """What factors that arrive are checked with.

    bodies: of each factor
    responses: address of the function that finds the largest response (inverse/digits.py); 0: nobody asks for it
    end: takes note of what was found about some of them: (factors, their rows)
    """

    bodies: CheckedBodies
    responses: int
    end: Callable[[FactorsTogether, "TakenIn"], None]


BeginCheck = Callable[[Sequence[str], Sequence[int], Sequence[FactorPattern]], BegunCheck | None]
"""Returns what factors are checked with beside the matrices that were sent: of objects and their epochs, each with its
pattern; None: they are checked later. From any thread."""


class TakenIn(NamedTuple):
    """Factors that were copied.

    values: (nonzeros,) of each
    found: of each, as struct ArrivingFactor, what was found; checks and the response only with a check
    """

    values: list[NDArray[Any]]
    found: NDArray[Any]

    def of(self, chosen: Sequence[int]) -> "TakenIn":
        """Returns some of them."""
        if len(chosen) == len(self.values):
            return self
        return TakenIn([self.values[k] for k in chosen], self.found[list(chosen)])


def take_in(
    source: Parts, patterns: Sequence[FactorPattern], memory: NDArray[Any], check: BegunCheck | None = None,
    matrices: Int64 | None = None,
) -> TakenIn:  # fmt: skip
    """Copies factors out of parts of an array, one behind the other, into memory (n,) of their type. Raises ValueError
    if a part lies outside of its array, or the memory is of another size. From any thread.

    source: may be written to meanwhile; what is returned is about the copies
    matrices: for a check, addresses of the values (blocks, 3, 3) that each was made from
    """
    kinds = dict.fromkeys(patterns)
    nonzeros = np.full(len(patterns), patterns[0].nonzeros, np.int64)
    if len(kinds) > 1:
        nonzeros[:] = [pattern.nonzeros for pattern in patterns]
    ends, item = np.cumsum(nonzeros), memory.itemsize
    if memory.dtype not in (np.float32, np.float64) or ends[-1] != memory.size or not memory.flags.c_contiguous:
        raise ValueError(f"{memory.size} numbers of {memory.dtype} for {ends[-1]}")
    each = np.zeros(len(patterns), ARRIVING)
    each["bytes"], each["item"] = nonzeros * item, item
    each["source"] = source.addresses(nonzeros * item)
    each["target"] = address(memory) + (ends - nonzeros) * item
    room, responses, natives = 0, 0, dict[FactorPattern, NativePattern]()
    if check is None:
        natives = {pattern: NativePattern(pattern) for pattern in kinds}
        each["pattern"] = [c.addressof(natives[pattern].native) for pattern in patterns]
    else:
        each["row_start"], each["columns"], each["r"], each["pattern"], each["nodes"] = check.bodies.columns.T
        each["matrix"] = matrices
        room, responses = WORK * 3 * int(each["nodes"].max()), check.responses
    threads = sharing_threads(len(patterns)) if memory.nbytes > SHARED else 1
    work, hashing = np.empty(threads * room), hash_address()
    library().wf_take_in(address(each), len(each), hashing, responses or None, address(work), room, threads)
    values = rows(memory, nonzeros.tolist())
    if hashing is None:
        each["checksum"] = [checksum(own) for own in values]
    return TakenIn(values, each)
