# SPDX-License-Identifier: MIT
"""Where files are kept that save time at the next start: compiled kernels, orders, patterns, meshes."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """$WARPFACTOR_CACHE, else $XDG_CACHE_HOME/warpfactor, else ~/.cache/warpfactor."""
    if folder := os.environ.get("WARPFACTOR_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warpfactor"
