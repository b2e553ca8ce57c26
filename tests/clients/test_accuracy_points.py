# SPDX-License-Identifier: MIT
"""sim-client accuracy: known answers of distances, errors by source and whole studies of made-up motion."""

from __future__ import annotations

import csv
import io
import json
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients.accuracy import study
from clients.accuracy.axes import SceneValues, candidates, mesh_settings, toml
from clients.accuracy.command import accuracy, report, write
from clients.accuracy.curves import at_the_edge, curves
from clients.accuracy.errors import add_round, order_of_convergence, point_of
from clients.accuracy.points import Point, Points, Settings, load, save, set_words, to_csv, to_dict
from clients.accuracy.runs import Run, Task, command, read_run
from clients.accuracy.sources import best, errors_by_source, mesh_error, sentence
from clients.accuracy.study import Study, task_of
from clients.accuracy.trajectories import Trajectory, distance, extrapolate, load_trajectory, save_trajectory
from clients.errors import BadInput, ClientError
from clients.log.reader import Log
from tests.sample_run import record

SIZE = 2.0  # m, of the made-up body
LINEAR, ONE_LINEARIZATION, OF_TIME, OF_MESH = 1e-2, 1e-3, 4.0, 0.5
SCENE = """\
dt = 0.02
[[object]]
name = "bar"
mesh = { bar = [2, 2, 4], size = [1, 1, 2] }
[object.effects]
corotational = { young = 1e6, poisson = 0.3 }
"""
RESOLVED = {
    **tomllib.loads(SCENE),
    "integrator": {"scheme": "backward_euler", "linearizations": 1, "tolerance": 1e-4, "trials": 8, "solve": "auto"},
    "solver": {"tolerance": 1e-6, "preconditioner": "block_jacobi", "precision": "float64", "budget": 0.0},
}
ORDERS = {"backward_euler": 1, "bdf2": 2, "newmark": 2}


def trajectory(moved: float, times: int = 3, cells: int = 2) -> Trajectory:
    """A line of nodes along x; at time k the one at the end has moved by `moved` k / times, the others by less."""
    rest = np.zeros((cells + 1, 3))
    rest[:, 0] = np.linspace(0, SIZE, cells + 1)
    x = np.array(
        [rest + [[0, moved * k / times * share / SIZE, 0] for share in rest[:, 0]] for k in range(1, times + 1)]
    )
    return Trajectory(np.arange(1, times + 1), {"bar": rest}, {"bar": x})


def test_a_distance_is_that_of_the_worst_node_and_time() -> None:
    found = distance(trajectory(1.0), trajectory(0.4))
    assert found.error == pytest.approx(0.6) and found.errors == {"bar": pytest.approx(0.6)}
    squares = [(0.6 * k / 3 * share) ** 2 for k in (1, 2, 3) for share in (0, 0.5, 1)]
    assert found.rms == pytest.approx(np.sqrt(np.mean(squares)))
    assert distance(trajectory(1.0), trajectory(1.0)).error == 0


def test_meshes_are_compared_at_the_nodes_that_both_have() -> None:
    assert distance(trajectory(1.0, cells=2), trajectory(0.5, cells=8)).error == pytest.approx(0.5)
    assert distance(trajectory(1.0, cells=6), trajectory(0.5, cells=4)).error == pytest.approx(0.5)
    elsewhere = trajectory(1.0)
    elsewhere.rest["bar"][:] += 0.1
    assert np.isnan(distance(elsewhere, trajectory(1.0)).error)
    goal = extrapolate(trajectory(1.0, cells=4), trajectory(0.9, cells=2), trajectory(1.2, cells=8), 2.0)
    assert distance(goal, trajectory(1.6)).error == pytest.approx(0, abs=1e-12) and len(goal.rest["bar"]) == 3


def test_only_common_times_count(tmp_path: Path) -> None:
    short = Trajectory(np.array([2]), trajectory(1.0).rest, {"bar": trajectory(1.0).x["bar"][1:2]})
    assert distance(short, trajectory(0.4)).error == pytest.approx(0.6 * 2 / 3)
    save_trajectory(short, tmp_path / "runs" / "a.npz")
    kept = load_trajectory(tmp_path / "runs" / "a.npz")
    assert kept is not None and distance(kept, short).error == 0 and kept.times.tolist() == [2]
    (tmp_path / "runs" / "b.npz").write_bytes(b"PK\x03\x04 cut")
    assert load_trajectory(tmp_path / "runs" / "b.npz") is None is load_trajectory(tmp_path / "none.npz")


