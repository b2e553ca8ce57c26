# SPDX-License-Identifier: MIT
"""sim-client plan: fronts, margins, refusals, and overlays that the server takes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from clients.__main__ import app
from clients.accuracy.points import Points
from clients.accuracy.runs import Run
from clients.accuracy.study import probe
from clients.accuracy.trajectories import Trajectory, save_trajectory
from clients.errors import BadInput
from clients.load_test.processes import free_endpoint
from clients.plan import overlay
from clients.plan.combinations import untried
from clients.plan.front import Budget, Exactness, Wish, bound, choose, front, wish_for
from clients.plan.measurements import Measurement, Measurements, read
from clients.plan.run import answer, measured, plan
from sim_server.scene import load
from tests.support.commands import in_turn

ROOT = Path(__file__).parents[2]
SCENE = """
dt = 0.02
solver = { preconditioner = "block_jacobi" }
[effects]
gravity = { g = [0, 0, -9.81] }
[[object]]
name = "beam"
mesh = { bar = [3, 1, 1], size = [3, 1, 1] }
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
fixed = { where = "X < 0.01" }
"""
EXPLICIT = "central_difference"
RESOLVED = {"dt": 0.02, "integrator": {"scheme": "backward_euler"}, "solver": {"preconditioner": "auto"}}


def row(settings: dict[str, str], error: float | None, seconds: float, p99: float, **more: Any) -> dict[str, Any]:
    """A point as in points.json."""
    step = {"p50": 0.8 * p99, "p99": p99, "max": 2 * p99}
    made = {
        "axis": " x ".join(settings), "settings": settings, "status": "done", "reason": "", "error": error,
        "rms": None if error is None else error / 3, "errors": {}, "seconds": seconds, "rounds": [seconds],
        "step_ms": step, "iterations": 4.5, "unconverged": 0,
    }  # fmt: skip
    return made | more


ROWS = [
    row({}, 3e-2, 0.05, 1.0),
    row({"solver.tolerance": "1e-2"}, 3.1e-2, 0.02, 0.4),
    row({"solver.tolerance": "1e-8"}, 3e-2, 0.08, 1.6),
    row({"dt": "0.005"}, 6e-3, 0.2, 1.0),
    row({"dt": "0.001"}, 1e-3, 1.1, 1.1),
    row({"integrator.scheme": "newmark", "dt": "0.005"}, 2e-4, 0.24, 1.2),
    row({"integrator.linearizations": "4"}, 2e-2, 0.18, 3.6),
    row({"integrator.scheme": "ros2"}, 1e-4, 0.9, 18.0),
    row({"integrator.scheme": "central_difference"}, None, 0.1, 1.0, status="diverged", reason="runaway"),
    row({"object.beam.mesh.bar": "[2, 1, 1]"}, 1e-6, 0.01, 0.1, axis="mesh", against="extrapolation"),
    row({"solver.warp": "false"}, None, 0.01, 0.1),
]


@pytest.fixture
def resolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves the server aside that tells the digest of a scene."""
    monkeypatch.setattr("clients.plan.run.probe", lambda scene, device: (Run("done", scene=RESOLVED), "made-up"))


def points_file(folder: Path, rows: list[dict[str, Any]] = ROWS, **more: Any) -> Path:
    """A folder with a scene and its points; returns the scene."""
    scene = folder / "beam.toml"
    scene.write_text(SCENE)
    (folder / "accuracy-beam").mkdir(exist_ok=True)
    found = {
        "version": 1, "scene": "beam.toml", "digest": "made-up", "device": "cpu", "duration": 1.0,
        "interval": 0.04, "machine": {"processor": "made-up", "cores": "2"},
        "reference": {"settings": {"dt": "1e-4"}, "uncertainty": 1e-5},
        "objects": {"beam": {"size": 3.0, "nodes": 16, "elements": 18}}, "points": rows,
        "sources": {"time step": 3e-2, "mesh": 4e-2}, "sentence": "The error of the time step dominates.",
        "left_out": [{"axis": "scheme", "settings": {"integrator.scheme": "bdf2"}, "reason": "no time"}],
    }  # fmt: skip
    (folder / "accuracy-beam" / "points.json").write_text(json.dumps(found | more))
    return scene


def made(name: str, error: float, seconds: float, p99: float) -> Measurement:
    settings = {} if name == "own" else {name: "1"}
    return Measurement(name, settings, error, seconds, seconds, p99, p99, p99, 1.0, 0)


