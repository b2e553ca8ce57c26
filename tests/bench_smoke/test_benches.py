# SPDX-License-Identifier: MIT
"""Each benchmark starts, at a small size, and writes what it says it writes. What it finds is said by its page."""

from pathlib import Path

import pytest

from tests.bench_smoke import test_benches_with_workers as with_workers
from tests.bench_smoke.quickly import ROOT, writes_its_report

PAPER = ("table1", "table2 bend, springs", "table5", "policies", "extrapolations", "automatic", "figure4", "publishing")
BENCHES = {
    "accuracy": [], "contact": [], "cutting": [], "effects": [], "elements": [], "explicit": [],
    "fuzz": [], "factors": ["--library", "SciPy's SuperLU", "supernodal"], "hard_cases": [],
    "models": ["--devices", "cpu"],
    "paper": ["--device", "cpu", "--only", *PAPER], "preconditioners": [], "rosenbrock": [],
    "scale": [], "scheduler": [], "verification": [], "warp": [],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("name", BENCHES)
def test_bench_writes_its_report(name: str, tmp_path: Path) -> None:
    writes_its_report(name, tmp_path, *BENCHES[name])


def test_every_bench_is_started() -> None:
    there = {path.parent.name for path in (ROOT / "tests/bench").glob("*/__main__.py")}
    assert there - {"gpu", "two_gpus"} == {*BENCHES, *with_workers.BENCHES}
