# SPDX-License-Identifier: MIT
"""The history of benchmarks: what is remembered of a run, and what is said of two."""

from pathlib import Path
from typing import Any

import pytest

from tests.bench.harness import history
from tests.bench.harness.report import Report

ROWS = [{"tets": 540, "ms": 0.25, "iterations": 4}, {"tets": 3000, "ms": 1.5, "iterations": None}]


def line(bench: str = "cpu", cores: int = 2, commit: str = "a", rounds: int = 3, **figures: float) -> history.Entry:
    header = {"date": "2026-01-02T03:04:05", "commit": commit, "machine": {"cpu": "some", "cores": cores, "gpu": ""}}
    return history.entry(bench, header, {"rounds": rounds}, figures)


def test_figures_are_named_by_their_row_and_unknown_ones_left_out() -> None:
    found = history.figures(ROWS, ("tets",), ("ms", "iterations"))
    assert found == {"540: ms": 0.25, "540: iterations": 4.0, "3000: ms": 1.5}
    assert history.figures([{"cases": 3, "worst": float("nan")}], (), ("cases", "worst")) == {"cases": 3.0}


def test_what_moved_by_more_than_a_tenth_is_said_with_both_values(tmp_path: Path) -> None:
    file = tmp_path / "history.jsonl"
    for one in (
        line(same=1.0, slower=1.0, zero=0.0, gone=5.0),
        line(cores=64, commit="other machine", slower=9.0),
        line(rounds=1, commit="other arguments", slower=9.0),
        line("gpu", commit="other bench", slower=9.0),
        line(commit="b", same=1.099, slower=1.2, zero=1.0, fresh=7.0),
    ):
        history.append(one, file)
    history.append(line(commit="b", same=1.099, slower=1.2, zero=1.0, fresh=7.0), file)
    assert len(history.read(file)) == 5, "the same line is not added twice"
    said = history.compared(history.read(file)).splitlines()
    assert said[:5] == [
        "cpu, some, 2 cores, b (2026-01-02) against a (2026-01-02): 4 figures moved by more than 10%",
        "  slower: 1 -> 1.2 (+20%)",
        "  zero: 0 -> 1",
        "  gone: gone",
        "  fresh: new, 7",
    ]
    assert len(said) == 8 and all(text.endswith("nothing to compare with") for text in said[5:])


def test_a_run_is_compared_with_the_one_before_it_and_not_with_the_first() -> None:
    runs = [line(commit=commit, ms=ms) for commit, ms in (("a", 1.0), ("b", 2.0), ("c", 2.0))]
    assert history.compared(runs).endswith("c (2026-01-02) against b (2026-01-02): no figures moved by more than 10%")
    assert history.compared([]) == "no benchmark has left figures yet"


@pytest.mark.parametrize("kind", ["whole", "quick", "elsewhere"])
def test_only_a_whole_run_into_its_usual_folder_is_remembered(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.bench.harness.report.ROOT", tmp_path)
    monkeypatch.setattr(history, "FILE", tmp_path / "history.jsonl")
    calm: dict[str, Any] = {"dgemm_ms": 1.0, "spmv_ms": 1.0}
    monkeypatch.setattr("tests.bench.harness.report.calibration", lambda quick: calm)
    out = tmp_path / "elsewhere" if kind == "elsewhere" else None
    report = Report("cpu", "Title", {"sizes": [540, 3000]}, out, quick=kind == "quick")
    report.remember(ROWS, ("tets",), ("ms",))
    report.write()
    found = history.read(tmp_path / "history.jsonl")
    assert [entry["figures"] for entry in found] == ([{"540: ms": 0.25, "3000: ms": 1.5}] if kind == "whole" else [])
    assert [entry["arguments"] for entry in found] == ([{"sizes": [540, 3000]}] if kind == "whole" else [])
