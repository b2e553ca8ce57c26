# SPDX-License-Identifier: MIT
"""What bench accuracy makes of its rows: orders, the source that dominates, effectivity, its sentences and its page."""

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients.accuracy.trajectories import shared_nodes
from tests.bench.accuracy import axes, page, short, sources
from tests.bench.accuracy.cases import BANDS, BEAM, CASES, EXPLICIT, FLOOR, RUBBER, SMALL, accepts, damped_by, usual
from tests.bench.accuracy.effectivity import judged
from tests.bench.accuracy.motion import Motion, distances, error, extrapolated, move, rms
from tests.bench.accuracy.peers import MODULES, US, missing, ways
from tests.bench.accuracy.units import KEYS, units
from tests.bench.harness.pieces import Merged, Piece, Row
from tests.bench.harness.report import Report

UNITS = {device: units(device, 1, False, None) for device in ("cpu", "gpu")}


def moved(interval: float, ends: list[float], rest: Any = ((0.0, 0.0, 0.0),), status: str = "done") -> Motion:
    """A body that goes along x; ends: how far it is at each interval."""
    x = np.array(rest)
    frames = np.array([x + np.array([end, 0.0, 0.0]) for end in ends])
    return Motion(interval, frames, x, 1, np.empty(0), "cpu", status)


def point(series: str, value: str, error: float | None, seconds: float, **more: object) -> Row:
    return {
        "device": "cpu", "scene": RUBBER.name, "axis": axes.SCHEME, "series": series, "value": value,
        "settings": {"dt": value.split()[0]}, "status": "diverged" if error is None else "done", "reason": "",
        "error": error, "rms": error, "apart": 1e-6, "step error": None, "solve error": None,
        "length": 4.0, "seconds": seconds,
        "rounds": [seconds], "step_ms": {"p50": 1.0, "p99": 2.0, "max": 3.0}, "iterations": 5.0, "linearizations": 1.0,
        "unconverged": 0, "tets": 3000, **more,
    }  # fmt: skip


def step(series: str, value: str, error: float, iterations: float, seconds: float) -> Row:
    return point(series, value, 0.04, seconds, axis=axes.STEPS, iterations=iterations) | {"step error": error}


def scheme(name: str, order: int) -> list[Row]:
    return [point(name, f"{ms:g} ms", 0.16 * (ms / 40) ** order, 4.0 / ms) for ms in (40.0, 20.0, 10.0, 5.0)]


# --- what is made of motions ------------------------------------------------------------------------------------------


def test_motions_are_compared_at_the_times_and_nodes_that_both_have() -> None:
    fine, coarse = moved(0.01, [1.0, 2.0, 3.0, 4.0]), moved(0.02, [2.5, 4.5])
    assert distances(fine, coarse).ravel() == pytest.approx([0.5, 0.5]) and error(fine, coarse) == pytest.approx(0.5)
    more = moved(0.02, [2.0, 5.0], [(9.0, 0, 0), (0.0, 0, 0)])
    first, second = shared_nodes(coarse.rest, more.rest)
    assert (first.tolist(), second.tolist()) == ([0], [1])
    assert error(coarse, more) == pytest.approx(0.5) and rms(coarse, more) == pytest.approx(0.5)
    assert error(moved(0.02, [1.0], status="diverged"), coarse) is None


def test_two_time_steps_of_first_order_are_extrapolated() -> None:
    assert extrapolated(moved(0.01, [1.1]), moved(0.01, [1.2])).frames.ravel()[0] == pytest.approx(1.0)


def test_order_is_the_slope_between_neighbours_above_the_floor() -> None:
    sizes = [1.0, 2.0, 4.0, 8.0]
    assert sources.orders(sizes, [1e-4 * h**2 for h in sizes]) == pytest.approx([2, 2, 2])
    assert sources.orders(sizes, [1e-4, 2e-4, None, 8e-4]) == pytest.approx([1, 1])
    assert sources.orders(sizes, [1e-4 * h for h in sizes], floor=1e-4) == pytest.approx([1])
    assert sources.orders([1.0], [1e-3]) == []


def test_order_of_a_scheme_is_read_off_its_points() -> None:
    line = page.order_line(scheme("Newmark, 3 linearizations", 2))
    assert line is not None and line["p at the smallest"] == pytest.approx(2) and line["should be"] == 2
    assert page.order_line([point("Newmark", "20 ms", None, 1.0)]) is None
    assert page.order_line(scheme("explicit substeps", 2)) is None
    assert axes.order_of("backward Euler, 4 linearizations") == 1 and axes.order_of("ros2, factor") == 2


