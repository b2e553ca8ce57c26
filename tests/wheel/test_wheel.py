# SPDX-License-Identifier: MIT
"""The wheel of this platform: built, installed into an empty folder, and run where there is no compiler."""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warpfactor as wf
from sim_server.backends.processor_variants import VARIANTS, processor_flags

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(1800)]  # it compiles every text
ROOT = Path(__file__).parents[2]
PACKAGES = ("warpfactor", "protocol", "sim_server", "precond_worker", "clients")
HERE = next(name for name, needs in VARIANTS.items() if needs <= processor_flags())

RUN = """
import sys, numpy as np, warpfactor as wf
from sim_server.backends import compiler
with wf.Simulation("gallery/beam") as simulation:
    simulation.step(5)
    np.save(sys.argv[1], simulation.x)
from precond_worker.factorization.block_columns import SOURCE
print(compiler.build(SOURCE, stepping=False).parent)
print(wf.__file__, compiler.build_id(), sorted(compiler.libraries))
"""


def run(*command: object, **environment: str) -> str:
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, env=os.environ | environment)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy of the packages, with the kernels for this processor; those of an earlier test are cached."""
    if platform.machine() != "x86_64" or not shutil.which("objdump"):
        pytest.skip("wheels with kernels are built on x86-64, with binutils")
    copy, out = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("out")
    for name in ("pyproject.toml", "README.md", "LICENSE", *PACKAGES):
        take = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        take(ROOT / name, copy / name)
    words = ("--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check", "-w", out, copy)
    run(sys.executable, "-m", "pip", "wheel", *words, WARPFACTOR_VARIANTS=HERE)
    (made,) = out.iterdir()
    return made


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("installed")
    words = ("--no-deps", "--no-index", "--disable-pip-version-check", "--target", target, wheel)
    run(sys.executable, "-m", "pip", "install", *words)
    return target


def test_any_python_of_the_platform_may_install_it(wheel: Path) -> None:
    name, _, python, abi, tag = wheel.stem.split("-")
    assert (name, python, abi) == ("warpfactor", "py3", "none")
    assert tag.startswith("manylinux_2_") and tag.endswith("_x86_64")


def test_a_scene_runs_from_it_without_a_compiler(installed: Path, tmp_path: Path) -> None:
    """With its own kernels alone, and to rounding as here, where kernels are compiled for the very processor."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "run.py").write_text(RUN)
    absent = {"PATH": str(tmp_path / "bin"), "CXX": "/nonexistent", "WARPFACTOR_CACHE": str(tmp_path / "cache")}
    said = run(sys.executable, "-P", tmp_path / "run.py", tmp_path / "x.npy", PYTHONPATH=str(installed), **absent)
    folder, used = said.splitlines()
    libraries = installed / "sim_server/backends/libraries"
    assert Path(folder) == libraries / HERE
    assert used.startswith(f"{installed}/warpfactor/__init__.py {HERE}:") and "loop-" in used
    assert not (tmp_path / "cache").exists()
    assert (libraries / "libgomp.so.1").is_file()
    with wf.Simulation("gallery/beam") as simulation:
        simulation.step(5)
        largest = np.abs(simulation.x - simulation.positions("beam").mean(axis=0)).max()
        np.testing.assert_allclose(np.load(tmp_path / "x.npy"), simulation.x, atol=1e-6 * largest)