def test_a_log_is_read_as_a_run(tmp_path: Path) -> None:
    with Log(record(tmp_path / "a.mcap", 8)) as log:
        run = read_run(log, 0.04)
    assert run.status == "done" and run.trajectory is not None
    assert run.trajectory.times.tolist() == [1, 2, 3, 4], "every second step"
    assert run.seconds == pytest.approx(4e-3 / 0.02) and run.unconverged == 1
    assert run.step_ms == {"p50": pytest.approx(4), "p99": pytest.approx(4), "max": pytest.approx(4)}
    assert run.iterations == pytest.approx(np.mean([3 + step % 5 for step in range(1, 9)]))
    assert run.elements == {"beam": 2}
    np.testing.assert_allclose(run.trajectory.x["beam"][-1][1], [1.08, 0, 0])
    with Log(record(tmp_path / "b.mcap", 3)) as log:
        assert read_run(log, 1.0).status == "failed", "no frame at a common time"


def test_what_is_far_off_or_not_finite_has_diverged() -> None:
    far = point_of("tolerance", {}, Run("done", "", trajectory(25.0), 1.0), trajectory(1.0), {"bar": SIZE})
    assert (far.status, far.reason) == ("diverged", "bar: 12 times its size off") and far.error == 24
    lost = trajectory(np.nan)
    none = point_of("tolerance", {}, Run("diverged", "not finite", lost, 1.0), trajectory(1.0), {"bar": SIZE})
    assert none.error is None and none.seconds == 1.0 and none.status == "diverged"
    late = point_of("dt", {}, Run("timed out", "not over after 3 s"), trajectory(1.0), {"bar": SIZE})
    assert (late.status, late.seconds, late.rounds) == ("timed out", None, [])


def test_times_are_the_median_over_rounds() -> None:
    point = Point("tolerance", {}, "done", seconds=3.0, rounds=[3.0], step_ms={"p50": 3.0})
    add_round(point, Run("done", seconds=1.0, step_ms={"p50": 1.0}))
    assert point.seconds == 2.0
    add_round(point, Run("done", seconds=2.0, step_ms={"p50": 2.0}))
    assert point.seconds == 2.0 and point.rounds == [3.0, 1.0, 2.0] and point.step_ms == {"p50": 2.0}


def test_richardson_finds_order_and_error_of_a_mesh() -> None:
    meshes = {h: trajectory(1 - 0.1 * h**2, cells=round(4 / h)) for h in (2, 1, 0.5)}
    found = mesh_error(meshes[2], meshes[1], meshes[0.5])
    assert found == (pytest.approx(0.1), pytest.approx(2.0))
    assert mesh_error(None, meshes[1], meshes[0.5]) == (pytest.approx(0.1), 2.0)
    assert mesh_error(meshes[2], meshes[1], None) == (pytest.approx(0.1), 2.0)
    assert mesh_error(None, meshes[1], None) is None
    grows = mesh_error(trajectory(0.95, cells=2), meshes[1], meshes[0.5])
    assert grows == (pytest.approx(0.075), None), "at least the change to the finer mesh"
    assert order_of_convergence(0.4, 0.1) == 2 and order_of_convergence(0.1, 0.4) is None


def made_up(task: Task, settings: Settings, *_: object) -> Run:
    """A run whose error is the sum of known parts; it begins where the exact motion has moved the end by 1 m."""
    if "accuracy.position" in settings:
        return Run("refused", "accuracy: unknown key")
    scheme = settings.get("integrator.scheme", "backward_euler")
    if scheme not in ORDERS:
        return Run("failed", "sim-server ended with code 1")
    if settings.get("dt") == "0.08":
        return Run("timed out", "not over after 9 s")
    dt, order = float(settings.get("dt", 0.02)), ORDERS[scheme]
    error = OF_TIME * dt**order + LINEAR * float(settings.get("solver.tolerance", 1e-6))
    error += ONE_LINEARIZATION * (settings.get("integrator.linearizations", "1") == "1")
    cells = json.loads(settings.get("object.bar.mesh.bar", "[2, 2, 4]"))
    error += OF_MESH * (SIZE / cells[2]) ** 2
    error += 0.01 * any("neo_hookean" in key for key in settings)
    if settings.get("solver.tolerance") == "1e-1":
        error = 50.0
    run = Run("done", "", trajectory(1 + error, round(task.duration / task.interval), cells[2]), 0.1 * 0.02 / dt)
    run.step_ms, run.iterations, run.scene, run.device = {"p50": 1.0, "p99": 2.0, "max": 3.0}, 5.0, RESOLVED, "cpu"
    run.elements = {"bar": 96}
    return run


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(study, "run_point", lambda task, settings, *a, **k: made_up(task, settings))
    path = tmp_path / "bar.toml"
    path.write_text(SCENE)
    return path


def study_of(scene: Path, minutes: float = 60, duration: float = 1.0, out: Path | None = None) -> Points:
    return Study(scene, out or scene.parent / "out", duration, "auto", lambda done, what: None).run(minutes)


