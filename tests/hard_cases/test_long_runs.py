# SPDX-License-Identifier: MIT
"""Long runs, shortened: nothing drifts, and momenta stay. The long forms: deploy/run bench hard_cases --long."""

import pytest

from tests.hard_cases.long_runs import LONG_RUNS, LongOutcome, LongRun, run_long


@pytest.mark.parametrize("run", LONG_RUNS, ids=lambda run: run.name)
def test_long_run(run: LongRun) -> None:
    assert run_long(run, 1000 if run.period else 2000).wrong(run) == []


def test_what_drifts_or_grows_is_told() -> None:
    run, good = LONG_RUNS[0], LongOutcome(0.0, 0.0, 1.0, 0, 0.0)
    assert good.wrong(run) == []
    for bad in (LongOutcome(1.0, 0, 1, 0, 0), LongOutcome(0, 10.0, 1, 0, 0), LongOutcome(0, 0, 1, 5, 0)):
        assert len(bad.wrong(run)) == 1
