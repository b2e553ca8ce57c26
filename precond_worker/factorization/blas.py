# SPDX-License-Identifier: MIT
"""The BLAS and LAPACK that SciPy brings, as addresses for native code (native/multifrontal.cpp).

scipy.linalg.cython_blas and cython_lapack publish their functions as capsules, whose name is the C signature. Integers
are passed by address; they are 32 bits wide in most builds and 64 in others. The native code gives them 64 bits, of
which a function that reads 32 finds the lower half first on a little-endian machine.
"""

import ctypes as c
import sys
from functools import cache
from typing import Any

ARGUMENTS = {"potrf": 5, "trsm": 11, "syrk": 10}


class Library(c.Structure):
    """Addresses of the functions of one precision (struct Library)."""

    _fields_ = [(name, c.c_void_p) for name in ARGUMENTS]


@cache
def library(letter: str) -> Library:
    """Returns the functions in double ("d") or single precision ("s").

    Raises ImportError if SciPy offers another interface than this code knows.
    """
    from scipy.linalg import cython_blas, cython_lapack

    if sys.byteorder != "little":
        raise ImportError("native Cholesky factors need a little-endian machine")
    modules: dict[str, Any] = {"potrf": cython_lapack, "trsm": cython_blas, "syrk": cython_blas}
    found = {name: address(modules[name].__pyx_capi__[letter + name], letter, n) for name, n in ARGUMENTS.items()}
    return Library(**found)


def address(capsule: Any, letter: str, arguments: int) -> int:
    """Returns the function in a capsule; checks its signature as far as the call depends on it."""
    name_of, pointer = c.pythonapi.PyCapsule_GetName, c.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = c.c_char_p, [c.py_object]
    pointer.restype, pointer.argtypes = c.c_void_p, [c.py_object, c.c_char_p]
    name = name_of(capsule)
    listed = name.decode().removeprefix("void (").removesuffix(")").split(", ")
    if len(listed) != arguments or not all(kind.endswith(" *") for kind in listed):
        raise ImportError(f"SciPy's signature {name.decode()!r} is not the one of LAPACK, {arguments} addresses")
    if not any(kind.endswith(f"_{letter} *") or kind == _NUMBER[letter] for kind in listed):
        raise ImportError(f"SciPy's signature {name.decode()!r} names no {_NUMBER[letter]}")
    return int(pointer(capsule, name))


_NUMBER = {"d": "double *", "s": "float *"}
