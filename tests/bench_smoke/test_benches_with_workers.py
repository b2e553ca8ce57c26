# SPDX-License-Identifier: MIT
"""The benchmarks that start servers and workers do so at a small size, and write what they say they write."""

from pathlib import Path

import pytest

from tests.bench_smoke.quickly import writes_its_report
from tests.support.browser import missing

BENCHES = (
    "attacks",
    "build",
    "cpu",
    "faults",
    "figure4",
    "gallery",
    "haptics",
    "scaling",
    "service",
    "soak",
    "speed",
    "web",
)
pytestmark = [pytest.mark.system, pytest.mark.slow]


@pytest.mark.parametrize("name", BENCHES)
def test_bench_writes_its_report(name: str, tmp_path: Path) -> None:
    if name == "web" and missing():
        pytest.skip(missing())
    writes_its_report(name, tmp_path)
