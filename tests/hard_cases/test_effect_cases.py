# SPDX-License-Identifier: MIT
"""Hard cases of effects, one seed of those that take little; all seeds of all: deploy/run bench hard_cases."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from tests.hard_cases.effect_table import EFFECT_CASES
from tests.hard_cases.of_effects import EffectCase, run_effect_case, tells
from tests.hard_cases.recipe_table import RECIPES

LONG = ("heavy on soft", "wedge", "fast and small on thin", "prony", "damage", "cable", "growth", "a holder that jumps")
RECIPE_NAMES = {case.name for case in RECIPES}  # tests/bench_smoke/test_hard_cases_recipes.py
SHORT = [case for case in EFFECT_CASES if not case.name.startswith(LONG) and case.name not in RECIPE_NAMES]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("case", SHORT, ids=lambda case: case.name)
def test_effect_case(case: EffectCase) -> None:
    assert run_effect_case(case, 0).wrong == ()


def test_what_does_not_hold_of_an_effect_is_told() -> None:
    """One complaint for each rule."""
    case = replace(next(c for c in SHORT if c.name == "cut under load"), steps=25)
    assert run_effect_case(case, 0).wrong == ()
    outcome = run_effect_case(replace(case, most=-1.0), 0)
    assert len(outcome.wrong) == 1 and outcome.status == Counter(converged=25)
    lost = replace(case, judge=lambda sim, trace: float(np.nan))
    assert len(run_effect_case(lost, 0).wrong) == 1
    free = replace(next(c for c in SHORT if c.name == "pressure, 1e3 times"), unconverged={})
    assert any("runaway" in each for each in run_effect_case(free, 0).wrong)


@pytest.mark.parametrize("seed", [3, 4])
def test_a_load_that_goes_leaves_no_less_than_nothing_in_the_budget(seed: int) -> None:
    """Crushed by one linearization a step the body has more elastic energy than the budget. What the load takes with it
    is more than the budget, too; what stays in the body is no runaway."""
    case = replace(next(c for c in EFFECT_CASES if c.name == "cable drawn in"), steps=70, judge=tells)
    outcome = run_effect_case(case, seed)
    assert outcome.wrong == () and outcome.status == Counter(converged=70)


def test_names_of_effect_cases_differ() -> None:
    names = [case.name for case in EFFECT_CASES]
    assert len(set(names)) == len(names)
