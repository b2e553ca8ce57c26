# SPDX-License-Identifier: MIT
"""`sim-server SCENE --explain` says what each effect asked for, as other ways of looking at it do."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sim_server.backends.compiler import compiled
from sim_server.explain.asker import CORE, asker
from sim_server.explain.explanation import explain
from sim_server.simulation import Simulation

ROOT = Path(__file__).parents[2]
SCENE = """
dt = 0.02
[effects]
gravity = true
[solver]
preconditioner = "block_jacobi"
[[object]]
name = "block"
mesh = { bar = [2, 2, 2], size = [1, 1, 1] }
elements = "linear"
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
fixed = { where = "Y < 0.01" }
touch = true
"""
CONTACT = """
[[obstacle]]
name = "floor"
shape = "plane"
pose = { translate = [0, -1, 0] }
[[obstacle]]
name = "tool"
shape = "sphere"
radius = 0.1
moved = "client"
pose = { translate = [0, 3, 0] }
"""
NODES, TETS = 27, 48
BLOCKS = 33 + 20 + 4  # edges, diagonals of faces and of cells between its 18 nodes that are not fixed


def with_contact() -> str:
    return SCENE.replace("gravity = true\n", "gravity = true\ncontact = true\n") + CONTACT


def program(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sim_server", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.fixture(scope="module")
def explained(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Of a scene with contact, by the command, in a process of its own."""
    path = tmp_path_factory.mktemp("explained") / "scene.toml"
    path.write_text(with_contact())
    run = program(path, "--explain", "--json")
    assert run.returncode == 0 and not run.stderr, run.stderr
    return json.loads(run.stdout)


def of(explained: dict, name: str) -> dict:
    return next(each for each in explained["asked"] if each["name"] == name)


def test_the_launches_are_those_of_a_step(explained, tmp_path):
    (tmp_path / "scene.toml").write_text(with_contact())
    launches = Simulation.load(tmp_path / "scene.toml").engine.launches
    said = [row for row in explained["launches"] if row["when"] in ("before the solve", "after the solve")]
    assert [(row["kernel"], row["items"]) for row in said] == [(x.name, x.items) for x in launches]
    askers = {row["kernel"]: row["asker"] for row in said}
    for name in ("corotational", "touch", "gravity", "contact"):
        mine = [kernel for kernel, who in askers.items() if who == name]
        assert mine and len(mine) == of(explained, name)["launches"]
    assert askers["nodes.start"] == askers["nodes.advance"] == askers["rotate_blocks.rotate_blocks"] == CORE
    domains = {row["kernel"]: (row["domain"], row["items"]) for row in said}
    assert domains["corotational.elements"] == ("elements", TETS)
    assert domains["corotational_blocks.blocks"] == ("blocks", BLOCKS)
    assert domains["gravity.gravity"] == ("nodes", NODES)
    assert explained["totals"]["launches"] == len(launches)


def test_texts_belong_to_those_whose_kernels_they_hold(explained):
    assert of(explained, "gravity")["kernels"] == {"effects/gravity.cu": ["gravity"]}
    assert of(explained, "fixed")["kernels"] == {} and of(explained, "fixed")["launches"] == 0
    assert set(of(explained, "corotational")["kernels"]) == {
        "effects/corotational.cu",
        "effects/corotational_nodes.cu",
        "effects/corotational_blocks.cu",
    }
    assert "loop.cpp" in of(explained, CORE)["native"]


def test_arrays_are_counted_once_and_belong_to_who_made_them(tmp_path):
    """Gravity has the three numbers of g. Without it the rest is as it was."""
    (tmp_path / "with.toml").write_text(SCENE)
    (tmp_path / "without.toml").write_text(SCENE.replace("gravity = true", ""))
    found, without = (explain(tmp_path / f"{name}.toml") for name in ("with", "without"))
    asked = {each.name: each for each in found.asked}
    assert (asked["gravity"].arrays, asked["gravity"].bytes) == (1, 3 * 8)
    zero = 3 * 8  # g of a scene without gravity, of the energy balance
    assert found.totals["bytes"] - asked["gravity"].bytes == without.totals["bytes"] - zero
    for name in ("corotational", "touch"):
        assert asked[name] == next(each for each in without.asked if each.name == name)
    places = 4 * (NODES + 1 + 4 * TETS + BLOCKS + 1)  # of its corners and pairs in the system, but for the pairs
    impulses = 8 * 12 * TETS
    assert asked["corotational"].bytes > places + impulses


