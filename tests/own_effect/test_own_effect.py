# SPDX-License-Identifier: MIT
"""An effect of another package: the code of docs/own_effect.md works as it stands there, in logs and replays too."""

import json
from pathlib import Path

import pytest

from tests.own_effect.own_package import ROOT, code, install, metadata, python, with_own_header
from tests.support import nvrtc

SCENE = """
dt = 0.05
[solver]
preconditioner = "block_jacobi"
[[object]]
name = "jelly"
mesh = { bar = [2, 2, 2], size = [1, 1, 1] }
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
trap = { pull = 2, center = [1, 0, 0] }
"""
IDENTIFY = """
import sys
from sim_server.recording import messages
from sim_server.simulation import Simulation

simulation = Simulation.load(sys.argv[1])
message = messages.scene(simulation)
print(message.software)
print(message.build)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own effect")  # with a space, as a path may have
    install(folder)
    (folder / "scene.toml").write_text(SCENE)
    return folder


def test_the_package_of_the_page_passes_its_test(installed: Path) -> None:
    said = python(installed, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_trap.py")
    assert "1 passed" in said


def test_it_is_explained_as_any_effect(installed: Path) -> None:
    found = json.loads(python(installed, "-m", "sim_server", "scene.toml", "--explain", "--json"))
    mine = next(each for each in found["asked"] if each["name"] == "trap")
    text = str(installed / "warpfactor_trap" / "trap.cu")
    assert mine["kernels"] == {text: ["energy", "pull"]} and mine["launches"] == 1
    assert {"warpfactor_trap", "warpfactor_trap.trap"} <= set(mine["modules"])
    assert mine["bytes"] == 27 * 8 * (1 + 3 + 1 + 1)  # stiffness, centre, energy, and the body of each node
    (row,) = (row for row in found["launches"] if row["kernel"] == "trap.pull")
    assert (row["domain"], row["items"], row["asker"]) == ("nodes", 27, "trap")


def test_nothing_is_looked_for_where_no_scene_lists_it(installed: Path) -> None:
    (installed / "usual.toml").write_text(SCENE.replace("trap = {", "# trap = {"))
    load = "import sys; from sim_server.simulation import Simulation; Simulation.load('usual.toml')"
    show = "; print([m for m in sys.modules if 'warpfactor_trap' in m or m == 'sim_server.effects._outside'])"
    assert python(installed, "-c", load + show).strip() == "[]"


def test_a_name_of_the_tree_is_that_of_the_tree(tmp_path: Path) -> None:
    """An entry point of the same name is not read: its module does not exist."""
    install(tmp_path)
    metadata(tmp_path, "wrong-gravity", "1", "[warpfactor.effects]\ngravity = module_that_is_not_there\n")
    (tmp_path / "scene.toml").write_text(SCENE.replace("[solver]", "[effects]\ngravity = true\n[solver]"))
    found = json.loads(python(tmp_path, "-m", "sim_server", "scene.toml", "--explain", "--json"))
    assert {"gravity", "trap"} <= {each["name"] for each in found["asked"]}


def test_a_run_is_logged_and_repeated_and_refused_without_it(installed: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    arguments = ["--free-run", "--steps", "20", "--quiet", "--listen", "tcp/127.0.0.1:0", "--record", log]
    python(installed, "-m", "sim_server", "scene.toml", *arguments)
    assert "diverged" not in python(installed, "-m", "sim_server.replay", log)
    (tmp_path / "elsewhere").mkdir()
    said = python(tmp_path / "elsewhere", "-m", "sim_server.replay", log, expected=2)
    assert "no such effect" in said and "corotational" in said and "effect trap of warpfactor-trap 0.1 (" in said


def test_another_version_of_the_code_is_another_build_and_is_named(installed: Path, tmp_path: Path) -> None:
    first = python(installed, "-c", IDENTIFY, "scene.toml").splitlines()
    assert "effect trap of warpfactor-trap 0.1 (" in first[0]
    assert first == python(installed, "-c", IDENTIFY, "scene.toml").splitlines()
    other = tmp_path / "other"
    install(other)
    (other / "scene.toml").write_text(SCENE)
    assert python(other, "-c", IDENTIFY, "scene.toml").splitlines() == first  # wherever it is installed
    module = other / "warpfactor_trap" / "trap.py"
    module.write_text(module.read_text().replace("params.pull *", "1.0 * params.pull *"))
    changed = python(other, "-c", IDENTIFY, "scene.toml").splitlines()
    assert changed[0] != first[0] and changed[1] != first[1]
    log = tmp_path / "run.mcap"
    arguments = ["--free-run", "--steps", "3", "--quiet", "--listen", "tcp/127.0.0.1:0", "--record", log]
    python(installed, "-m", "sim_server", "scene.toml", *arguments)
    assert "is not the code of the log" in python(other, "-m", "sim_server.replay", log)


def test_unknown_names_are_told_those_of_packages_too(installed: Path) -> None:
    (installed / "wrong.toml").write_text(SCENE.replace("trap = {", "trip = {"))
    said = python(installed, "-m", "sim_server", "wrong.toml", expected=2)
    assert "did you mean 'trap'" in said and "stable_neo_hookean" in said


BROKEN = {
    "cannot be imported: ModuleNotFoundError": ("[warpfactor.effects]\nbroken = missing_module\n", ""),
    "cannot be imported: ZeroDivisionError": ("[warpfactor.effects]\nbroken = broken\n", "1 / 0\n"),
    "has no SCOPE, no Params, no build, no a docstring": ("[warpfactor.effects]\nbroken = broken\n", "x = 1\n"),
    "allowed: \"scene\", \"object\"": (
        "[warpfactor.effects]\nbroken = broken\n",
        '"""Does nothing."""\nSCOPE = "world"\nfrom warpfactor_trap.trap import Params, build\n',
    ),
    "is no module, but": ("[warpfactor.effects]\nbroken = warpfactor_trap.trap:Trap\n", ""),
    "kernel text /nowhere.cu": (
        "[warpfactor.effects]\nbroken = broken\n",
        '"""Lacks its text."""\nfrom warpfactor_trap.trap import *\n'
        "def build(world, listed):\n    return world.backend.module('/nowhere.cu')\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("words", BROKEN)
def test_a_package_that_is_no_effect_is_refused_by_name(words: str, tmp_path: Path) -> None:
    points, module = BROKEN[words]
    install(tmp_path)
    (tmp_path / "broken.py").write_text(module)
    metadata(tmp_path, "broken-package", "2", points)
    (tmp_path / "scene.toml").write_text(SCENE.replace("trap = {", "broken = {"))
    said = python(tmp_path, "-m", "sim_server", "scene.toml", "--explain", expected=2)
    assert words in said
    assert "broken" in said or "/nowhere.cu" in said


def test_a_text_may_have_a_header_of_its_own(tmp_path: Path) -> None:
    """Beside it, on the CPU; one that changes makes another library, and is another build."""
    install(tmp_path)
    with_own_header(tmp_path)
    assert "1 passed" in python(tmp_path, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_trap.py")
    (tmp_path / "scene.toml").write_text(SCENE)
    first = python(tmp_path, "-c", IDENTIFY, "scene.toml")
    header = tmp_path / "warpfactor_trap" / "trap_law.cuh"
    header.write_text(header.read_text().replace("1.0", "2.0"))
    assert python(tmp_path, "-c", IDENTIFY, "scene.toml").splitlines()[1] != first.splitlines()[1]
    said = python(tmp_path, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_trap.py", expected=1, errors=False)
    assert "Mismatched elements" in said


def test_two_packages_with_one_name_are_refused(tmp_path: Path) -> None:
    install(tmp_path)
    metadata(tmp_path, "another-trap", "3", "[warpfactor.effects]\ntrap = warpfactor_trap.trap\n")
    (tmp_path / "scene.toml").write_text(SCENE)
    said = python(tmp_path, "-m", "sim_server", "scene.toml", "--explain", expected=2)
    assert "several packages have one: another-trap 3, warpfactor-trap 0.1" in said


def test_its_text_compiles_for_a_gpu(tmp_path: Path) -> None:
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    (kernel,) = code("cpp")
    (tmp_path / "trap.cu").write_text(kernel)
    for real in ("double", "float"):
        options = [
            "-std=c++17",
            f"-I{ROOT / 'sim_server' / 'kernels'}",
            "-arch=sm_90",
            f"-Dreal={real}",
            f"-Dlocal={real}",
        ]
        built, said = nvrtc.compiled(library, tmp_path / "trap.cu", options)
        assert built, said
