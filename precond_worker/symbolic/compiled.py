# SPDX-License-Identifier: MIT
"""Native code that makes something faster, where it is to be had."""

import ctypes
from functools import cache
from pathlib import Path


@cache
def compiled(source: Path) -> ctypes.CDLL | None:
    """Returns the library of a text, compiled at the first call; None without a C++ compiler or the code of the server,
    which knows how to."""
    try:
        from sim_server.backends.build_pool import CompileError
        from sim_server.backends.compiler import build
    except ImportError:
        return None
    try:
        return ctypes.CDLL(str(build(source, stepping=False)))
    except CompileError:
        return None
