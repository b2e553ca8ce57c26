# SPDX-License-Identifier: MIT
"""Copies of many arrays in native code (protocol/shared_memory/copies.py), compiled as all of the server's."""

import ctypes
from functools import cache

from protocol.shared_memory.copies import SOURCE, Copies
from sim_server.backends.compiler import begin, build


def compile_ahead() -> None:
    """Begins to compile, so that the first copies do not wait for it. Raises CompileError."""
    begin(SOURCE)


@cache
def native_copies() -> Copies:
    """Compiles at the first call. Raises CompileError."""
    return Copies(ctypes.CDLL(str(build(SOURCE, stepping=False))))