def test_the_largest_source_dominates_and_the_model_is_told_apart() -> None:
    found = {"linear solve": 1e-8, "linearization": 2e-2, "time step": 5e-2, "mesh": 1e-2, "model": 9e-2}
    said = sources.sentence("beam", found)
    assert said.startswith(
        "beam: the time step dominates with 50 mm (linearization 20 mm, mesh 10 mm, linear solve 10 nm)"
    )
    assert "a smaller `dt`" in said and said.endswith(
        "Another law moves it by 90 mm, more than any of these: be sure of the law."
    )
    assert "law" not in sources.sentence("beam", found | {"model": 1e-3})
    assert "a finer mesh" in sources.sentence("beam", {"mesh": 1e-3, "time step": None})
    assert sources.sentence("beam", {"model": 1.0, "mesh": None}) == "beam: no source is known."


@pytest.mark.parametrize(
    ("metres", "words"), [(1.25, "1.2 m"), (0.048, "48 mm"), (0.9951, "995 mm"), (3.2e-6, "3.2 um"), (2.6e-7, "260 nm")]
)
def test_lengths_are_said_in_a_unit_that_fits(metres: float, words: str) -> None:
    assert sources.length(metres) == words


def test_effectivity_is_of_steps_with_an_estimate_and_more_than_rounding() -> None:
    found = judged(np.array([1.0, 4.0, np.nan, 9.0]), np.array([2.0, 2.0, 2.0, 1e-20]), 1e-15)
    assert (found["steps"], found["median"], found["least"], found["most"]) == (2, 1.25, 0.5, 2.0)
    assert judged(np.array([np.nan]), np.array([1.0]), 0.0)["median"] is None


# --- sentences --------------------------------------------------------------------------------------------------------


def test_the_cheapest_exact_enough_is_told_here_and_of_others() -> None:
    points = [*scheme("backward Euler", 1), *scheme("Newmark", 2), point("BDF2", "40 ms", None, 0.01)]
    said = short.what_it_costs(points)
    assert "takes 0.2 s (Newmark, 20 ms) with an error of 1 % of the length; 0.8 s (Newmark, 5 ms) with" in said
    assert said.endswith("backward Euler gets to 20 mm with 0.8 s (5 ms).")
    peers = [row | {"who": US, "E MPa": 1.0} for row in points]
    peers += [point("RK4", "2 ms", 1e-3, 2.0, **{"who": "MuJoCo", "E MPa": 1.0})]
    assert "0.8 s here (Newmark, 5 ms) and 2 s by the cheapest of others (MuJoCo RK4, 2 ms)" in short.beside_others(
        peers
    )
    said = short.what_it_costs([*points, point("explicit substeps", "20 ms", 1e-3, 0.1)])
    assert "(explicit substeps, 20 ms) with an error of 0.1 % of the length, by implicit steps 0.8 s (N" in said
    assert short.what_it_costs([]) == short.beside_others(peers[-1:]) == ""


def test_a_bound_in_metres_is_set_beside_fixed_settings_at_least_as_exact() -> None:
    rows = [
        step("1", "1e-1", 3e-2, 1.6, 0.1), step("2", "1e-1", 8e-4, 3.5, 0.2), step("2", "1e-6", 9e-4, 15.0, 0.3),
        step("4", "1e-1", 1e-5, 7.0, 0.35), step("position", "1e-3 m", 9e-4, 3.9, 0.25),
    ]  # fmt: skip
    (said,) = short.position_sentence(rows)
    assert "error of the steps 900 um" in said
    assert said.endswith("of 3 fixed settings at least as exact 1 need fewer iterations and 1 less time.")


# --- units and page ---------------------------------------------------------------------------------------------------


def test_a_unit_has_a_name_of_its_own_and_a_gpu_has_fewer() -> None:
    names = [unit.name for several in UNITS.values() for unit in several]
    assert len(set(names)) == len(names)
    assert {unit.table for unit in UNITS["cpu"]} == set(KEYS)
    assert {unit.table for unit in UNITS["gpu"]} == {"points", "effectivity", "peers"}
    assert not any("drop tolerance" in unit.name for unit in UNITS["gpu"])


@pytest.mark.parametrize(("case", "device"), [(FLOOR, "gpu"), *((case, "cpu") for case in CASES)])
def test_points_are_told_apart_and_their_scene_accepts_them(case: Any, device: str) -> None:
    there = [p for several in axes.points(case, device, quick=False).values() for p in several]
    assert len({(p.axis, p.series, p.value) for p in there}) == len(there)
    last = {(p.axis, p.series): p for p in there}.values()
    assert not [p for p in last if not accepts(case, p.settings) or not accepts(case, p.truth or {})]


