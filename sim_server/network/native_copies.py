# SPDX-License-Identifier: MIT
"""Copies of many arrays in native code (protocol/copies.py), compiled as all of the server's."""

import ctypes
from functools import cache

from protocol.copies import SOURCE, Copies
from sim_server.backends.compiler import build


@cache
def native_copies() -> Copies:
    """Compiles at the first call. Raises CompileError."""
    return Copies(ctypes.CDLL(str(build(SOURCE, stepping=False))))