def test_a_front_has_what_no_other_point_improves() -> None:
    a, b, c = made("a", 1e-1, 1, 1), made("b", 1e-2, 2, 1), made("c", 1e-3, 3, 1)
    worse = [made("as b, dearer", 1e-2, 2.5, 1), made("less exact, dearer", 0.5, 1.5, 1), made("as c", 1e-3, 3, 1)]
    cost = Exactness(1).cost
    assert front([c, *worse, a, b], cost, 0.0) == [a, b, c]
    assert front([c, a, b], cost, 2e-2) == [a, b]  # what is below the uncertainty is not told apart: the cheaper one
    assert (bound(c, 2e-2), bound(a, 2e-2)) == pytest.approx((4e-2, 0.12))


def test_a_budget_takes_the_most_exact_point_that_is_fast_enough_in_real_time() -> None:
    slow, fast = made("slow", 1e-4, 1.2, 1.0), made("fast", 1e-1, 0.1, 0.5)
    long, good = made("long", 1e-3, 0.5, 3.0), made("good", 1e-2, 0.9, 1.0)
    points = [slow, long, fast, good]
    found = choose(points, Budget(2), 0.0)
    assert (found.point, found.reached, found.cheaper, found.more_exact) == (good, True, fast, slow)
    assert choose(points, Budget(3), 0.0).point is long
    found = choose(points, Budget(0.1), 0.0)  # nothing is that fast: what needs least of it
    assert (found.point, found.reached, found.cheaper, found.more_exact) == (fast, False, None, slow)


def test_an_error_takes_the_cheapest_point_that_is_exact_enough_for_certain() -> None:
    a, b, c = made("a", 1e-1, 1, 1), made("b", 1e-2, 2, 1), made("c", 1e-3, 3, 1)
    found = choose([c, a, b], Exactness(1e-2), 0.0)
    assert (found.point, found.reached, found.cheaper, found.more_exact) == (b, True, a, c)
    assert choose([c, a, b], Exactness(1e-2), 1e-4).point is c  # b may be off by 1.01e-2
    found = choose([c, a, b], Exactness(1e-4), 0.0)
    assert (found.point, found.reached, found.cheaper, found.more_exact) == (c, False, b, None)


@pytest.mark.parametrize(
    ("budget", "position", "words"),
    [
        (None, None, "one of"), (1.0, 1.0, "one of"), (0.0, None, "--budget-ms 0"),
        (float("inf"), None, "--budget-ms inf"), (None, float("nan"), "--position nan"),
    ],
)  # fmt: skip
def test_wishes_are_checked(budget: float | None, position: float | None, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        wish_for(budget, position)


def chosen(folder: Path, wish: Wish) -> Any:
    """The answer for the points in a folder."""
    return answer(folder / "beam.toml", wish, folder / "accuracy-beam" / "points.json")[0]


@pytest.mark.usefixtures("resolved")
def test_an_answer_tells_what_was_measured(tmp_path: Path) -> None:
    points_file(tmp_path)
    told = chosen(tmp_path, Budget(2)).as_json()
    assert told["chosen"]["settings"] == {"integrator.scheme": "newmark", "dt": "0.005"} and told["reached"]
    assert told["cheaper"]["settings"] == {"dt": "0.005"} and told["more_exact"]["p99"] == 18.0
    assert told["as_it_is"]["settings"] == {} and told["as_it_is"]["error"] == 3e-2
    assert "measured on another machine (made-up): times differ on this one" in told["notes"]
    assert not told["more_exact"]["fits"] and told["uncertainty"] == 1e-5
    assert "p99 1.2 of 2 ms (40 % left), 0.24 of 1 s a simulated second (76 % left)" in told["notes"]
    assert any(note.startswith("measurements left out: 1 diverged, 1 of another body") for note in told["notes"])
    assert "the mesh is off by about 40 mm, which these settings do not change" in told["notes"]
    assert "settings that had no time to be measured: 1; sim-client accuracy goes on with them" in told["notes"]
    json.dumps(told, allow_nan=False)


@pytest.mark.usefixtures("resolved")
def test_an_unreachable_wish_names_the_nearest_point_and_writes_nothing(tmp_path: Path) -> None:
    scene = points_file(tmp_path)
    words = ["plan", str(scene), "--position", "1e-5", "--points", str(tmp_path / "accuracy-beam")]
    done = CliRunner().invoke(app, words)
    assert "none of 8 measured settings; the most exact ones: integrator.scheme=ros2" in done.stdout
    assert "- The error of the time step dominates." in done.stdout
    assert done.exit_code == 1 and done.stdout.endswith("nothing is written\n")
    assert json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)["reached"] is False
    assert not (tmp_path / "beam.plan.toml").exists()
    (tmp_path / "beam.plan.toml").write_text(f"# {overlay.MARK}\n")
    said = "".join(CliRunner().invoke(app, words).stdout.split())
    assert said.endswith(f"nothingiswritten;{tmp_path}/beam.plan.tomlisofanearlierchoice")
    found = chosen(tmp_path, Exactness(1.05e-4))  # measured 1e-4, but the reference is not that certain
    assert not found.choice.reached and any("a finer one could confirm it" in note for note in found.notes())


