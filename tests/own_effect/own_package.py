# SPDX-License-Identifier: MIT
"""The package of docs/own_effect.md, as it stands there, installed into a folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "own_effect.md").read_text()


def code(language: str) -> list[str]:
    """Blocks of one language on the page."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def install(folder: Path, version: str = "0.1") -> None:
    """Writes modules, text and metadata of the package, as pip leaves them, and its test."""
    module, test = code("python")
    (kernel,), (project,) = code("cpp"), code("ini")
    package = folder / "warpfactor_trap"
    package.mkdir(parents=True, exist_ok=True)
    for name, text in {"__init__.py": "", "trap.py": module, "trap.cu": kernel}.items():
        (package / name).write_text(text)
    (folder / "test_trap.py").write_text(test)
    ((group, points),) = re.findall(r'^\[project\.entry-points\."([\w.]+)"\]\n(.*?)\n\n', project, re.M | re.S)
    name = re.findall(r'^name = "(.*)"', project, re.M)[0]
    said = f"[{group}]\n{points.replace(chr(34), '')}\n"
    metadata(folder, name, version, said)


def metadata(folder: Path, name: str, version: str, points: str) -> None:
    """Writes the metadata of an installed package with these entry points."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(points)


def with_own_header(folder: Path) -> None:
    """Has the text of the package include a header of its own."""
    text = folder / "warpfactor_trap" / "trap.cu"
    text.with_name("trap_law.cuh").write_text("#pragma once\nINLINE real whole() { return 1.0; }\n")
    changed = text.read_text().replace("number k = p.h *", "number k = whole() * p.h *")
    text.write_text(changed.replace('#include "mat3.cuh"\n', '#include "mat3.cuh"\n#include "trap_law.cuh"\n'))


def python(folder: Path, *arguments: str | Path, expected: int = 0, errors: bool = True) -> str:
    """Runs Python with the package on its path; returns what it printed, or its errors where it is to fail."""
    path = os.pathsep.join([str(folder), str(ROOT)])
    run = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=folder, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": path},
    )  # fmt: skip
    assert run.returncode == expected, run.stdout + run.stderr
    return run.stderr if expected and errors else run.stdout
