# SPDX-License-Identifier: MIT
"""The list of recipes has cases or tests for each, and each case has a recipe."""

import re
from pathlib import Path

import pytest

from tests.bench.hard_cases.film import TEN, failing
from tests.bench.hard_cases.measuring import TABLES
from tests.bench.hard_cases.texts import EXTREME_ROWS
from tests.hard_cases.of_effects import run_effect_case
from tests.hard_cases.recipe_table import RECIPES as ROWS
from tests.hard_cases.recipes import RECIPES, recipe_of
from tests.hard_cases.running import seeded

ROOT = Path(__file__).resolve().parents[2]
NAMES = [name for kind in ("case", "effect", "model", "long") for name in TABLES[kind]]


def test_each_case_has_a_recipe_and_each_recipe_cases_or_tests() -> None:
    assert all(recipe_of(name) for name in NAMES)
    for number, recipe in enumerate(RECIPES, 1):
        assert recipe.tests or any(recipe_of(name) == number for name in NAMES)
        assert all((ROOT / path).exists() for path in recipe.tests)


def test_files_that_the_page_names_are_there() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)`", " ".join(row["tests"] for row in EXTREME_ROWS))
    assert len(named) > 5 and all((ROOT / path).exists() for path in named)


def test_seeds_begin_elsewhere_and_pull_elsewhere() -> None:
    hanging = TABLES["case"]["Poisson 0.499"]
    scenes = [seeded(hanging, seed).scene[0] for seed in range(4)]
    assert len(set(scenes)) == 4 and scenes[0] == hanging.scene[0]
    assert seeded(hanging, 0) == hanging and seeded(hanging, 2).seed == 2


def test_films_show_cases_that_there_are() -> None:
    assert len(TEN) == 10 and set(TEN) <= set(NAMES) and not set(TEN) & set(failing())
    assert failing(), "what fails is shown, too"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", ["a saw", "a pose", "a column: st_venant_kirchhoff, 8 times"])
def test_recipe(name: str) -> None:
    """One seed of those that take least; all of all: deploy/run bench hard_cases."""
    row = next(case for case in ROWS if case.name == name)
    assert run_effect_case(row, 1).wrong == ()
