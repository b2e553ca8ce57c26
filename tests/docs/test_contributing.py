# SPDX-License-Identifier: MIT
"""The effect of CONTRIBUTING.md works as it stands there: its three files, in a copy of the repository's packages."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.figures import ROOT
from tests.support import nvrtc

TEXT = (ROOT / "CONTRIBUTING.md").read_text()


@pytest.mark.slow
def test_the_effect_runs(tmp_path: Path) -> None:
    module, test = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    (kernel,) = re.findall(r"^```cpp\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    for package in ("sim_server", "protocol"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    effects = tmp_path / "sim_server" / "effects"
    (effects / "foundation.py").write_text(module)
    (effects / "foundation.cu").write_text(kernel)
    (tmp_path / "test_foundation.py").write_text(test)
    (tmp_path / "pytest.ini").write_text("[pytest]\npythonpath = .\n")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_foundation.py"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "1 passed" in run.stdout


def test_its_kernel_compiles_for_a_gpu(tmp_path: Path) -> None:
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    (kernel,) = re.findall(r"^```cpp\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    (tmp_path / "foundation.cu").write_text(kernel)
    options = ["-std=c++17", f"-I{ROOT / 'sim_server' / 'kernels'}", "-arch=sm_90"]
    code, said = nvrtc.compiled(library, tmp_path / "foundation.cu", options)
    assert code, said