def test_keys_and_channels_are_those_of_contact_and_pushes(explained):
    root = "warpfactor/sim/"
    keys = {"obstacle/floor", "obstacle/tool", "pose/tool", "pose/*"}
    assert set(of(explained, "contact")["network"]) == {root + key for key in keys}
    assert set(of(explained, "contact")["log"]) == {"/obstacle/floor", "/obstacle/tool", "/pose/tool", "/targets"}
    assert set(of(explained, "touch")["log"]) == {"/interaction/block", "/touch"}
    for name in ("corotational", "fixed", "gravity"):
        assert not of(explained, name)["network"] and not of(explained, name)["log"]
    core = of(explained, CORE)
    assert {root + "state/block", root + "command/*/*", root + "steps"} <= set(core["network"])
    assert {"/scene", "/topology/block", "/state/block", "/step/block"} <= set(core["log"])


def test_modules_are_those_that_a_scene_without_the_effect_does_not_import(explained, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    listed = (
        "import sys\nfrom sim_server.simulation import Simulation\nSimulation.load(sys.argv[1])\nprint(*sys.modules)"
    )
    run = subprocess.run(
        [sys.executable, "-c", listed, str(tmp_path / "scene.toml")], cwd=ROOT, capture_output=True, text=True
    )
    without = set(run.stdout.split())
    all_of_it = of(explained, "contact")["modules"]
    mine = [name for name in all_of_it if name.startswith("sim_server")]  # of others the first that asks has them
    assert "sim_server.effects.contact" in mine and not set(mine) & without
    assert set(of(explained, "gravity")["modules"]) == {"sim_server.effects.gravity"}
    assert {"sim_server.effects.gravity", "sim_server.effects.touch"} <= without


def test_holders_and_steps_of_other_forms_are_told(tmp_path):
    holder = '[[holder]]\nname = "hand"\nobject = "block"\nwhere = "Y > 0.9"\nmoved = "client"\n'
    more = '[integrator]\nscheme = "ros2"\n' + holder
    (tmp_path / "scene.toml").write_text(SCENE.replace('"block_jacobi"', '"cholesky"') + more)
    found = explain(tmp_path / "scene.toml")
    simulation = Simulation.load(tmp_path / "scene.toml")
    told = [(row.kernel, row.items) for row in found.launches if row.when not in ("energy", "before the first step")]
    assert sorted(told) == sorted((x.name, x.items) for x in simulation.step_launches)
    asked = {each.name: each for each in found.asked}
    assert asked["holders"].launches and "/pose/hand" in asked["holders"].log
    assert {row.when for row in found.launches} >= {"before the solve", "stages", "backward Euler"}


def test_no_step_is_made_and_the_tables_name_every_effect(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    run = program(tmp_path / "scene.toml", "--explain")
    assert run.returncode == 0 and "no step was made" in run.stdout
    assert "warpfactor/other/state/block" in program(tmp_path / "scene.toml", "--explain", "--name", "other").stdout
    for words in ("corotational.elements", "/interaction/block", "sim_server.effects.gravity", "total"):
        assert words in run.stdout


def test_what_cannot_be_explained_ends_with_code_2(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE.replace("touch = true", "tuch = true"))
    run = program(tmp_path / "scene.toml", "--explain")
    assert run.returncode == 2 and "no such effect" in run.stderr and not run.stdout
    (tmp_path / "scene.toml").write_text(SCENE)
    assert program(tmp_path / "scene.toml", "--json").returncode == 2


def test_a_gpu_that_is_not_there_is_refused(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    run = subprocess.run(
        [sys.executable, "-m", "sim_server", str(tmp_path / "scene.toml"), "--explain", "--device", "gpu"],
        cwd=ROOT, capture_output=True, text=True, env={"CUDA_VISIBLE_DEVICES": "", "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert run.returncode == 2 and "no GPU" in run.stderr and not run.stdout


def test_code_outside_of_effects_is_the_core_and_texts_stay_listed(tmp_path):
    assert asker() == CORE
    (tmp_path / "scene.toml").write_text(SCENE)
    before = list(compiled)
    explain(tmp_path / "scene.toml")
    assert compiled[: len(before)] == before
