# SPDX-License-Identifier: MIT
"""Kernel texts of a test, compiled as those of the package are."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sim_server.backends import compiler
from sim_server.backends.cpu.device import CpuModule


@contextmanager
def compiled(text: str, folder: Path) -> Iterator[dict[str, CpuModule]]:
    """A module of the text in double and in single precision."""
    (folder / "text.cu").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "SOURCES", folder)
        yield {real: CpuModule("text.cu", real) for real in ("double", "float")}
