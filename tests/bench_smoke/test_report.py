# SPDX-License-Identifier: MIT
"""The page of a benchmark."""

from pathlib import Path
from typing import Any

import pytest

from tests.bench.harness.report import Report


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({}, "`deploy/run bench cpu`"),
        ({"sizes": [540, 3000], "dt": 0.02, "device": "cpu"},
         "`deploy/run bench cpu`, sizes = 540 3000, dt = 0.02, device = cpu"),
    ],
)  # fmt: skip
def test_the_head_has_the_command_and_its_arguments(arguments: dict[str, Any], line: str, tmp_path: Path) -> None:
    report = Report("cpu", "Title", arguments, tmp_path, quick=True)
    assert report.markdown(report.header()).splitlines()[:4] == ["# Title", "", line, ""]
