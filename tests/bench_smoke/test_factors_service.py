# SPDX-License-Identifier: MIT
"""The benchmarks of factors of large bodies, on small ones."""

import pytest

from tests.bench.factors.part_size import measured
from tests.bench.factors.service import steps

pytestmark = pytest.mark.system


def test_iterations_fall_once_the_factor_is_there() -> None:
    row = next(row for row in steps((3, 3, 10), 60.0) if row["factors"] and row["age"] >= 0 and row["iterations"])
    assert 0 < row["iterations"] < 30 and row["factors"] > 0 and row["server GiB"] > 0 and row["local-1 GiB"] > 0


def test_parts_of_each_size_make_the_same_factor() -> None:
    rows = measured((1 << 14, 1 << 16), 1 << 18, rounds=1)
    assert {(row["way"], row["part KiB"]) for row in rows} >= {("bytes", 16), ("bytes", 64)}
    assert all(row["s"] > 0 and row["processor s"] > 0 for row in rows)
