# SPDX-License-Identifier: MIT
"""Random scenes raise nothing but what is for users, keep their numbers finite, tell the truth, and repeat to the bit.

A few scenes here; thousands: `EXAMPLES=5000 python -m pytest tests/hard_cases/test_random_scenes.py`. What
one of these finds is kept: its plan goes to tests/hard_cases/found as NAME.json, and is a case of its own here.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings

from tests.hard_cases.random_runs import check
from tests.hard_cases.random_scenes import plans

FOUND = sorted(Path(__file__).with_name("found").glob("*.json"))
EXAMPLES = int(os.environ.get("EXAMPLES", 0))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers without end are what some of them are about
@settings(
    max_examples=EXAMPLES or 12, derandomize=not EXAMPLES, deadline=None, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
@given(plan=plans())
def test_random_scenes(plan: dict[str, Any], tmp_path: Path) -> None:
    run = check(plan, tmp_path)
    event("refused" if run.refused else "run")
    assert run.complaints == []


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.stem)
def test_what_was_found(path: Path, tmp_path: Path) -> None:
    run = check(json.loads(path.read_text()), tmp_path)
    assert run.complaints == []
