# SPDX-License-Identifier: MIT
"""Kernel texts of a test, compiled as those of the package are; and those of the package in single precision."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest

from sim_server.backends import compiler
from sim_server.backends.cpu.device import CpuModule, module
from sim_server.backends.kernel_binding import KernelText

MIXED = {"real": "double", "local": "float"}


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


class MixedModule(CpuModule):
    """A text of the package with the types that a GPU has in mixed precision, item by item as there."""

    def __init__(self, path: str):
        KernelText.__init__(self, path, MIXED)
        text = compiler.read_text(path)[1].replace("#define WIDE\n", "")
        defines = tuple(f"{name}={kind}" for name, kind in MIXED.items())
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(compiler, "FLAGS", ["-O1" if flag == "-O3" else flag for flag in compiler.FLAGS])
            self._path = compiler.begin(compiler.source_of(path)[0], defines, text)
        self._layouts = {}


@cache
def mixed(path: str) -> MixedModule:
    """A text of the package in mixed precision."""
    return MixedModule(path)