def test_a_study_finds_each_source_of_a_known_error(scene: Path) -> None:
    found = study_of(scene)
    assert found.sources["linear solve"] == pytest.approx(LINEAR * 1e-6, rel=2e-2)
    assert found.sources["linearization"] == pytest.approx(ONE_LINEARIZATION, rel=1e-6)
    assert found.sources["time step"] == pytest.approx(OF_TIME * 0.02, rel=1e-3)
    assert found.sources["mesh"] == pytest.approx(OF_MESH * 0.25, rel=1e-6)
    assert found.sources["model"] == pytest.approx(0.01, rel=1e-6)
    assert found.sentence.startswith(
        "The error of the mesh dominates with 125 mm (linear solve 10 nm, linearization 1 mm"
    )
    assert 0 < found.reference["uncertainty"] < 1e-5
    own = found.point({})
    assert own is not None and own.error == pytest.approx(OF_TIME * 0.02 + ONE_LINEARIZATION, rel=1e-3)
    assert own.rounds == [0.1, 0.1, 0.1] and own.step_ms == {"p50": 1.0, "p99": 2.0, "max": 3.0}
    fine = found.point({"object.bar.mesh.bar": "[4, 4, 8]"})
    assert fine is not None and "extrapolated" in fine.against
    assert fine.error == pytest.approx(OF_MESH / 16 + OF_TIME * 0.02 + ONE_LINEARIZATION, rel=1e-2)
    second = found.point({"integrator.scheme": "bdf2"})
    assert second is not None and second.error == pytest.approx(OF_TIME * 4e-4 + ONE_LINEARIZATION, rel=1e-2)


def test_sources_beyond_a_missing_run_are_told_together() -> None:
    runs = {"linear solve": trajectory(1.3), "linearization": trajectory(1.2), "time step": trajectory(1.0)}
    found, rest = errors_by_source(trajectory(1.6), runs)
    assert list(found.values()) == [pytest.approx(0.3), pytest.approx(0.1), pytest.approx(0.2), None, None]
    assert rest is None
    found, rest = errors_by_source(trajectory(1.6), {**runs, "linearization": None})
    assert found["linear solve"] == pytest.approx(0.3) and rest == pytest.approx(0.3)
    assert found["linearization"] is None is found["time step"], "not all of it is due to the time step"
    assert errors_by_source(None, runs)[1] is None is errors_by_source(trajectory(1), {"time step": None})[1]
    told = sample()
    told.sources = dict.fromkeys(told.sources) | {"linear solve": 1e-6}
    assert sentence(told, ["linearization", "time step", "mesh"], 0.1).startswith(
        "The errors of linearization and time step together are the largest measured, with 100 mm "
        "(linear solve 1 um, mesh not measured); "
    )
    told.sources["mesh"], told.at_least = 0.4, ["mesh"]
    assert sentence(told).startswith("The error of the mesh dominates with at least 400 mm (linear solve 1 um): ")


def test_a_scene_without_a_point_beside_it_blames_no_source(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "candidates", lambda values, size: [])
    found = study_of(scene)
    assert set(found.sources.values()) == {None}
    assert found.sentence == (
        "The errors of linear solve and linearization and time step together are the largest measured, with 81 mm "
        "(mesh not measured)."
    )


def test_budgets_of_wall_time_end_no_exact_run() -> None:
    hurried = values(solver={"budget_ms": 1.0})
    for settings in (hurried.exact_solves(), hurried.exact_steps(), *hurried.references(4)):
        assert float(settings["solver.budget_ms"]) == 1e9 and "solver.budget" not in settings
    assert "solver.budget_ms" not in values().exact_steps()


def references_of(monkeypatch: pytest.MonkeyPatch, wall: float = 1.0, doubtful: str = "nothing") -> list[float]:
    """Makes references take `wall` seconds, or the time that they may; returns a list that takes the latter.

    doubtful: in the settings of runs whose solves do not converge
    """
    now, limits = [0.0], []
    monkeypatch.setattr(study.time, "monotonic", lambda: now[0])

    def run_point(task: Task, settings: Settings, workers: int = 0, limit: float = 99.0, *_: object, **__: Any) -> Run:
        run = made_up(task, settings)
        if "solver.max_iterations" in settings and "dt" in settings:
            limits.append(limit)
            run.wall = min(wall, limit)
            run.unconverged = 3 * (doubtful in str(settings))
            if limit < wall:
                run.status, run.trajectory = "timed out", None
        now[0] += run.wall
        return run

    monkeypatch.setattr(study, "run_point", run_point)
    return limits


