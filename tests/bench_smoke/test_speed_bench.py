# SPDX-License-Identifier: MIT
"""The comparison of two checkouts: what a side answers, and what the page makes of rows."""

from typing import Any

import pytest

from tests.bench.harness.report import ROOT
from tests.bench.speed.__main__ import UNITS, groups
from tests.bench.speed.page import KEYS, of_runs, summary
from tests.bench.speed.targets import TARGETS
from tests.bench.speed.turns import Side, percentiles


def row_of(unit: str) -> dict[str, Any]:
    """What tells the row of a unit apart, but for threads and settings."""
    kind, tets, *rest = unit.split(":")
    row: dict[str, Any] = {"what": "motion" if kind == "vbd" else kind, "tets": int(tets)}
    if kind == "steps":
        material = next((word for word in rest if word.isalpha()), "homogeneous")
        row |= {"material": material, "beams": next((int(word) for word in rest if word.isdigit()), 1)}
    return row | ({"beams": int(rest[0])} if kind in ("many", "swinging") else {})


def test_units_measure_what_is_aimed_at() -> None:
    there = [row_of(unit) for unit in UNITS]
    for target in TARGETS:
        assert set(target.where) <= set(KEYS)
        where = {name: value for name, value in target.where.items() if name not in ("threads", "settings")}
        assert [row for row in there if where.items() <= row.items()], target.what


def test_a_row_tells_both_sides_and_whether_the_goal_is_met() -> None:
    steps = {"what": "steps", "tets": 98_304, "material": "homogeneous", "beams": 1}
    many = {"what": "many", "tets": 540, "beams": 512}
    rows = [
        {**steps, "side": "before", **percentiles([1.0] * 99 + [3.0])},
        {**steps, "side": "after", **percentiles([0.5] * 99 + [0.7])},
        {**many, "side": "after", "factors/s": 4999.0},
    ]
    batch, beam = summary(rows)
    assert beam["before"].startswith("1 / ") and beam["before"].endswith(" / 3")
    assert beam["now"].startswith("0.5 / ") and beam["met"] == "yes"
    assert (batch["before"], batch["now"], batch["met"]) == ("–", "4,999", "no")
    rows[1] |= {"p50": 0.6}
    assert summary(rows)[1]["met"] == "no"
    large = {"what": "steps", "tets": 405_600, "material": "homogeneous", "beams": 1, "side": "after"}
    both = [{**large, **percentiles([4.0])}, {**large, "settings": "solver.gpus=2", **percentiles([2.0])}]
    assert [row["met"] for row in summary(both)] == [row["met"] for row in summary(both[::-1])] == ["no", "yes"]


def test_a_gain_is_one_of_a_run() -> None:
    batch = {"what": "steps", "tets": 3000, "material": "homogeneous", "beams": 256}
    many = {"what": "many", "tets": 540, "beams": 512}
    first = [
        {**batch, "side": "before", "p50": 3.0, "p99": 4.0, "max": 5.0},
        {**many, "side": "before", "factors/s": 20.0},
        {**many, "side": "after", "factors/s": 900.0},
    ]
    second = [{**batch, "side": "after", "p50": 2.0, "p99": 4.0, "max": 5.0}]
    parts = [{"data": {"rows": first}}, {"data": {"rows": second}}]
    of_runs(parts)
    rows = [row for part in parts for row in part["data"]["rows"]]
    assert [row["run"] for row in rows] == [1, 1, 1, 2]
    factors, steps = summary(rows)
    assert (factors["gain"], factors["gain aimed at"]) == ("45 x", "33.3 x")
    assert (steps["gain"], steps["gain aimed at"]) == ("–", "1.4 x"), "the machine of one run may be slower"
    rows[-1]["run"] = 1
    assert summary(rows)[1]["gain"] == "1.5 x"


def test_servers_are_measured_one_by_one() -> None:
    sides: Any = {"before": object(), "after": object()}
    assert groups(sides, "steps:540") == [sides]
    assert groups(sides, "real_time:540") == [{"before": sides["before"]}, {"after": sides["after"]}]


def test_a_side_says_what_went_wrong_and_goes_on() -> None:
    side = Side(ROOT)
    try:
        with pytest.raises(RuntimeError, match=r"KeyError: 'nobody'"):
            side("run", name="nobody", steps=1)
        bar = {"text": (ROOT / "deploy/scenes/sofa_beam.toml").read_text(), "device": "cpu"}
        side("load", name="beam", overrides=["object.beam.mesh.bar=[1, 1, 2]"], **bar)
        assert len(side("run", name="beam", steps=3)["ms"]) == 3
    finally:
        side.close()
