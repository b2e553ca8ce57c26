# SPDX-License-Identifier: MIT
"""Copies of many arrays in native code (protocol/shared_memory/copies.py), where it is to be had."""

from functools import cache

from precond_worker.compiled import compiled
from protocol.shared_memory.copies import SOURCE, Copies


@cache
def native_copies() -> Copies:
    """Without native code NumPy copies."""
    return Copies(compiled(SOURCE))
