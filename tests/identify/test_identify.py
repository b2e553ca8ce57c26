# SPDX-License-Identifier: MIT
"""sim-client identify with real servers: parameters with which curves were made are found again."""

import json
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfactor as wf
from protocol.process.own_python import own_module

pytestmark = pytest.mark.system

BEAM = """
dt = 0.02
[effects]
gravity = true
[solver]
preconditioner = "block_jacobi"
tolerance = 1e-8
[[object]]
name = "beam"
mesh = { bar = [4, 1, 1], size = [0.2, 0.04, 0.04] }
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
rayleigh = { mass = 0.5 }
"""
FIXED = 'fixed = { where = "X < 0.001" }\n'
CLAMPED = """
[[holder]]
name = "clamp"
object = "beam"
where = "X < 0.001"
"""
YOUNG, MASS = "object.beam.effects.corotational.young", "object.beam.effects.rayleigh.mass"


def measured(folder: Path, truth: dict[str, Any]) -> Path:
    """Displacements of the corner of the tip in a run with other values, at times between its steps too."""
    with wf.Simulation(wf.Scene.load(folder / "beam.toml").with_values(truth)) as simulation:
        corner = int(np.linalg.norm(simulation.positions("beam") - [0.2, 0, 0], axis=1).argmin())
        y = [0.0]
        for _ in range(20):
            simulation.step()
            y.append(float(simulation.displacements("beam")[corner, 1]))
    times = np.arange(0, 0.4001, 0.01)
    values = np.interp(times, 0.02 * np.arange(21), y)
    lines = [f"{t!r},{v!r}" for t, v in zip(times.tolist(), values.tolist(), strict=True)]
    (folder / "tip.csv").write_text("\n".join(["time,beam[0.2 0 0].y", *lines]) + "\n")
    return folder / "tip.csv"


def identify(folder: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    command = own_module("clients", "identify", "beam.toml", "tip.csv", "--device", "cpu", *words)
    return subprocess.run(command, capture_output=True, text=True, cwd=folder)


def test_stiffness_and_damping_of_a_curve_are_found_again(tmp_path: Path) -> None:
    """And the overlay is one that a server takes; the same command again makes no run."""
    (tmp_path / "beam.toml").write_text(BEAM + FIXED)
    measured(tmp_path, {YOUNG: 2.3e5, MASS: 1.9})
    words = "--fit", f"{YOUNG}=5e4:1e6", "--fit", f"{MASS}=0:5", "--json"
    done = identify(tmp_path, *words)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["values"] == pytest.approx({YOUNG: 2.3e5, MASS: 1.9}, rel=1e-3)
    assert found["misfit"] < 1e-4 and found["runs"] <= 40
    text = (tmp_path / "beam.identified.toml").read_text()
    assert text.startswith("# Parameters by sim-client identify\n")
    scene = wf.Scene.load(tmp_path / "beam.toml", [f"@{tmp_path / 'beam.identified.toml'}"])
    assert scene.table()["object"][0]["effects"]["corotational"]["young"] == pytest.approx(2.3e5, rel=1e-3)
    assert tomllib.loads(text)["object"]["beam"]["effects"]["rayleigh"]["mass"] == pytest.approx(1.9, rel=1e-3)
    again = json.loads(identify(tmp_path, *words).stdout)
    assert again == found


def test_the_force_on_a_clamp_tells_the_density(tmp_path: Path) -> None:
    """At rest it bears the weight: what is measured is computed by hand."""
    (tmp_path / "beam.toml").write_text(BEAM.replace("mass = 0.5", "mass = 20.0") + CLAMPED)
    weight = 1234.0 * 0.2 * 0.04**2 * 9.81
    (tmp_path / "tip.csv").write_text(f"time,beam/clamp.fy\n1.6,{-weight!r}\n")
    done = identify(tmp_path, "--fit", "object.beam.density=500:4000", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["values"]["object.beam.density"] == pytest.approx(1234.0, rel=2e-3) and found["runs"] <= 8


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    """By file and column, or by the server's word on the key; nothing is written."""
    (tmp_path / "beam.toml").write_text(BEAM + FIXED)
    asked = "--fit", f"{YOUNG}=1e4:1e6", "--runs", "1"
    expected = {
        "time,beam[99].x\n0.02,1\n": "tip.csv, column 'beam[99].x': no node 99; 'beam' has nodes 0 to 19",
        "time,beam/clamp.fx\n0.02,1\n": "tip.csv, column 'beam/clamp.fx': no force of 'beam' on 'clamp'",
    }
    for text, message in expected.items():
        (tmp_path / "tip.csv").write_text(text)
        done = identify(tmp_path, *asked, "--journal", "x.journal")
        assert (done.returncode, message in done.stderr) == (2, True), done.stderr
        (tmp_path / "x.journal").unlink()
    done = identify(tmp_path, "--fit", "object.beam.effects.corotational.yuong=1:2")
    assert done.returncode == 2 and "yuong" in done.stderr
    assert not (tmp_path / "beam.identified.toml").exists()
