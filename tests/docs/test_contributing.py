# SPDX-License-Identifier: MIT
"""Examples of CONTRIBUTING.md work as they stand there, in a copy of the repository's packages."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.figures import ROOT
from tests.support import nvrtc

TEXT = (ROOT / "CONTRIBUTING.md").read_text()


RUN = """
from pathlib import Path

import numpy as np
from clients.export.arrays import write_csv
from clients.log.reader import Log
from sim_server.backends.gpu.mailbox import library
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.simulation import Simulation

simulation = Simulation.load("scene.toml")
simulation.engine.run(4)
records = simulation.engine.records()
assert records["iterations"].all()
assert np.array_equal(records["iteration_rate"], records["iterations"] / records["solve"])
with Recorder("run.mcap") as recorder:
    recorder.scene(messages.scene(simulation))
    recorder.topology(messages.topology(simulation, simulation.world.bodies[0]))
    for step in messages.steps(simulation, records):
        recorder.step(step)
with Log("run.mcap") as log:
    assert np.array_equal(log.scalars("bar")["iteration_rate"], records["iteration_rate"])
    write_csv(log, "bar", Path("run.csv"))
library()  # of the loop for GPUs: it is compiled, and its layouts are compared
"""
SCENE = """
dt = 0.01
[effects]
gravity = true
[solver]
preconditioner = "block_jacobi"
[[object]]
name = "bar"
mesh = { bar = [3, 2, 2], size = [3, 1, 1] }
[object.effects]
fixed = { where = "X < 0.001" }
corotational = { young = 1e5, poisson = 0.3 }
"""


def copy_packages(to: Path, *packages: str) -> None:
    for package in packages:
        shutil.copytree(ROOT / package, to / package, ignore=shutil.ignore_patterns("__pycache__"))


def insert(folder: Path, diff: str) -> set[str]:
    """Inserts the added lines of a diff, each behind the only line of the file that begins as the one before it in the
    diff. Returns the files."""
    changed = set()
    for part in diff.split("--- ")[1:]:
        name, *lines = part.splitlines()
        text = (folder / name).read_text()
        for before, added in zip(lines[::2], lines[1::2], strict=True):
            assert before[0] == " " and added[0] == "+" and text.count(f"\n{before[1:]}") == 1
            text = re.sub(rf"(\n{re.escape(before[1:])}.*)", rf"\1\n{added[1:]}", text)
        (folder / name).write_text(text)
        changed.add(name)
    return changed


@pytest.mark.slow
def test_the_record_column_is_in_records_messages_and_exports(tmp_path: Path) -> None:
    """With a compiler that does not optimize, for time: all texts are compiled again."""
    pytest.importorskip("grpc_tools")
    (diff,) = re.findall(r"^```diff\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    (command,) = re.findall(r"^python -m grpc_tools.*$", TEXT, re.MULTILINE)
    copy_packages(tmp_path, "sim_server", "protocol", "clients")
    assert len(insert(tmp_path, diff)) == 2
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "c++").write_text('#!/bin/sh\nexec g++ "$@" -O0\n')
    (tmp_path / "c++").chmod(0o755)
    variables = os.environ | {"WARPFACTOR_CACHE": str(tmp_path / "cache"), "CXX": str(tmp_path / "c++")}
    for arguments, folder in ((command.split()[1:], "protocol"), (["-c", RUN], "")):
        run = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path / folder, env=variables, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stdout + run.stderr
    assert (tmp_path / "run.csv").read_text().splitlines()[0].endswith(",step_error,iteration_rate")


@pytest.mark.slow
def test_the_effect_runs(tmp_path: Path) -> None:
    module, test = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    (kernel,) = re.findall(r"^```cpp\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    copy_packages(tmp_path, "sim_server", "protocol")
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
