# SPDX-License-Identifier: MIT
"""What bench rosenbrock makes of its points: the cheapest time step for an error, ratios, pieces put together."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.bench.harness.pieces import Merged
from tests.bench.rosenbrock import page
from tests.bench.rosenbrock.bars import EULER, ROS2_FACTOR, Bar, Row, run
from tests.bench.rosenbrock.precision import OURS, cheapest, cost_at, methods_for
from tests.bench.rosenbrock.stability import groups
from tests.bench.rosenbrock.units import KEYS


def line(method: str, order: int, first: float, cost: float, **more: object) -> list[Row]:
    """Points of a method of an order: its error at 40 ms and what a step costs [ms]."""
    return [
        {"method": method, "dt ms": dt, "error / L": first * (dt / 40) ** order, "ms / s": 1e3 * cost / dt, **more}
        for dt in (40.0, 20.0, 10.0, 5.0)
    ]


def test_cost_lies_on_the_line_between_two_time_steps() -> None:
    points = line("one", 2, 1.6e-2, 1.0)
    assert cost_at(points, 1e-3) == pytest.approx(100)  # a measured one, at 10 ms
    assert cost_at(points, 2e-3) == pytest.approx(1e3 / (40 * np.sqrt(2e-3 / 1.6e-2)))
    assert cost_at(points, 0.5) == pytest.approx(25)  # the cheapest is exact enough
    assert np.isnan(cost_at(points, 1e-5))
    points[0]["error / L"] = None  # ran away
    assert cost_at(points, 0.5) == pytest.approx(50)


def test_a_large_time_step_that_costs_more_is_not_taken() -> None:
    points = line("one", 2, 1.6e-2, 1.0)
    points[0]["ms / s"] = 80.0  # made again, so that it is dearer than that at 20 ms
    assert cost_at(points, 0.5) == pytest.approx(50)
    assert cost_at(points, 2e-3) == pytest.approx(1e3 / (40 * np.sqrt(2e-3 / 1.6e-2)))


def test_errors_near_the_difference_of_the_references_are_left_out() -> None:
    points = line(OURS.name, 2, 1.6e-2, 1.0, apart=2e-4) + line("euler", 1, 2e-2, 1.0, apart=2e-4)
    assert [row["error / L"] for row in cheapest(points)] == ["3e-02", "1e-02", "3e-03", "1e-03"]


def test_ratio_is_that_of_the_best_other_scheme() -> None:
    points = [
        *line("euler", 1, 2e-2, 1.0, apart=1e-6), *line("newmark", 2, 8e-3, 4.0, apart=1e-6),
        *line(OURS.name, 2, 1.6e-2, 1.0, apart=1e-6), *line("ros2, iterate", 2, 1.6e-2, 1.5, apart=1e-6),
    ]  # fmt: skip
    costs = {row["error / L"]: row for row in cheapest(points)}
    assert costs["3e-02"]["best other"] == "euler" and costs["3e-02"]["best other / ros2"] == pytest.approx(1)
    assert costs["1e-03"]["best other"] == "newmark"
    assert costs["1e-03"]["best other / ros2"] == pytest.approx(4 / np.sqrt(2))
    assert not np.isfinite(costs["1e-04"]["best other / ros2"])


def test_ours_and_backward_euler_are_among_the_methods_of_every_size() -> None:
    for tets in (540, 3000, 24_000):
        names = [method.name for method in methods_for(tets)]
        assert OURS.name in names and any(name.startswith("backward Euler") for name in names)
        assert len(set(names)) == len(names)


def test_cases_of_stability_are_told_apart_by_their_rows() -> None:
    for name, cases in groups().items():
        rows = [{"device": "cpu", "varied": name, **case.row()} for case in cases]
        assert len({tuple(row[key] for key in KEYS["stability"]) for row in rows}) == len(cases)


def test_runs_have_factors_from_the_first_step_on_and_of_the_age_they_claim() -> None:
    for method in (EULER, ROS2_FACTOR.aged(3)):
        one = run(Bar(162), method, 0.02, 0.4)
        age = one.records["step"] - 1 - one.records["factor_step"]
        assert len(one.records) == 20 and one.frames.shape == (10, one.sim.world.nodes, 3) and one.well
        assert (
            age[0] == 0 and age.max() <= 2 * method.latency - 1 and (age[2 * method.latency :] >= method.latency).all()
        )
    assert one.share("FACTOR") > 0.8


def test_pieces_become_one_page(tmp_path: Path) -> None:
    more = {"device": "cpu", "tets": 540, "material": "one E", "E MPa": 1.0, "apart": 1e-6, "seconds": 2.0}
    header = {
        "date": "2026-01-01", "commit": "a", "machine": {"cpu": "fast", "cores": 1, "governor": "-", "load": 0.0,
        "system": "Linux"}, "versions": {"python": "3"},
        "calibration": {k: {"dgemm_ms": 1.0, "spmv_ms": 1.0} for k in ("before", "after")},
    }  # fmt: skip
    pieces = []
    for name, points in (("a", line(OURS.name, 2, 1.6e-2, 1.0, **more)), ("b", line("newmark", 2, 8e-3, 4.0, **more))):
        data = {"precision": points}
        file = tmp_path / f"{name}.json"
        file.write_text(json.dumps({"header": header, "arguments": {"only": [name]}, "data": data}))
        pieces.append(file)
    merged = Merged("rosenbrock", "Both", pieces, tmp_path / "out")
    page.write(merged, {name: merged.rows(name, keys) for name, keys in KEYS.items()})
    text = (tmp_path / "out" / "rosenbrock.md").read_text()
    assert f"| {OURS.name} | 1.6e-02, 25 | 4.0e-03, 50 |" in text and "| newmark | 8.0e-03, 100 |" in text
    assert (tmp_path / "out" / "rosenbrock.png").exists()