def test_explicit_substeps_have_no_solver_and_other_laws_take_the_place_of_the_scenes() -> None:
    assert usual(EXPLICIT) == EXPLICIT | {"solver.preconditioner": "none"}
    assert all(accepts(case, usual(EXPLICIT)) for case in (BEAM, BANDS, RUBBER))
    assert BEAM.with_law(BEAM.law) == {} and "false" in BANDS.with_law("stable_neo_hookean").values()
    assert FLOOR.stepped(FLOOR.dt) == {} and FLOOR.stepped(0.005) == {"dt": "0.005"}


def test_the_reference_damps_as_the_scheme_does() -> None:
    exact = {"object.beam.effects.corotational.tangent": "exact"}
    ros2, several = axes.SCHEMES["ros2, factor"], axes.SCHEMES["Newmark, 3 linearizations"]
    assert damped_by(BANDS, usual(ros2)) == damped_by(BANDS, usual(axes.SCHEMES["Newmark"])) == exact
    assert damped_by(BANDS, usual(several)) is damped_by(BANDS, usual()) is damped_by(BEAM, usual(ros2)) is None


def test_what_a_scene_refuses_is_a_failed_point() -> None:
    found = move(SMALL, {"dt": "-1"})
    assert found.status == "failed" and "dt" in found.reason


def test_a_peer_that_is_not_there_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    there = [unit.name for unit in units("cpu", 1, False, None) if unit.table == "peers"]
    assert there and all(name.startswith(("peers ours", "peers SciPy")) for name in there)
    said = capsys.readouterr().out
    assert all(f"peers {who}: left out, no --peer-python" in said for who in MODULES)
    assert missing(Path(sys.executable), "no_such_module") == "no no_such_module there"
    assert {way.who for way in ways(1e6)} == {way.who for way in ways(1e7)} == set(MODULES)


def test_pieces_become_a_page_with_its_table_of_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    monkeypatch.setattr(Report, "figure", lambda self, figure, file, caption: drawn.append(file))  # it is slow to save
    found = {"linear solve": 1e-8, "linearization": 2e-2, "time step": 5e-2, "mesh": None, "model": 9e-2}
    of_sources = [
        {"scene": RUBBER.name, "source": name, "compared": "", "error": value, "length": 4.0, "all together": 4e-2,
         "apart": 1e-6} for name, value in found.items()
    ]  # fmt: skip
    tables = {
        "points": [*scheme("backward Euler", 1), point("explicit substeps", "40 ms", None, 0.1),
                   step("1", "1e-6", 3e-2, 7.2, 0.1), step("position", "1e-3 m", 9e-4, 3.9, 0.2)],
        "sources": of_sources,
        "meshes": [{"scene": "beam", "cells across": n, "tets": 24 * n**3, "h m": 1 / n, "length": 4.0,
                    "rms to the next finer": 1.0 / n**2, "largest": 2.0 / n**2} for n in (2, 4)],
        "effectivity": [{"device": "cpu", "scene": "beam", "way": "1", "estimate": "solve_error", "settings": {},
                         **judged(np.ones(3), np.ones(3), 0.0)}],
        "peers": [point("RK4", "2 ms", 1e-3, 2.0, who="MuJoCo", version="MuJoCo 4", notes="") | {"E MPa": 1.0}],
    }  # fmt: skip
    for k, names in enumerate((("points", "sources"), ("meshes", "effectivity", "peers"))):
        piece = Piece("accuracy", "Accuracy", {"device": "cpu"}, tmp_path / str(k), quick=True)
        piece.data |= {name: tables[name] for name in names}
        piece.keep()
    files = [tmp_path / str(k) / "accuracy.json" for k in (0, 1)]
    merged = Merged("accuracy", "Accuracy", files, tmp_path)
    page.write(merged, {name: merged.rows(name, keys) for name, keys in KEYS.items()})
    text = (tmp_path / "accuracy.md").read_text()
    assert drawn == ["accuracy.png", "accuracy_sources.png", "accuracy_neo-Hookean_beam.png"]
    order = ("## In short", "## Errors by source", "## Tolerance and linearizations", "## Orders in time",
             "## Work and precision", "### Not done", "## Order in the mesh", "## How good the estimates")  # fmt: skip
    places = [text.index(title) for title in order]
    assert places == sorted(places)
    assert "Not measured here: Newton, PyBullet, Genesis." in text
    assert (
        "| neo-Hookean beam | backward Euler | 1 | 1 |" in text
        and "| beam | 4 | 1536 | 1.6e-02 | 3.1e-02 | 2 | 2 |" in text
    )
    lines = list(csv.DictReader((tmp_path / "accuracy.csv").open()))
    assert len(lines) == 8 and lines[0]["settings"] == "--set dt=40" and lines[4]["status"] == "diverged"
