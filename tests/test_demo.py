# SPDX-License-Identifier: MIT
"""What the demonstration says of its log."""

import importlib.util
import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

DEMO = Path(__file__).parents[1] / "deploy" / "demo.py"


def said(ages: list[int], folder: Path) -> str:
    spec = importlib.util.spec_from_file_location("demo", DEMO)
    assert spec and spec.loader
    demo = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(demo)
    count = len(ages)
    scalars = {"iterations": np.arange(1, count + 1), "factor_age": np.array(ages)}
    scalars |= {"step_seconds": np.full(count, 2e-3), "residual": np.full(count, 9e-7)}
    np.savez(folder / "beam.npz", **{f"scalars/{name}": values for name, values in scalars.items()})
    out = io.StringIO()
    Console(file=out, width=100).print(demo.summary(folder / "beam.npz"))
    return out.getvalue()


FIRST, ITERATIONS, AGE = (
    "iterations before the first factor", "iterations with a factor, mean / max", "age of the factor, mean / max"
)  # fmt: skip


@pytest.mark.parametrize(
    ("ages", "rows"),
    [
        ([-1, -1, 0, 1], {FIRST: "2", ITERATIONS: "3.5 / 4", AGE: "0.5 / 1 steps"}),
        ([-1, -1, -1], {FIRST: "2", ITERATIONS: "no factor came in time", AGE: "-"}),
        ([0, 1], {FIRST: "-", ITERATIONS: "1.5 / 2", AGE: "0.5 / 1 steps"}),
    ],
    ids=["as usual", "no factor", "from the beginning"],
)
def test_the_summary_holds_whenever_factors_came(ages, rows, tmp_path):
    cells = [line.split("│") for line in said(ages, tmp_path).splitlines() if line.count("│") == 3]
    shown = {name.strip(): value.strip() for _, name, value, _ in cells}
    assert {name: shown[name] for name in rows} == rows
    assert shown["steps"] == str(len(ages)) and shown["largest true residual"] == "9.0e-07"
