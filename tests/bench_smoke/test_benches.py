# SPDX-License-Identifier: MIT
"""Each benchmark runs, at a small size, and writes what it says it writes. How long anything took is not looked at."""

import json
import math
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.bench_smoke.quickly import bench

BENCHES = {
    "accuracy": ["--no-processes"], "figure4": ["--no-processes"], "hard_cases": [], "scheduler": [],
    "paper": ["--device", "cpu"], "models": ["--devices", "cpu"], "preconditioners": [], "warp": [],
    "verification": [],
}  # fmt: skip
Once = Callable[[str], tuple[dict[str, Any], Path]]


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """(path, value) of everything in parsed JSON that is no list or table."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from leaves(inner, f"{key}.{name}")
    elif isinstance(value, list):
        for inner in value:
            yield from leaves(inner, key)
    else:
        yield key, value


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Report and folder of a bench with its arguments in BENCHES, run when the first test asks for it."""

    @cache
    def made(name: str) -> tuple[dict[str, Any], Path]:
        folder = tmp_path_factory.mktemp(name)
        return bench(name, folder, *BENCHES[name]), folder

    return made


@pytest.mark.parametrize("name", BENCHES)
def test_bench_writes_its_report(name: str, once: Once) -> None:
    content, folder = once(name)
    numbers = [v for _, v in leaves(content["data"]) if isinstance(v, int | float)]
    assert len(numbers) > 20 and all(math.isfinite(v) for v in numbers)
    missing = {key for key, v in leaves(content["data"]) if v is None}
    assert all("age" in key for key in missing), "only the age of a factor may be unknown"

    header = content["header"]
    assert {"date", "commit", "machine", "versions", "calibration"} <= set(header)
    assert all(v > 0 for _, v in leaves(header["calibration"]))
    text = (folder / f"{name}.md").read_text()
    assert header["machine"]["cpu"] in text and f"]({name}.png)" in text
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.system
def test_publishing_with_a_real_worker_makes_the_same_steps(tmp_path: Path) -> None:
    row = bench("paper", tmp_path, "--device", "cpu", "--only", "publishing")["data"]["publishing"][0]
    assert row["repeats"] and row["unconverged"] == 0 and row["steps"] > row["steps a matrix"] > 1


def test_reference_of_accuracy_is_no_competitor(once: Once) -> None:
    """PCG-1 against a reference of its own would show an error of exactly 0 at any tolerance."""
    data = once("accuracy")[0]["data"]
    assert all(error > 0 for point in data["points"] for error in point["worst"])
    cg = {p["tolerance"]: p["worst"][0] for p in data["points"] if (p["beam"], p["scheme"]) == ("homogeneous", "CG")}
    assert cg[1e-6] < 1e-2 * cg[1e-2]


def test_best_order_found_afterwards_is_no_worse_than_any_rule(tmp_path: Path) -> None:
    rows = bench("scheduler", tmp_path, "--clairvoyant", "4")["data"]["rows"]
    few = {(r["workers"], r["rule"]): r["iterations"] for r in rows if r["objects"] == 4}
    for workers in (1, 2):
        best = few[workers, "best order, found afterwards"]
        rules = [v for (w, rule), v in few.items() if w == workers and not rule.endswith("grabs corrected")]
        assert few[0, "oracle"] < best <= 1.01 * min(rules)
        for rule in ("round_robin", "excess"):
            assert few[workers, f"{rule}, grabs corrected"] < few[workers, rule]


@pytest.mark.timeout(240)
def test_scheduler_repeats_to_the_digit_and_excess_goes_before_turns(once: Once, tmp_path: Path) -> None:
    runs = [content["data"]["rows"] for content in (once("scheduler")[0], bench("scheduler", tmp_path))]
    assert runs[0] == runs[1]
    iterations = {(r["objects"], r["workers"], r["rule"]): r["iterations"] for r in runs[0]}
    for workers in (1, 2):
        oracle, excess = iterations[16, 0, "oracle"], iterations[16, workers, "excess"]
        assert oracle < excess < 0.7 * iterations[16, workers, "round_robin"]
    assert all(r["age, max"] <= r["age, bound"] for r in runs[0] if r["age, bound"] is not None)


def test_iterations_of_the_papers_tables_repeat_to_the_digit(once: Once, tmp_path: Path) -> None:
    whole = once("paper")[0]["data"]
    pieces = [bench("paper", tmp_path / k, "--device", "cpu", "--share", f"{k}/2") for k in ("1", "2")]
    assert all(piece["data"] != whole for piece in pieces)
    bench("paper", tmp_path / "two", "--merge", *(str(tmp_path / k / "paper.json") for k in ("1", "2")))
    merged = json.loads((tmp_path / "two" / "paper.json").read_text())["data"]
    runs = [{table: sorted(rows, key=str) for table, rows in run.items()} for run in (whole, merged)]
    assert set(runs[0]) == set(runs[1])
    for table in runs[0]:
        if table == "extrapolations":
            assert runs[0][table] == runs[1][table]
            continue
        if table == "figure4":
            continue
        counts = [[[v for k, v in row.items() if k.endswith("iterations")] for row in run[table]] for run in runs]
        assert counts[0] == counts[1] and all(counts[0])
        assert all(row["repeats"] and row["unconverged"] == 0 for row in runs[0][table])
    of = {(row["load"], row["model"], row["scheme"]): row["iterations"] for row in runs[0]["table2"]}
    for load, model in {key[:2] for key in of}:
        assert 0 < of[load, model, "async + warp"] < 0.5 * of[load, model, "none"]
    assert all(abs(row["condition"] / 1246 - 1) < 1e-3 for row in runs[0]["table2"])
    fresh = {row["preconditioner"]: row["iterations"] for row in runs[0]["table5"] if row["updated"] == "standard"}
    assert fresh["cholesky"] < 2 < fresh["block_jacobi"] < fresh["none"]
