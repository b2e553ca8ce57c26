# SPDX-License-Identifier: MIT
"""The parts of the GPU benchmark that need no GPU: scenes, rounds (on a CPU), counts of bytes, tables, merging."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.scene import load
from sim_server.simulation import Simulation
from tests.backends import fake_cupy
from tests.backends.test_gpu_newton_graph import name
from tests.bench.gpu import __main__ as gpu
from tests.bench.gpu import page, trial
from tests.bench.gpu import traffic as moved
from tests.bench.gpu.others import lower
from tests.bench.gpu.problem import BARS, MATERIALS, Problem
from tests.bench.gpu.rows import row, search_row
from tests.bench.gpu.served import row as served_row
from tests.bench.gpu.steps import SEARCHES, STEPS, Beams, Search, rounds
from tests.docs.figures import table_under
from tests.scenes import bar, scene
from tests.support import nvrtc

ROOT = Path(__file__).resolve().parents[2]
DEVICE = {
    "gpu": "none", "processors": 1, "driver": "0", "CUDA": "0", "cupy": "0", "cuDSS": "absent", "copy TB/s": 2.0,
    "barrier us": 1.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def found() -> tuple[Beams, Any]:
    beams = Beams(Problem(540, MATERIALS[1]), device="cpu")
    return beams, rounds(beams, 2, 1)


def test_sizes_are_those_of_their_bars() -> None:
    assert all(tets == 6 * np.prod(cells) for tets, cells in BARS.items())


@pytest.mark.parametrize("problem", [Problem(540), Problem(540, MATERIALS[1]), Problem(3000, MATERIALS[0], 9)])
def test_scene_is_what_the_page_says(problem: Problem, tmp_path: Path) -> None:
    sim = Simulation(load(problem.write(tmp_path)))
    assert [len(b.mesh.tets) for b in sim.world.bodies] == [problem.tets] * problem.beams
    assert sim.world.free.sum() < sim.world.nodes and np.isclose(sim.world.mass.sum(), 4000 * problem.beams)
    young = [np.unique(sim.effects["corotational"].elastic[k][0]).round(3) for k in range(problem.beams)]
    if problem.material == MATERIALS[1]:
        np.testing.assert_allclose(young[0], [5e4, 2.5e5, 5e6])
    elif problem.beams == 1:
        np.testing.assert_allclose(young[0], [1e6])
    else:
        assert len({y[0] for y in young}) == 8 and young[8] == young[0] and np.isclose(max(young)[0], 2 * min(young)[0])


def test_rounds_use_factors_of_the_age_they_claim(found: tuple[Beams, Any]) -> None:
    beams, rounds_found = found
    records = np.concatenate(rounds_found.records)
    assert len(records) == 2 * STEPS
    np.testing.assert_array_equal(records["step"] - 1 - records["factor_step"], [*range(1, STEPS + 1)] * 2)
    one = row(beams, rounds_found)
    assert one["factor age"] == (STEPS + 1) / 2 and one["oldest"] == STEPS and one["unconverged"] == 0
    assert one["CG iterations"] > 3 * one["iterations"] > 0
    assert 0 < one["residual"] <= 1.001e-6
    json.dumps(one)


@pytest.mark.parametrize(("search", "made"), [(Search(2, 2, 1e-6), 2.0), (Search(4, 1, 1e-1), 1.0)])
def test_scenes_make_the_linearizations_that_they_need(search: Search, made: float) -> None:
    problem = Problem(540, law="stable_neo_hookean", dt=0.02)
    beams = Beams(problem, device="cpu", overrides=("solver.projection=clamp", *search.overrides))
    one = search_row(beams, search, rounds(beams, 1, 0))
    assert one["made"] == made and one["linearizations"] == search.most and 0 < one["us p50"] <= one["us p99"]
    assert {(s.most, s.needed) for s in SEARCHES} == {(1, 1), (4, 1), (2, 2), (4, 4)}


def test_steps_with_forces_once_more_and_without_a_loop_differ_by_these(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(nvrtc, "compiled", lambda *_: (b"code", ""))
    trial_of = ["pcg", "update_state", "elements", "nodes", "accept_trial"]

    def launches(cupy: Any) -> tuple[list[str], list[str]]:
        sim = Simulation(scene(bar((2, 1, 1), fixed="X < 0.01"), integrator={"linearizations": 4}), "gpu")
        cupy.ran.clear()
        sim.engine.assemble()
        first, cupy.ran[:] = [name(x) for x in cupy.ran if x[0] == "fused"], []
        sim.engine.solve()
        return first, [name(x) for x in cupy.ran]

    with fake_cupy.installed(tmp_path, None, monkeypatch) as cupy:
        assert launches(cupy) == (["elements", "nodes", "blocks"], [*trial_of, "end"])
        with trial.forces_twice():
            assert launches(cupy) == (["elements", "nodes"] * 2 + ["blocks"], [*trial_of, "end"])
        cupy.kernels["accept_trial"] = lambda arguments, loop: fake_cupy.go_on(loop, True) if loop else None
        with trial.without_loop():
            assert launches(cupy) == (["elements", "nodes", "blocks"], [*trial_of, "end"])


def test_factor_of_the_sample_is_that_of_its_matrix(found: tuple[Beams, Any]) -> None:
    sample = found[1].sample
    factor, order = lower(sample.pattern, sample.factor.astype(float)), sample.pattern.permutation
    matrix = sample.matrix().tocsc()[order][:, order]
    assert abs(factor @ factor.T - matrix).max() < 1e-6 * abs(matrix).max()
    assert sample.residual(np.zeros(sample.b.size)) == 1.0


def test_bytes_of_a_step() -> None:
    size = moved.Size(nodes=2, tets=1, blocks=4, upper=3, factor=1000)
    assert moved.matrix(size, 0) == 2 * 4 * 72 + 4 * (4 + 3)  # written, read once
    assert moved.matrix(size, 3) - moved.matrix(size, 2) == 4 * 72 + 4 * 7
    assert moved.vectors(size, 2) - moved.vectors(size, 1) == 13 * 2 * 3 * 8
    assert moved.factor(size, 5) == 5000
    parts = moved.step(size, 5)
    assert parts["all"] == pytest.approx(sum(v for k, v in parts.items() if k != "all"))


def test_percentiles_leave_out_steps_without_a_factor() -> None:
    from sim_server.backends.cpu.structs import RECORD

    records = np.zeros(4, RECORD)
    records["factor_step"], records["step"], records["whole"] = [-1, 0, 0, 0], [1, 2, 3, 4], [9, 1e-6, 2e-6, 3e-6]
    one = served_row(records)
    assert one["steps"] == 3 and one["us p50"] == pytest.approx(2) and one["factor age"] == 2 and one["oldest"] == 3


def piece(path: Path, rows: list[dict[str, Any]], **sections: Any) -> Path:
    header = {
        "date": "2026-01-01", "commit": path.stem, "machine": {"cpu": "fast", "cores": 1, "governor": "-", "load": 0.0,
        "system": "Linux"}, "versions": {"python": "3"},
        "calibration": {k: {"dgemm_ms": 1.0, "spmv_ms": 1.0} for k in ("before", "after")},
    }  # fmt: skip
    data = {"device": DEVICE, "steps": rows, "others": [], "served": [], "publishing": [], **sections}
    path.write_text(json.dumps({"header": header, "arguments": {"only": ["steps"]}, "data": data}))
    return path


def test_pieces_become_one_page(found: tuple[Beams, Any], tmp_path: Path) -> None:
    one = row(*found) | {"material": MATERIALS[0], "settings": ""}
    batch = one | {"beams": 512, "us p50": 1000.0}
    others = [{"tets": 540, "material": MATERIALS[0], "what": "cuDSS, float64", "settings": "", "us": 321.0}]
    served = [
        {"tets": 540, "material": MATERIALS[0], "worker": "cpu", "settings": "", "us p50": 77.0, "factor age": 12.0}
    ]
    search = {"tets": 3000, "linearizations": 1, "needed": 1, "tolerance": 1e-6, "us p50": 80.0, "settings": ""}
    searches = [search, search | {"linearizations": 2, "needed": 2, "tolerance": 0.1, "us p50": 100.0}]
    first = piece(
        tmp_path / "a.json", [one | {"us p50": 90.0}, batch], others=others, served=served, linearizations=searches,
        trial=[{"tets": 3000, "settings": "", "one, us": 80.0, "of one": 1.5}],
    )  # fmt: skip
    other = one | {"us p50": 11.5, "settings": "solver.threads=2"}
    second = piece(tmp_path / "b.json", [one | {"us p50": 22.5}, other])
    card = DEVICE | {"gpu": "other", "copy TB/s": 4.0}
    third = piece(tmp_path / "c.json", [one | {"us p50": 15.0}], device=card)
    gpu.merge([third, first, second], tmp_path / "out")
    text = (tmp_path / "out" / "gpu.md").read_text()
    lines = [line.split(" | ") for line in text.splitlines() if line.startswith("| 540 tets")]
    assert lines[0][1:5] == ["none", "45", "22.5", "0.5"] and "321" in lines[0]  # ours, over the aim of 45; direct
    assert lines[1][1:5] == ["other", "45", "15", "0.333"] and "321" not in lines[1]
    floors = table_under(text, "Bytes and latencies")
    assert {row["copy TB/s"] for row in floors if row["beams"] == "1"} == {"2", "4"}
    assert "| 512 beams of 540 | none | 500 | 1000 | 2 |" in text and "5.12e+05" not in text and "| 512000 |" in text
    assert text.count("| 540 tets | none |") == 1 and "| solver.threads=2 | 11.5 |" in text
    assert "pieces = 3" in text and "commit b" in text and "| 2026-01-01 | a | none | steps |" in text
    assert table_under(text, "With a worker process")[0]["us p50"] == "77"
    beside = table_under(text, "Several linearizations")
    assert [row["of one"] for row in beside if row["needed"] == "2"] == ["1.25"]
    assert text.index("Forces: what the kernels over elements") < text.index("| none | 3000 | 80 | 1.5 |")
    assert (tmp_path / "out" / "gpu.png").read_bytes().startswith(b"\x89PNG")
    again = json.loads((tmp_path / "out" / "gpu.json").read_text())
    assert page.merged([again["data"]]) == again["data"]
    aims = table_under(text, "Aims, homogeneous, us per step of all beams")  # what the README has of it
    assert aims[0]["**ours, p50**"] == "22.5" and aims[0]["direct each step, same GPU"] == "321"


@pytest.mark.system
def test_without_a_gpu_one_line_and_code_2(tmp_path: Path) -> None:
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-m", "tests.bench.gpu", "--out", str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.startswith("bench gpu: ") and result.stderr.count("\n") == 1


def test_what_was_measured_is_kept_when_a_later_scene_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def failed() -> dict[str, gpu.Rows]:
        raise RuntimeError("no memory")

    scenes = [("one", lambda: {"steps": [{"tets": 540}], "others": []}), ("two", failed),
              ("three", lambda: {"realtime": [{"tets": 24_000}]})]  # fmt: skip
    monkeypatch.setattr(gpu, "scenes", lambda o: scenes)
    monkeypatch.setattr("tests.bench.gpu.device.described", lambda: {"gpu": "none"})
    monkeypatch.setattr("tests.bench.gpu.cudss.version", lambda: "absent")
    kept: list[list[int]] = []
    data = gpu.measure(argparse.Namespace(set=["a=1"]), lambda d: kept.append([len(d["steps"]), len(d["realtime"])]))
    assert kept == [[1, 0], [1, 0], [1, 1]]
    assert data["steps"] == [{"settings": "a=1", "tets": 540}] and data["device"]["cuDSS"] == "absent"


def test_scenes_are_those_asked_for() -> None:
    o = argparse.Namespace(
        sizes=[540, 24_000], materials=["homogeneous"], beams=64, only=["steps", "batches", "realtime"]
    )
    names = [name for name, _ in gpu.scenes(o)]
    single = ["1 x 540 tets, homogeneous", "1 x 24000 tets, homogeneous"]
    assert names == [*single, "16 x 3000 tets, homogeneous", "64 x 3000 tets, homogeneous", "24000 tets in real time"]