@pytest.mark.usefixtures("resolved")
def test_settings_measured_apart_are_named_but_not_proposed(tmp_path: Path) -> None:
    points_file(tmp_path)
    found = chosen(tmp_path, Exactness(7e-3))
    assert found.choice.point.settings == {"dt": "0.005"}
    assert found.untried[0] == {"solver.tolerance": "1e-2", "dt": "0.005"}
    assert any(note.startswith("measured apart but not together") for note in found.notes())
    points_file(tmp_path, [*ROWS, row(found.untried[0], 6.1e-3, 0.1, 0.4)])
    again = chosen(tmp_path, Exactness(7e-3))
    assert again.choice.point.settings == found.untried[0] not in again.untried


def test_a_table_and_what_is_in_it_are_not_combined() -> None:
    table, key = made("integrator", 1e-2, 1, 1), made("integrator.linearizations", 2e-2, 1, 1)
    other = made("dt", 1e-2, 1, 1)
    points = Measurements(Points("x"), [made("own", 1e-1, 1, 1), table, key, other], Counter(), None)
    wish = Exactness(1e-2)
    found = untried(points, wish, choose(points.usable, Exactness(1e-9), 0.0))
    assert found == [{"integrator": "1", "dt": "1"}, {"integrator.linearizations": "1", "dt": "1"}]


def test_what_explicit_steps_do_not_have_is_not_combined_with_them() -> None:
    own, explicit = made("own", 1e-1, 1, 1), replace(made("a", 1e-2, 1, 1), settings={"integrator.scheme": EXPLICIT})
    others = [made(key, 2e-2, 1, 1) for key in ("solver.tolerance", "accuracy.position", "integrator.linearizations")]
    points = Measurements(Points("x"), [own, explicit, *others, made("dt", 1e-2, 1, 1)], Counter(), None)
    wish = Exactness(1e-2)
    found = untried(points, wish, choose(points.usable, Exactness(1e-9), 0.0))
    assert [settings for settings in found if EXPLICIT in settings.values()] == [
        {"integrator.scheme": EXPLICIT, "dt": "1"}
    ]


@pytest.mark.usefixtures("resolved")
def test_combinations_are_measured_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, asked = points_file(tmp_path), []
    rest, times = {"beam": np.zeros((2, 3))}, np.arange(1, 3)
    still = Trajectory(times, rest, {"beam": np.zeros((2, 2, 3))})
    save_trajectory(still, tmp_path / "accuracy-beam" / "runs" / "reference.npz")

    def run_point(task: Any, settings: dict[str, str], workers: int, timeout: float, tick: Any) -> Run:
        asked.append(settings)
        tick()
        if len(asked) == 2:
            return Run("refused", "these do not go together")
        off = Trajectory(times, rest, {"beam": still.x["beam"] + [5e-3, 0, 0]})
        return Run("done", "", off, 0.01, {"p50": 0.1, "p99": 0.2, "max": 0.3}, 2.0)

    monkeypatch.setattr("clients.plan.measure.run_point", run_point)
    path = tmp_path / "accuracy-beam" / "points.json"
    found, _ = measured(scene, Exactness(7e-3), path, minutes=1)
    assert found.choice.point.settings == asked[0] == {"solver.tolerance": "1e-2", "dt": "0.005"}
    assert found.choice.point.error == pytest.approx(5e-3) and found.choice.point.axis == "combination"
    assert found.untried == [] and len(asked) == len({str(settings) for settings in asked})
    assert [left["settings"] for left in read(path).found.left_out[1:]] == asked[1:2]


@pytest.mark.usefixtures("resolved")
@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"digest": "of another scene"}, "measured of another scene"),
        ({"points": ROWS[-3:]}, "no measurement has come to its end"),
        ({"points": []}, "no measurement has come to its end"),
        ({"version": 2}, "no points of version 1"),
        ({"points": [row({"dt": "0.1\n#"}, 1.0, 1.0, 1.0)]}, "points that cannot be read.*setting dt"),
        ({"points": [row({"a b": "1"}, 1.0, 1.0, 1.0)]}, "points that cannot be read.*setting a b"),
        ({"points": [row({}, float("nan"), 1.0, 1.0)]}, "points that cannot be read: point 1: error = nan is"),
        ({"points": [row({}, -1.0, 1.0, 1.0)]}, "no finite number of at least 0"),
        ({"left_out": [1]}, "points that cannot be read"),
        ({"points": 3}, "points that cannot be read"),
        ({"reference": 3}, "points that cannot be read"),
    ],
)
def test_what_is_no_measurement_of_this_scene_is_refused(tmp_path: Path, more: dict[str, Any], words: str) -> None:
    scene = points_file(tmp_path, **more)
    with pytest.raises(BadInput, match=words) as error:
        chosen(tmp_path, Budget(2))
    if {"digest", "points"} & more.keys() and "cannot" not in words and "finite" not in words:
        assert str(error.value).endswith(f"first: sim-client accuracy {scene}")


