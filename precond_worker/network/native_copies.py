# SPDX-License-Identifier: MIT
"""Copies of many arrays in native code (protocol/shared_memory/copies.py), where it is to be had."""

import ctypes
from functools import cache

from protocol.shared_memory.copies import SOURCE, Copies


@cache
def native_copies() -> Copies:
    """Compiles at the first call; without a C++ compiler, or the code of the server, NumPy copies."""
    try:
        from sim_server.backends.build_pool import CompileError
        from sim_server.backends.compiler import build
    except ImportError:
        return Copies(None)
    try:
        return Copies(ctypes.CDLL(str(build(SOURCE, stepping=False))))
    except CompileError:
        return Copies(None)
