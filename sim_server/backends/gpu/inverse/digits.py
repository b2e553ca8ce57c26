# SPDX-License-Identifier: MIT
"""How many binary digits the inverse of a factor needs: 11 (one float16 number an entry) or 22 (two).

What is stored is S = D^-1 A^-1 D^-1 with D² the diagonal of A^-1 (plan.py). Rounded to S + E, entries of E about 2^-12
of those of S, it makes of the preconditioned matrix I + A^1/2 D E D A^1/2, off from I by at most |E| |D A D|. The
diagonal of D A D is A_ii (A^-1)_ii, the response: how much softer a degree of freedom is if all others give way than if
they stay. It is 1 where nothing is coupled, 5 to 20 in usual bodies, and some hundred where parts of very different
stiffness lie side by side, near Poisson's ratio 1/2 and in large time steps. There 11 digits cost iterations, and above
a thousand they make a preconditioner that is not positive definite.
"""

import ctypes as c
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from protocol.shared_memory.located import Located, addresses
from protocol.validate import helping_threads
from sim_server.arrays import Float64
from sim_server.backends.compiler import native

TEXT = "backends/gpu/inverse/digits.cpp"
FEW = 8  # factors for each thread, at least
MOST_RESPONSE = 400.0
"""Largest response of a degree of freedom (as estimated: up to twice the true one) that 11 digits are used for."""


@cache
def library() -> c.CDLL:
    """Compiles and loads digits.cpp."""
    arguments = [*[c.c_int64] * 2, *[c.c_void_p] * 6, c.c_int32]
    signatures: dict[str, tuple[Any, list[Any]]] = {"largest_responses": (None, arguments)}
    return native(TEXT, signatures, stepping=False)  # Gpu.build names it


def largest_responses(pattern: FactorPattern, values: Sequence[NDArray[np.floating]]) -> Float64:
    """Returns an estimate of the largest A_ii (A^-1)_ii of each A = L L^T, the same for the same L; values (nonzeros,)
    of each L.

    Takes a few passes over L. From any thread, without Python's lock.
    """
    numbers = [_contiguous(each) for each in values]
    each = addresses(numbers)
    found = np.empty(len(numbers))
    arrays = pattern.super_start, pattern.row_start, pattern.rows, pattern.value_start, each, found
    threads = 1 + min(helping_threads(), len(numbers) // FEW)
    library().largest_responses(
        len(numbers), len(pattern.super_start) - 1, *(a.ctypes.data for a in arrays), threads
    )  # fmt: skip
    return found


def response_function() -> int:
    """Address of `largest_responses` of digits.cpp, for other native code. Raises CompileError."""
    return c.cast(library().largest_responses, c.c_void_p).value or 0


def planes_by(responses: Float64) -> list[int]:
    """Returns the float16 numbers per entry that inverses need, by the largest response of each (k,)."""
    good = (responses <= MOST_RESPONSE).tolist()
    return [1 if each else 2 for each in good]


def _contiguous(values: NDArray[np.floating]) -> NDArray[np.float32]:
    known = isinstance(values, Located) and values.dtype == np.float32 and values.flags.c_contiguous
    return values if known else np.ascontiguousarray(values, np.float32)


def planes_of(factors: Sequence[tuple[FactorPattern, NDArray[np.floating]]]) -> list[int]:
    """Returns the float16 numbers per entry that the inverse of each of some factors needs: 1, or 2 for 22 binary
    digits."""
    planes = [1] * len(factors)
    for pattern in dict.fromkeys(pattern for pattern, _ in factors):
        places = [place for place, (own, _) in enumerate(factors) if own is pattern]
        needed = planes_by(largest_responses(pattern, [factors[k][1] for k in places]))
        for place, own in zip(places, needed, strict=True):
            planes[place] = own
    return planes