def test_files_that_are_no_points(tmp_path: Path) -> None:
    for text in (b"", b"[]", b"{}", b"3", b"\xff"):
        (tmp_path / "points.json").write_bytes(text)
        with pytest.raises(BadInput, match=r"points\.json"):
            read(tmp_path / "points.json")


def test_an_overlay_gives_the_scene_that_the_settings_give(tmp_path: Path) -> None:
    scene = tmp_path / "beam.toml"
    scene.write_text(SCENE)
    for settings in (
        {"dt": "5e-3", "solver.preconditioner": "cholesky", "accuracy.position": "0.1 %", "solver.warp": "false"},
        {"object.beam.mesh": "{ bar = [2, 1, 1], size = [3, 1, 1] }", "object.beam.mesh.size": "[3, 2, 1]"},
        {"object.beam.effects.fixed.where": 'X < 0.01 and "', "solver.update": "every-3", "effects.gravity": "true"},
        {"integrator": "{ scheme = 'bdf2' }", "dt": "0.01"},
        {},
    ):
        text = overlay.overlay_text(settings, [overlay.MARK, "", "é"])
        (tmp_path / "overlay.toml").write_text(text)
        assert ("\nset = [" in text) == any("{" in value for value in settings.values()), text
        wanted, given = [f"{key}={value}" for key, value in settings.items()], [f"@{tmp_path / 'overlay.toml'}"]
        assert loaded(scene, given) == loaded(scene, wanted)


def loaded(scene: Path, overrides: list[str]) -> Any:
    """The scene, or what is wrong with it, without the name of an overlay."""
    from sim_server.errors import InputError

    try:
        return load(scene, overrides).resolved()
    except InputError as error:
        return str(error).replace(f" with overlay {overrides[0][1:]}", "")


@pytest.mark.usefixtures("resolved")
def test_another_file_is_left_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, where = points_file(tmp_path), tmp_path / "accuracy-beam"
    assert plan(scene, Budget(2), where, None, 0, as_json=False)
    assert plan(scene, Budget(2), where, None, 0, as_json=True)  # its own one is replaced
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["overlay"] == str(tmp_path / "beam.plan.toml")  # auto was measured with a worker
    assert told["use"] == f"sim-server {scene} --device cpu --workers 1 --set @{told['overlay']}"
    with pytest.raises(BadInput, match="was not written by this command"):
        plan(scene, Budget(2), where, scene, 0, as_json=False)
    for to, words in ((tmp_path / "no" / "x.toml", "no such folder"), (tmp_path, "Is a directory")):
        with pytest.raises(BadInput, match=words):
            plan(scene, Budget(2), where, to, 0, as_json=False)
    assert scene.read_text() == SCENE


@pytest.mark.system
def test_the_command_and_a_server_that_takes_the_overlay(tmp_path: Path) -> None:
    scene = points_file(tmp_path)
    points_file(tmp_path, digest=probe(scene, "cpu")[1])
    where, points = str(scene), ("--points", str(tmp_path / "accuracy-beam"))
    ended = in_turn("clients", [
        ("plan", where, "--budget-ms", "2", *points),
        ("plan", where),
        ("plan", str(tmp_path / "gone.toml"), "--budget-ms", "2"),
        ("plan", where, "--budget-ms", "2", "--points", str(tmp_path / "no")),
        ("plan", where, "--budget-ms", "2", "--measure", "nan"),
    ])  # fmt: skip
    good, *wrong = ended.values()
    assert good[0] == 0 and "integrator.scheme=newmark dt=0.005" in good[1] and "more exact" in good[1], good
    unclear, gone, unmeasured, no_time = (err for code, _, err in wrong if code == 2)
    assert "give one of" in unclear and "gone.toml: no such file" in gone and "--measure nan" in no_time
    assert f"first: sim-client accuracy {where}" in unmeasured
    text = (tmp_path / "beam.plan.toml").read_text()
    assert text.startswith(f"# {overlay.MARK}") and "error 0.0002 m (+- 1e-05 m)" in text and "made-up" in text
    use = next(line.split(": ", 1)[1] for line in text.splitlines() if line.startswith("# Use: "))
    command = [sys.executable, "-m", "sim_server", *use.split()[1:], "--steps", "2", "--listen", free_endpoint()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done
    assert "dt 0.005 s" in done.stdout and "2 steps" in done.stdout, done
