# SPDX-License-Identifier: MIT
"""Kernel texts of a test, compiled as those of the package are; and those of the package in single precision."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest

from sim_server.backends import compiler
from sim_server.backends.cpu.device import CpuModule, module


@contextmanager
def compiled(text: str, folder: Path) -> Iterator[dict[str, CpuModule]]:
    """A module of the text in double and in single precision."""
    (folder / "text.cu").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "SOURCES", folder)
        yield {real: CpuModule("text.cu", real) for real in ("double", "float")}


def module_in(path: str, real: str) -> CpuModule:
    """A text of the package: in double precision as a run has it, in single precision with little optimization.

    No run on a CPU is in single precision, and optimization is three quarters of a compilation's time.
    """
    return module(path) if real == "double" else _single(path)


@cache
def _single(path: str) -> CpuModule:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "FLAGS", ["-O1" if flag == "-O3" else flag for flag in compiler.FLAGS])
        return CpuModule(path, "float")
