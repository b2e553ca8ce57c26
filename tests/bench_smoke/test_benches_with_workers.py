# SPDX-License-Identifier: MIT
"""The benchmarks that start servers and workers run at a small size. How long anything took is not looked at."""

from pathlib import Path

import pytest

from tests.bench_smoke.quickly import bench

pytestmark = pytest.mark.system


def test_figure4_with_a_real_worker(tmp_path: Path) -> None:
    rows = {row["scheme"]: row for row in bench("figure4", tmp_path)["data"]["rows"]}
    assert rows["real async+warp"]["unconverged"] == 0
    assert rows["real async+warp, real time"]["factor age, mean"] >= 1, (
        "a factor is used in the step after its matrix at the earliest"
    )


def test_scaling_with_a_real_worker(tmp_path: Path) -> None:
    rows = bench("scaling", tmp_path)["data"]["rows"]
    assert [(row["objects"], row["workers"], row["with a factor"]) for row in rows] == [(1, 1, 1), (3, 1, 3)]
    assert all(row["unconverged"] == 0 and row["age max, steps"] > 0 for row in rows)
    assert (tmp_path / "scaling.png").read_bytes().startswith(b"\x89PNG")


def test_faults_with_real_workers_miss_no_step(tmp_path: Path) -> None:
    found = bench("faults", tmp_path)
    rows = {row["fault"]: row for row in found["data"]["rows"]}
    assert set(rows) == {"quiet", "kill"} and all(row["missed"] == row["not converged"] == 0 for row in rows.values())
    assert rows["kill"]["next factor s"] > 0
    assert "kill -9 of the worker" in (tmp_path / "faults.md").read_text()


def test_build_with_a_real_worker(tmp_path: Path) -> None:
    data = bench("build", tmp_path)["data"]
    of = {(row["link"], row["assembled by"]): row for row in data["rows"]}
    assert all(row["unconverged"] == 0 for row in data["rows"])
    for link in ("shared memory", "bytes, same host"):
        assert of[link, "worker"]["bytes a job"] * 20 < of[link, "server"]["bytes a job"]
        assert of[link, "worker"]["factors a second"] > 0
    assert (tmp_path / "build.png").read_bytes().startswith(b"\x89PNG")
