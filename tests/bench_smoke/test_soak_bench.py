# SPDX-License-Identifier: MIT
"""A server under all that the soak does, for seconds: no step is missed or wrong, and all of it was done."""

import pytest

from tests.bench.soak.__main__ import QUICK, drifts, soaked

pytestmark = pytest.mark.system


def test_a_short_soak_misses_no_step() -> None:
    found = soaked(0.1, QUICK, 0)
    whole = found["whole"]
    assert whole["steps"] > 100 and whole["steps missed"] == 0
    assert whole["not converged"] < 0.1 * whole["steps"], "some without a worker and with contact, at any moment"
    assert min(whole[name] for name in ("clients", "killed", "cut", "reset", "factors used")) > 0
    assert whole["refused"] == 0, "commands"
    assert {row["what"] for row in drifts(found["samples"])} >= {"resident MB", "descriptors", "threads"}


def test_a_slope_is_found() -> None:
    held = [
        {"minute": float(k), "resident MB": 100.0 + k, "descriptors": 30, "threads": 20, "shared MB": 2.0}
        for k in range(60)
    ]
    memory, descriptors, *_ = drifts(held)
    assert memory["an hour"] == pytest.approx(60) and memory["most"] == 159
    assert descriptors["an hour"] == pytest.approx(0, abs=1e-9)
