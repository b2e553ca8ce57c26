# SPDX-License-Identifier: MIT
"""sim-client accuracy with real servers over a tiny scene: killed, gone on with, interrupted, and shown."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.system.link_helpers import PATIENCE
from tests.system.server_process import ROOT, run, until

pytestmark = pytest.mark.system

# Gravity is weak, so that the second reference is fine enough already.
SCENE = """\
dt = 0.02
[effects]
gravity = { g = [0, -0.002, 0] }
[solver]
preconditioner = "block_jacobi"
[[object]]
name = "bar"
mesh = { bar = [1, 1, 2], size = [1, 1, 2] }
[object.effects]
corotational = { young = 1e6, poisson = 0.3 }
fixed = { where = "Z < 0.01" }
"""


def started(*arguments: str) -> "subprocess.Popen[str]":
    words = [sys.executable, "-m", "clients", "accuracy", *arguments]
    return subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True)


def points(folder: Path) -> list[dict[str, Any]]:
    path = folder / "points.json"
    return json.loads(path.read_text())["points"] if path.exists() else []


def test_points_are_kept_through_a_kill_and_an_interrupt(tmp_path: Path) -> None:
    scene, folder = tmp_path / "bar.toml", tmp_path / "out"
    scene.write_text(SCENE)
    asked = (str(scene), "--out", str(folder), "--device", "cpu", "--duration", "0.16")
    with started(*asked, "--minutes", "10") as killed:
        until(lambda: points(folder), "a first point")
        killed.kill()
    before = points(folder)
    with started(*asked, "--minutes", "10") as interrupted:
        until(lambda: len(points(folder)) >= len(before) + 2, "two more")
        interrupted.send_signal(signal.SIGINT)
        _, said = interrupted.communicate(timeout=PATIENCE)
    assert interrupted.returncode == 130 and "the same command goes on" in said and "Traceback" not in said, said
    assert {path.name for path in folder.iterdir()} == {"points.json", "runs"}, "no log is left"
    kept = points(folder)
    assert kept[: len(before)] == before

    shown = run("clients", "accuracy", *asked, "--minutes", "0", "--json")
    assert shown.returncode == 0, shown.stderr
    found = json.loads(shown.stdout)
    assert found["points"] == kept and found == json.loads((folder / "points.json").read_text())
    assert [p["axis"] for p in kept[:3]] == ["scene", "tolerance", "linearizations"]
    sources = found["sources"]
    assert 0 < sources["linear solve"] < sources["time step"] / 100, "of first order, solved to 1e-6"
    assert found["reference"]["uncertainty"] < sources["time step"] / 10
    assert kept[0]["error"] == pytest.approx(sources["time step"], rel=0.5) and kept[0]["rounds"]
    assert found["sentence"].startswith("The error of the time step "), "it is the largest one"
    assert found["objects"]["bar"] == {"size": 2.0, "nodes": 12, "elements": 12} and found["device"] == "cpu"
    assert (folder / "accuracy.png").exists() and (folder / "points.csv").read_text().count("\n") == len(kept) + 1


def test_a_scene_that_is_refused(tmp_path: Path) -> None:
    scene = tmp_path / "bar.toml"
    scene.write_text(SCENE.replace("poisson = 0.3", "poisson = 0.7"))
    found = run("clients", "accuracy", str(scene), "--out", str(tmp_path / "out"), "--minutes", "1")
    assert found.returncode == 2 and "poisson" in found.stderr and "Traceback" not in found.stderr
    assert not (tmp_path / "out" / "points.json").exists()
