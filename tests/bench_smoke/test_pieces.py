# SPDX-License-Identifier: MIT
"""Benchmarks cut into pieces: what is merged, what is added up, what a limit leaves out."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.bench.faults import page as faults_page
from tests.bench.harness.pieces import Limit, Merged, Piece
from tests.bench.scaling import page as scaling_page


def piece(folder: Path, name: str, **data: Any) -> Path:
    """JSON of a piece as it is left after each row."""
    report = Piece(name, "Title", {"objects": [1, 4]}, folder, quick=True)
    report.data.update(data)
    report.keep()
    return folder / f"{name}.json"


def scaled(objects: int, device: str, throughput: float) -> dict[str, Any]:
    names = ("step ms p50", "step ms p99", "age p50, steps", "age max, steps", "age p50, ms")
    return {"objects": objects, "server": device, "workers": 2, "workers on": device, "object-steps/s": throughput,
            **{name: 1.0 for name in names}}  # fmt: skip


def test_pieces_of_two_devices_stand_side_by_side_and_the_later_row_counts(tmp_path: Path) -> None:
    one = piece(tmp_path / "a", "scaling", rows=[scaled(1, "cpu", 10.0), scaled(4, "cpu", 20.0)])
    two = piece(tmp_path / "b", "scaling", rows=[scaled(4, "cpu", 30.0), scaled(4, "gpu", 40.0)])
    merged = Merged("scaling", "Title", [one, two], tmp_path / "out")
    rows = merged.rows("rows", scaling_page.KEYS)
    assert [r["object-steps/s"] for r in rows] == [10.0, 30.0, 40.0]
    scaling_page.write(merged, rows)
    text = (tmp_path / "out/scaling.md").read_text()
    line = next(x for x in text.splitlines() if x.startswith("| 4 | 2 | 30 | 40 |"))
    assert "1 / 1" in line and "pieces = 2" in text
    header = json.loads((tmp_path / "out/scaling.json").read_text())["header"]
    assert header["machine"]["cores"] and header == json.loads(two.read_text())["header"]


def fault(name: str, device: str = "cpu", **more: Any) -> dict[str, Any]:
    zero = dict.fromkeys((*faults_page.SUMS, *faults_page.LARGEST), 0)
    return {"fault": name, "server": device, "workers on": device, **zero, "iterations": 2.0, "steps": 100, **more}


def test_storms_of_several_pieces_are_one_and_what_ran_somewhere_is_not_skipped() -> None:
    first = {"rows": [fault("quiet"), fault("storm", missed=1, iterations=3.0)], "skipped": {"cut": "no root"}}
    second = {"rows": [fault("storm", steps=300, **{"step max ms": 7.0}), fault("quiet", "gpu"), fault("cut")]}
    rows, _, skipped = faults_page.merged([first, second, {"rows": [], "skipped": {"stop": "no worker"}}])
    assert [(r["server"], r["fault"]) for r in rows] == [
        ("cpu", "quiet"), ("cpu", "storm"), ("cpu", "cut"), ("gpu", "quiet")
    ]  # fmt: skip
    storm = rows[1]
    assert (storm["steps"], storm["missed"], storm["step max ms"]) == (400, 1, 7.0)
    assert storm["iterations"] == pytest.approx(2.25)
    assert skipped == {"stop": "no worker"}
    assert faults_page.with_penalties(rows[:2])[1]["iterations, times quiet"] == pytest.approx(1.125)


def test_a_limit_leaves_out_what_would_begin_after_it() -> None:
    assert not Limit(None).reached("anything")
    limit = Limit(-1.0)
    assert limit.reached("the last row") and limit.left_out == ["the last row"]
