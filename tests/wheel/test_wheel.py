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


def built(tmp_path_factory: pytest.TempPathFactory, **environment: str) -> Path:
    """A wheel made of a copy of the packages, with the kernels for this processor."""
    if platform.machine() != "x86_64" or not shutil.which("objdump"):
        pytest.skip("wheels with kernels are built on x86-64, with binutils")
    copy, out = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("out")
    for name in ("pyproject.toml", "README.md", "LICENSE", *PACKAGES):
        take = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        take(ROOT / name, copy / name)
    words = ("--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check", "-w", out, copy)
    run(sys.executable, "-m", "pip", "wheel", *words, **environment | {"WARPFACTOR_VARIANTS": HERE})
    (made,) = out.iterdir()
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Kernels of an earlier test are taken from the cache."""
    return built(tmp_path_factory)


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


QUICK = """#!/bin/sh
case " $* " in *" -o "*) ;; *) exec g++ "$@" ;; esac
case " $* " in {needed}) exec g++ "$@" -O0 ;; esac
while [ "$1" != -o ]; do shift; done
exec g++ -shared -x c++ /dev/null -o "$2"
"""
NEEDED = (  # of the creature: other texts become empty libraries, so that the wheel is made in seconds
    "sim_server/backends/cpu/native", "sim_server/recording/", "sim_server/updates/", "precond_worker/",
    "effects/corotational", "effects/rayleigh.cu", "effects/touch.cu", "effects/gravity.cu", "kernels/guess.cu",
    "kernels/nodes.cu", "kernels/rotate_blocks.cu", "protocol/shared_memory/",
)  # fmt: skip


def test_an_empty_environment_without_a_compiler_runs_the_demonstration_and_a_client(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """By its commands, in a folder with packages of our names; beside the wheel are the libraries that it asks for."""
    (tmp_path / "c++").write_text(QUICK.format(needed="|".join(f"*{text}*" for text in NEEDED)))
    (tmp_path / "c++").chmod(0o755)
    quick = {"CXX": str(tmp_path / "c++"), "WARPFACTOR_CACHE": str(tmp_path / "cache")}
    made, venv = built(tmp_path_factory, **quick), tmp_path / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", venv)
    python = venv / "bin" / "python"
    words = ("--python", python, "install", "--no-deps", "--no-index", "--disable-pip-version-check", made)
    run(sys.executable, "-m", "pip", *words)
    (site,) = venv.glob("lib/python3*/site-packages")
    (site / "libraries.pth").write_text(f"{Path(np.__file__).parents[1]}\n")
    (here := tmp_path / "here").mkdir()
    for name in PACKAGES:
        (here / name).mkdir()
        (here / name / "__init__.py").write_text("raise SystemExit('of the user')")
    empty = {"PATH": str(here), "CXX": "", "WARPFACTOR_CACHE": str(tmp_path / "none"), "PYTHONPATH": ""}

    def command(name: str, *arguments: object) -> str:
        words = [str(venv / "bin" / name), *map(str, arguments)]
        done = subprocess.run(words, capture_output=True, text=True, env=os.environ | empty, cwd=here)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    said = command("warpfactor", "demo", "--record", "demo.mcap")
    assert "largest true residual" in said and "a client pushes" in said
    command("sim-client", "export", "demo.mcap", "--to", "demo.npz")
    with np.load(here / "demo.npz") as arrays:
        age, iterations = arrays["scalars/factor_age"], arrays["scalars/iterations"]
    assert len(age) > 10 and (age >= 0).any(), (age, iterations, said)
    assert not (tmp_path / "none").exists()