def test_a_reference_that_is_not_solved_is_no_reference(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    references_of(monkeypatch, doubtful="'integrator.linearizations': '20'")
    found = study_of(scene)
    assert found.reference["settings"]["integrator.linearizations"] == "1" and found.reference["unconverged"] == 0
    assert "did not reach" not in found.sentence


def test_where_no_reference_is_solved_it_is_told(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    references_of(monkeypatch, doubtful="max_iterations")
    found = study_of(scene)
    assert found.reference["settings"]["dt"] == "0.0025" and found.reference["unconverged"] == 6
    assert found.sentence.endswith("; 6 solves of the reference did not reach their tolerance.")


def test_finer_references_end_when_their_time_is_over(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = references_of(monkeypatch, wall=40.0)
    study_of(scene, 10)
    assert limits[:2] == [600, 560] and limits[2] == 0.35 * 600 - 80 and len(limits) == 4, "until 35 % are gone"
    assert sum(limit < 560 for limit in limits) == 2, "there is no time for a fifth one"


def test_references_are_kept_as_they_come(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = references_of(monkeypatch)
    run_point = study.run_point

    def cut(task: Task, settings: Settings, *arguments: Any, **more: Any) -> Run:
        if settings.get("dt") == "0.00125":
            raise KeyboardInterrupt
        return run_point(task, settings, *arguments, **more)

    monkeypatch.setattr(study, "run_point", cut)
    with pytest.raises(KeyboardInterrupt):
        study_of(scene)
    assert load(scene.parent / "out" / "points.json").reference["settings"]["dt"] == "0.0025" and len(limits) == 2
    study_of(scene)
    assert len(limits) == 2


def test_a_rough_reference_is_made_finer_when_there_is_time(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = references_of(monkeypatch)
    monkeypatch.setattr(study, "PARTS", (4, 8))
    study_of(scene)
    path = scene.parent / "out" / "points.json"
    rough = load(path)
    rough.reference["uncertainty"] = 1.0
    monkeypatch.setattr(study, "PARTS", (4, 8, 16))
    save(rough, path)
    short = study_of(scene, 0.1)
    assert short.reference == rough.reference and len(limits) == 2, "no time for it"
    fine = study_of(scene)
    assert len(limits) == 3 and fine.reference["settings"]["dt"] == "0.00125" and "rough" not in fine.sentence
    assert len(fine.points) == len(rough.points) and fine.reference["uncertainty"] < 1e-3
    own, before = fine.point({}), rough.point({})
    assert own is not None and before is not None and own.error != before.error, "points are measured again"


def test_the_scene_is_on_the_line_of_its_meshes(scene: Path) -> None:
    found = study_of(scene)
    line = next(curve for curve in curves(found) if curve.axis == "mesh")
    assert line.joined and line.label == "mesh, from the extrapolated reference"
    assert [p.settings.get("object.bar.mesh.bar") for p in line.points] == ["[1, 1, 2]", None, "[4, 4, 8]"]
    assert line.points[1].error == pytest.approx(OF_MESH / 4 + OF_TIME * 0.02 + ONE_LINEARIZATION, rel=1e-2)
    assert line.points[1].against == line.points[0].against != "reference"


def test_failures_are_points_and_refusals_are_not(scene: Path) -> None:
    found = study_of(scene)
    assert {p.status for p in found.points} == {"done", "diverged", "failed", "timed out"}
    wild = found.point({"solver.tolerance": "1e-1"})
    assert wild is not None and wild.status == "diverged" and wild.error == pytest.approx(50, rel=1e-2)
    assert found.point({"integrator.scheme": "ros2"}) is not None
    refused = [left for left in found.left_out if left["axis"] == "position"]
    assert len(refused) == 1 and refused[0]["reason"] == "accuracy: unknown key", "the axis is asked for once"
    assert {left["axis"] for left in found.left_out} == {"position", "time step and position", "precision"}


def test_a_study_that_is_cut_off_goes_on(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[Settings] = []

    def cut(task: Task, settings: Settings, *_: object, **__: object) -> Run:
        runs.append(settings)
        if len(runs) == 12:
            raise KeyboardInterrupt
        return made_up(task, settings)

    monkeypatch.setattr(study, "run_point", cut)
    with pytest.raises(KeyboardInterrupt):
        study_of(scene)
    kept = load(scene.parent / "out" / "points.json")
    assert 1 < len(kept.points) < 8 and kept.reference["uncertainty"] is not None
    whole = study_of(scene)
    assert to_dict(whole)["points"][: len(kept.points)] != [] and len(whole.points) > 20
    assert [p.settings for p in whole.points[: len(kept.points)]] == [p.settings for p in kept.points]
    assert [p.error for p in whole.points[: len(kept.points)]] == [p.error for p in kept.points]
    first = runs[:12]
    assert sum("100000" in s.get("solver.max_iterations", "") and "dt" in s for s in runs[12:]) == 0, (
        "no reference again"
    )
    assert all(runs[12:].count(s) == 2 for s in first[-3:-1]), "only for further rounds"
    runs.clear()
    assert to_dict(study_of(scene)) == to_dict(whole) and len(runs) == 3, "the scene is read, refusals asked again"


def test_what_took_too_long_is_tried_again_when_there_is_more_time(scene: Path) -> None:
    late = next(p for p in study_of(scene, 20).points if p.status == "timed out")
    assert late.settings == {"dt": "0.08"} and late.limit == 60 * 20 * study.LONGEST_SHARE
    assert study_of(scene, 10).point(late.settings) == late
    again = study_of(scene, 40).point(late.settings)
    assert again is not None and again.limit == 2 * late.limit


def test_a_short_time_leaves_the_rest_for_the_next_call(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(study.time, "monotonic", lambda: now[0])

    def slow(task: Task, settings: Settings, *_: object, **__: object) -> Run:
        now[0] += 10
        run = made_up(task, settings)
        run.wall = 10
        return run

    monkeypatch.setattr(study, "run_point", slow)
    with pytest.raises(ClientError, match="no two references could be made"):
        monkeypatch.setattr(study, "REFERENCE_SHARE", 0.0)
        monkeypatch.setattr(study, "PARTS", (4,))
        study_of(scene, 1)
    monkeypatch.setattr(study, "PARTS", (4, 8))
    found = study_of(scene, 2)
    late = [left for left in found.left_out if left["reason"] == study.NO_TIME]
    assert late and len(found.points) < 12
    again = study_of(scene, 30)
    assert not [left for left in again.left_out if left["reason"] == study.NO_TIME]
    assert len(again.points) > len(found.points)


def test_points_are_drawn_as_they_were_measured(scene: Path) -> None:
    def drawn() -> Points:
        return Study(scene, scene.parent / "out", None, "auto", lambda done, what: None).run(0)

    with pytest.raises(BadInput, match=r"points\.json: no such file, so there is nothing to draw"):
        drawn()
    found = study_of(scene, duration=2.0)
    again = drawn()
    assert again.duration == found.duration and again.interval == found.interval and again.points == found.points
    assert (again.sources, again.sentence) == (found.sources, found.sentence)


def test_bad_input_leaves_no_folder(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = scene.parent / "new"
    with pytest.raises(BadInput, match="is a folder, allowed is a scene"):
        accuracy(scene.parent, out, 1.0, 1.0, "cpu", False)
    with pytest.raises(BadInput, match="4 time steps of the scene"):
        accuracy(scene, out, 1.0, 0.01, "cpu", False)
    with pytest.raises(BadInput, match="nothing to draw"):
        accuracy(scene, out, 0.0, 1.0, "cpu", False)
    monkeypatch.setattr(study, "run_point", lambda *a, **k: Run("refused", "dt = -1"))
    with pytest.raises(BadInput, match="dt = -1"):
        accuracy(scene, out, 1.0, 1.0, "cpu", False)
    assert not out.exists()
    with pytest.raises(BadInput, match="cannot be made"):
        monkeypatch.undo()
        monkeypatch.setattr(study, "run_point", lambda task, settings, *a, **k: made_up(task, settings))
        study_of(scene, out=scene / "out")


def test_what_the_first_start_compiles_takes_none_of_the_time(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, compiled = [0.0], []
    monkeypatch.setattr(study.time, "monotonic", lambda: now[0])

    def run_point(task: Task, settings: Settings, *_: object, **__: object) -> Run:
        now[0] += 0.1 if compiled else 100.0
        compiled.append(True)
        return made_up(task, settings)

    monkeypatch.setattr(study, "run_point", run_point)
    found = study_of(scene, 1)
    assert len(found.points) > 20 and study.NO_TIME not in {left["reason"] for left in found.left_out}


def test_points_of_something_else_are_refused(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study_of(scene)
    with pytest.raises(BadInput, match=r"they are of 0\.96 s simulated; give another --out, or remove the folder"):
        study_of(scene, duration=0.5)
    monkeypatch.setattr(study, "machine", lambda software: {"processor": "another one"})
    with pytest.raises(BadInput, match="points of another machine"):
        study_of(scene)
    monkeypatch.undo()

    def changed(task: Task, settings: Settings, *_: object, **__: object) -> Run:
        run = made_up(task, settings)
        run.scene = {**RESOLVED, "dt": 0.02, "effects": {"gravity": {"g": [0, -1, 0]}}}
        return run

    monkeypatch.setattr(study, "run_point", changed)
    with pytest.raises(BadInput, match="the scene has changed since"):
        study_of(scene)


@pytest.mark.parametrize(
    ("run", "said"),
    [
        (Run("refused", "dt = -1: must be above 0"), "dt = -1: must be above 0"),
        (Run("failed", "no compiler"), "bar.toml: could not be run: no compiler"),
    ],
)
def test_a_scene_that_does_not_run(scene: Path, monkeypatch: pytest.MonkeyPatch, run: Run, said: str) -> None:
    monkeypatch.setattr(study, "run_point", lambda *a, **k: run)
    with pytest.raises((BadInput, ClientError), match=said):
        study_of(scene)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"minutes": -1.0}, "--minutes -1: allowed is 0"),
        ({"minutes": float("nan")}, "--minutes nan: allowed"),
        ({"duration": 0.0}, "--duration 0: allowed is above 0"),
        ({"device": "tpu"}, "--device tpu: allowed are auto, cpu, gpu"),
        ({"scene": Path("none.toml")}, "none.toml: no such file"),
    ],
)
def test_bad_arguments(tmp_path: Path, arguments: dict[str, Any], said: str) -> None:
    given = {"scene": Path("a.toml"), "minutes": 1.0, "duration": 1.0, "device": "cpu"} | arguments
    with pytest.raises(BadInput, match=said):
        accuracy(given["scene"], tmp_path, given["minutes"], given["duration"], given["device"], False)


def test_times_are_compared_that_all_time_steps_reach() -> None:
    task = task_of(Path("a.toml"), 0.02, 1.0, "cpu")
    assert task.interval == pytest.approx(0.08) and task.duration == pytest.approx(0.96)
    long = task_of(Path("a.toml"), 0.001, 10.0, "cpu")
    assert long.duration / long.interval == pytest.approx(24, abs=1) and long.duration == pytest.approx(10, rel=0.05)
    words = command(task, {"dt": "0.01", "integrator": '{ scheme = "bdf2" }'}, 1, Path("l"), "tcp/127.0.0.1:1")
    assert words[words.index("--steps") + 1] == "96" and "record.every=8" in words
    assert 'integrator={ scheme = "bdf2" }' in words and words[words.index("--workers") + 1] == "1"
    with pytest.raises(BadInput, match=r"--duration 0\.05: allowed is 0\.08 s at least"):
        task_of(Path("a.toml"), 0.02, 0.05, "cpu")


def values(device: str = "cpu", **changes: dict[str, Any]) -> SceneValues:
    table = {**RESOLVED, **{key: {**RESOLVED.get(key, {}), **change} for key, change in changes.items()}}
    return SceneValues(table, device)


def test_settings_are_those_that_the_server_takes(tmp_path: Path) -> None:
    """Every candidate and reference of a scene is a valid scene, but for keys that this version does not have."""
    from sim_server.errors import InputError
    from sim_server.scene import load as load_scene

    path = tmp_path / "a.toml"
    path.write_text(SCENE + '[integrator]\nscheme = "newmark"\nbeta = 0.3\n[solver]\nbudget = 1.0\n')
    resolved = load_scene(path).resolved()
    known = SceneValues(resolved, "cpu")
    wanted = [c.settings for c in candidates(known, SIZE)] + known.references(4)
    unknown = []
    for settings in wanted:
        try:
            load_scene(path, [f"{key}={value}" for key, value in settings.items()])
        except InputError as error:
            unknown.append((settings, str(error)))
    assert len(wanted) > 30
    for settings, said in unknown:
        new = "accuracy.position" in settings or "generalized_alpha" in str(settings)
        budget = "solver.budget" in said  # of the scene, which some settings do not go with
        assert new or budget, (settings, said)
    assert {"integrator"} <= {key for settings in wanted for key in settings}, "beta belongs to newmark"


def test_axes_follow_the_scene() -> None:
    axes = {c.axis for c in candidates(values(), SIZE)}
    assert {"tolerance", "linearizations", "time step", "scheme", "position", "mesh", "model", "drop tolerance"} <= axes
    assert "precision" in {c.axis for c in candidates(values("gpu"), SIZE)}
    explicit = {c.axis for c in candidates(values(integrator={"scheme": "central_difference"}), SIZE)}
    assert explicit == {"time step", "scheme", "mesh", "model", "scheme and time step"}
    static = {c.axis for c in candidates(values(integrator={"scheme": "quasi_static"}), SIZE)}
    assert not static & {"scheme", "scheme and time step"}
    first = [c.axis for c in candidates(values(), SIZE)][:6]
    assert first == ["tolerance", "linearizations", "tolerance", "linearizations", "time step", "time step"]
    assert not values().wants_workers({"solver.preconditioner": "cholesky", "solver.update": "every-3"})
    assert values().wants_workers({"solver.preconditioner": "cholesky"}) and not values().wants_workers({})
    assert not values().wants_workers({"solver.preconditioner": "auto", "integrator.scheme": "central_difference"})


def test_bars_are_refined_and_laws_carried_over() -> None:
    assert mesh_settings(values(), fine=True) == {"object.bar.mesh.bar": "[4, 4, 8]"}
    assert mesh_settings(values(), fine=False) == {"object.bar.mesh.bar": "[1, 1, 2]"}
    odd = SceneValues({**RESOLVED, "object": [{"name": "a", "mesh": {"bar": [3, 2, 2]}}]}, "cpu")
    assert mesh_settings(odd, fine=False) == {} and mesh_settings(odd, fine=True) == {"object.a.mesh.bar": "[6, 4, 4]"}
    models = [c.settings for c in candidates(values(), SIZE) if c.axis == "model"]
    assert models == [
        {
            "object.bar.effects.stable_neo_hookean": "{ young = 1000000.0, poisson = 0.3 }",
            "object.bar.effects.corotational": "false",
        }
    ]
    regions = [{"where": 'X < 1 and "a"', "young": 1e5}, {"young": 2.0}]
    assert tomllib.loads(f"v = {toml({'young': regions, 'on': True})}")["v"] == {"young": regions, "on": True}


def sample() -> Points:
    """Points with everything in them: failures, names that are not harmless, several objects."""
    points = [
        Point(
            "scene", {}, "done", "", 0.1, 0.05, {"<b>": 0.1, "c": 0.01}, 2.0, [2.0], {"p50": 1, "p99": 2, "max": 3}, 9.0
        ),
        Point("tolerance", {"solver.tolerance": "1e-2"}, "done", "", 0.1, 0.05, {}, 0.5, [0.5], None, 3.0),
        Point("time step", {"dt": "0.01"}, "done", "", 0.04, 0.02, {}, 4.0, [4.0], None, 3.0),
        Point(
            "scheme",
            {"integrator": '{ scheme = "bdf2" }'},
            "diverged",
            "<script>alert(1)</script>",
            None,
            None,
            {},
            3.0,
        ),
        Point("pairs", {"dt": "1"}, "timed out", "not over after 3 s"),
        Point("age", {"dt": "2"}, "failed", "killed", float("nan")),
    ]
    found = Points(
        "<i>.toml", "ab", 1.0, 0.1, {"dt": "0.02"}, "cpu", {"processor": "p", "cores": "2"},
        {"settings": {}, "uncertainty": 1e-4},
    )  # fmt: skip
    found.objects = {"<b>": {"size": 1.0, "nodes": 3, "elements": 1}, "c": {"size": 1.0, "nodes": 3, "elements": 1}}
    found.points = points
    found.left_out = [{"axis": "position", "settings": {"accuracy.position": "1"}, "reason": "unknown <key>"}]
    found.sources = {"linear solve": 1e-6, "linearization": None, "time step": 0.1, "mesh": None, "model": 0.3}
    found.sentence = sentence(found)
    return found


def test_the_sentence_names_the_first_change_and_what_is_cheaper() -> None:
    assert sample().sentence == (
        "The error of the time step dominates with 100 mm (linear solve 1 um): take a smaller time step or a scheme "
        "of second order (dt, integrator.scheme), for example --set dt=0.01, which is 40 mm off instead of 100 mm and "
        "takes 2 times the time; --set solver.tolerance=1e-2 is as exact as the scene and takes 0.25 times the time; "
        "another law of the material moves it by 300 mm, more than any of these: be sure of the law."
    )
    rough = sample()
    rough.reference["uncertainty"] = 0.09
    assert sentence(rough).endswith("; the reference itself is uncertain by 90 mm, so all this is rough.")
    failed = sample()
    failed.points[0].status, failed.points[0].reason = "diverged", "bar: runaway"
    assert sentence(failed) == "The scene's own settings do not work (bar: runaway): change them first."
    assert sentence(Points("a")) == "No error could be told by its source."
    assert best(sample().points, sample().points[0], ("scheme",), 1.0) is None
    exact = Point("scheme", {"integrator.scheme": "ros2"}, "done", "", 1e-3, 1e-3, {}, 0.52, [0.52])
    points = [*sample().points, exact]
    assert best(points, points[0], ("scheme", "tolerance"), 1.0) is exact, "4 % dearer and far more exact"
    coarse = sample()
    coarse.points = [coarse.points[0], Point("time step", {"dt": "0.04"}, "done", "", 0.1, 0.1, {}, 0.5, [0.5])]
    assert "dt=0.04" not in sentence(coarse), "not in one breath with a smaller time step"


def test_points_json_keeps_the_contract(tmp_path: Path) -> None:
    save(sample(), tmp_path / "points.json")
    table = json.loads((tmp_path / "points.json").read_text())
    assert set(table) >= {
        "version", "scene", "digest", "duration", "device", "machine", "reference", "objects", "points", "sources",
        "sentence",
    }  # fmt: skip
    assert table["version"] == 1 and set(table["reference"]) == {"settings", "uncertainty"}
    assert set(table["points"][0]) >= {
        "axis", "settings", "status", "reason", "error", "rms", "errors", "seconds", "rounds", "step_ms", "iterations",
        "unconverged",
    }  # fmt: skip
    assert table["points"][5]["error"] is None, "not a number is null"
    again = load(tmp_path / "points.json")
    assert to_dict(again) == table
    for text in ("{", "[]", '{"version": 2}', '{"version": 1}', '{"version": 1, "points": [1], "scene": "a"}'):
        (tmp_path / "points.json").write_text(text)
        with pytest.raises(BadInput, match=r"points\.json: "):
            load(tmp_path / "points.json")
    wrong_points = [
        ("status", "weird"), ("settings", None), ("settings", {"dt": 1}), ("error", "x"), ("error", True),
        ("step_ms", 3), ("step_ms", {"p99": None}), ("rounds", None), ("unconverged", 1.5), ("seconds", 10**400),
    ]  # fmt: skip
    wrong = [
        ("reference", None), ("reference", {}), ("left_out", [1]), ("left_out", [{"axis": "a"}]), ("machine", None),
        ("objects", {"bar": 1}), ("sources", {"mesh": "x"}), ("duration", "1"), ("points", {}),
    ]  # fmt: skip
    tables = [(f"point 1: {key} = ", {**table, "points": [{**table["points"][0], key: v}]}) for key, v in wrong_points]
    tables += [(f"points: {key} = ", {**table, key: value}) for key, value in wrong]
    for said, changed in tables:
        (tmp_path / "points.json").write_text(json.dumps(changed))
        with pytest.raises(BadInput, match=rf"points\.json: points that cannot be read: ({said}|int too large)"):
            load(tmp_path / "points.json")


def test_words_and_table_repeat_a_point() -> None:
    assert set_words({"dt": "0.01", "integrator": '{ scheme = "bdf2" }'}) == (
        "--set dt=0.01 --set 'integrator={ scheme = \"bdf2\" }'"
    )
    rows = list(csv.DictReader(io.StringIO(to_csv(sample()))))
    assert [row["status"] for row in rows].count("done") == 3 and rows[2]["settings"] == "--set dt=0.01"
    assert rows[0]["error/<b>"] == "0.1" and rows[0]["p99_ms"] == "2" and rows[4]["error_m"] == ""


def test_lines_follow_the_value_that_differs() -> None:
    found = sample()
    found.points.append(Point("time step", {"dt": "0.04"}, "done", "", 0.3, 0.1, {}, 3.0, [3.0]))
    drawn = {curve.axis: [p.settings.get("dt") for p in curve.points] for curve in curves(found)}
    assert drawn["time step"] == ["0.01", None, "0.04"], "the scene has 0.02"
    assert next((p.status, error) for p, error, _ in at_the_edge(found)) == ("diverged", pytest.approx(0.6))


def test_the_page_opens_alone_and_escapes_what_it_shows(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    from clients.accuracy.page import render

    text = render(sample())
    assert "<script src=" not in text and "<link" not in text, "nothing comes from a network"
    assert "<script>alert(1)" not in text and "unknown &lt;key&gt;" in text and "<title>&lt;i&gt;.toml" in text
    assert 'data-words="--set dt=0.01"' in text and "Plotly.newPlot" in text
    assert render(Points("a")).endswith("</html>\n")
    assert '"text":"reference","x":-4.0' in text and text.count('"name":"timed out","showlegend":true') == 1
    assert "(p, 2 cores)" in text


def test_without_plotly_the_rest_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    missing = write(sample(), tmp_path)
    (why,) = missing
    assert why.startswith("accuracy.html is not written: plotly is not installed, of the extra view: ")
    assert (tmp_path / "accuracy.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "points.csv").read_text().startswith("axis,settings,status")
    assert not (tmp_path / "accuracy.html").exists()


def test_the_report_fits_a_terminal(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from rich.console import Console

    found = sample()
    exact = {"solver.tolerance": "1e-9", "integrator.linearizations": "20", "integrator.tolerance": "1e-9"}
    times = {"p50": 1.0, "p99": 0.0634, "max": 3.0}
    found.points.append(Point("linearizations and", exact, "done", "", 8.87e-4, 0.1, {}, 8.87e-4, [3.0], times, 0.0271))
    Console(width=80).print(report(found, tmp_path))
    said = capsys.readouterr().out
    assert "…" not in said and "..." not in said
    assert re.search(r"linearizations *solver.tolerance=1e-9 *0.00089 *0.00089 *0.0634 *0.0271\b", said), said
    assert "diverged" in said and "dt=0.01" in said and "left out: position (position=1): unknown <key>" in said
    assert max(map(len, said.splitlines())) <= 80
