# SPDX-License-Identifier: MIT
"""What a client alone needs: no package of an extra, nothing of Linux; and what is said where an extra is missing."""

import os
import subprocess
import sys
import tomllib
from importlib.metadata import requires
from pathlib import Path

import pytest

from protocol.process.extras import EXTRAS, missing_extra
from protocol.process.own_python import own_module

ROOT = Path(__file__).parents[2]
OURS = ("warpfactor", "protocol", "clients", "sim_server", "precond_worker")

BARE = """
import os, signal, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
for module, name in {names!r}:
    delattr(sys.modules[module], name)
{then}
"""
POSIX = {"resource", "fcntl", "pwd", "grp", "termios"}  # what Windows does not have
NAMES = [("os", "killpg"), ("os", "sched_getaffinity"), ("signal", "SIGALRM"), ("signal", "setitimer")]


def bare(then: str, posix: bool = True) -> "subprocess.CompletedProcess[str]":
    """Runs a text in a Python without the packages of extras; posix: with what Windows lacks."""
    absent = {module for modules in EXTRAS.values() for module in modules} | (set() if posix else POSIX)
    text = BARE.format(absent=absent, names=[] if posix else NAMES, then=then)
    return subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)


def test_a_client_imports_nothing_of_an_extra_and_nothing_of_linux() -> None:
    names = ("client", "__main__", "log.reader", "export.export", "haptics.run", "watch", "demo.run", "replay.command")
    found = bare(f"import warpfactor as wf, clients.{', clients.'.join(names)}\nprint(wf.Client, wf.Log)", posix=False)
    assert found.returncode == 0, found.stderr
    assert "clients.client.Client" in found.stdout


def test_what_needs_an_extra_names_it() -> None:
    found = bare("import warpfactor as wf\nwf.Simulation")
    last = found.stderr.splitlines()[-1]
    assert last.startswith("ModuleNotFoundError: warpfactor.Simulation: this needs the package ")
    assert "of the extra server: " in last and "-m pip install " in last
    last = bare("import warpfactor as wf\nwf.gym").stderr.splitlines()[-1]
    assert last.startswith("ModuleNotFoundError: warpfactor.gym: this needs the package gymnasium, of the extra gym: ")
    found = bare("sys.argv[1:] = ['gallery/beam']\nfrom sim_server.__main__ import main\nmain()")
    assert found.returncode == 1
    (line,) = found.stderr.splitlines()
    assert line.startswith("sim-server: this needs the package ") and "of the extra server: " in line
    accuracy = "sys.argv[1:] = ['accuracy', 'a.toml']\nfrom clients.__main__ import main\nmain()"
    (line,) = bare(accuracy).stderr.splitlines()
    assert line.startswith("sim-client: this needs the package ") and "of the extra server: " in line
    assert "of the extra identify: " in missing_extra(ModuleNotFoundError("no", name="optuna"))
    assert missing_extra(ModuleNotFoundError("no", name="viser.theme")).startswith(
        "this needs the package viser, of the extra web: "
    )
    assert ", of the extra export: " in missing_extra(ModuleNotFoundError("no", name="pxr"))
    assert missing_extra(ModuleNotFoundError("no", name="nobody")) == missing_extra(ImportError("no")) == ""


def test_each_extra_lists_packages_and_all_has_those_of_every_machine() -> None:
    """None is this package itself, under a name that no index has; a device and a build from source are not for all."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    usual = ("server", "mesh", "view", "web", "export", "metrics", "tls")
    others = {"gpu", "gym", "identify", "slurm", "cholmod", "all", "docs", "test"}
    assert set(extras) == {*usual} | others
    assert not [line for lines in extras.values() for line in lines if line.startswith("warpfactor")]
    assert set(extras["all"]) == {line for name in usual for line in extras[name]}
    assert set(EXTRAS) <= set(extras)
    assert requires("warpfactor")  # it is installed with them


@pytest.mark.system
def test_folders_of_the_user_do_not_hide_ours(tmp_path: Path) -> None:
    for name in OURS:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"raise SystemExit('the folder {name} of the user')")
    commands = [sys.executable, "-m", "precond_worker"], _elsewhere(tmp_path)
    path = os.environ | {"PYTHONPATH": str(ROOT)}
    hidden, ours = (
        subprocess.run([*command, "--version"], capture_output=True, text=True, cwd=tmp_path, env=path)
        for command in commands
    )
    assert "of the user" in hidden.stderr
    assert ours.returncode == 0 and ours.stdout.startswith("precond-worker ")


def _elsewhere(folder: Path) -> list[str]:
    """The command of a worker as a server makes it that was started in a folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        return own_module("precond_worker")
    finally:
        os.chdir(before)


def test_no_process_of_ours_is_started_without_it() -> None:
    texts = [path for name in OURS for path in (ROOT / name).rglob("*.py") if path.name != "extras.py"]  # which has pip
    assert len(texts) > 100
    assert [str(path) for path in texts if 'sys.executable, "-m"' in path.read_text()] == []
