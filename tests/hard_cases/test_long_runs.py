# SPDX-License-Identifier: MIT
"""Long runs, shortened: nothing drifts, and momenta stay. The long forms: deploy/run bench hard_cases --long."""

from dataclasses import replace

import pytest

from tests.hard_cases.long_runs import LONG_RUNS, LongOutcome, LongRun, run_long


@pytest.mark.parametrize("run", LONG_RUNS, ids=lambda run: run.name)
def test_long_run(run: LongRun) -> None:
    assert run_long(run, 1000 if run.period else 2000).wrong(run) == []


def test_what_newmark_loses_of_angular_momentum_is_of_second_order_and_does_not_grow() -> None:
    run = next(run for run in LONG_RUNS if run.name == "spin, newmark")
    half = replace(run, scene=run.scene | {"dt": run.scene["dt"] / 2})
    early, late, smaller = (run_long(each, steps).drift for each, steps in ((run, 1000), (run, 4000), (half, 1000)))
    assert early > 1e-4 and late < 1.2 * early
    assert 3 < early / smaller < 5


def test_what_drifts_or_grows_is_told() -> None:
    run, good = LONG_RUNS[0], LongOutcome(0.0, 0.0, 1.0, 0, 0.0)
    assert good.wrong(run) == []
    for bad in (LongOutcome(1.0, 0, 1, 0, 0), LongOutcome(0, 10.0, 1, 0, 0), LongOutcome(0, 0, 1, 5, 0)):
        assert len(bad.wrong(run)) == 1
