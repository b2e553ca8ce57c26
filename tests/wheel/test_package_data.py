# SPDX-License-Identifier: MIT
"""A wheel has every file that is read at run time: texts of kernels, schemas, materials, scenes that come along."""

import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DATA = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
READ = {".cu", ".cuh", ".h", ".cpp", ".toml", ".msh", ".obj", ".proto", ".pyi", ".typed"}


@pytest.mark.parametrize("package", ["warpfactor", "protocol", "sim_server", "precond_worker"])
def test_files_that_are_read_are_in_the_wheel(package: str) -> None:
    git = shutil.which("git")
    listed = git and subprocess.run([git, "ls-files", package], cwd=ROOT, capture_output=True, text=True)
    if not listed or listed.returncode:
        pytest.skip("not a checkout of git")
    wanted = {name for name in listed.stdout.splitlines() if Path(name).suffix in READ or name.endswith("py.typed")}
    taken = {str(path.relative_to(ROOT)) for pattern in DATA[package] for path in (ROOT / package).glob(pattern)}
    assert wanted and wanted <= taken, sorted(wanted - taken)
