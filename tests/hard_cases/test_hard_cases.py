# SPDX-License-Identifier: MIT
"""Every line of the table of hard cases, and what the table itself claims."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.effects import known_effects
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.case import BAR, FREE_BAR, Case
from tests.hard_cases.models import MODEL_CASES, MODELS, QUICK, SITUATIONS
from tests.hard_cases.running import Outcome, broken, finer, run_case, unexpected
from tests.hard_cases.seeds import FLOWN, INVERTED, SPLITS, fate
from tests.hard_cases.slivers import THICKNESS, sliver_bar, smallest_dihedral
from tests.hard_cases.starts import mirrored, spinning
from tests.hard_cases.table import CASES


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_hard_case(case: Case, tmp_path: Path) -> None:
    assert broken(case, run_case(case, tmp_path)) == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers without end are what some of them are about
@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.name)
def test_models(case: Case, tmp_path: Path) -> None:
    """Some of the cases; all of them: deploy/run bench hard_cases."""
    assert unexpected(case, run_case(case, tmp_path)) == []


def test_every_model_and_every_situation_is_among_those_tested() -> None:
    names = [case.name.split(": ", 1) for case in QUICK]
    assert {model for _, model in names} == set(MODELS)
    assert {situation.split(", ")[0] for situation, _ in names} == set(SITUATIONS)
    assert any(case.fails for case in QUICK) and any(case.refused for case in QUICK)


def test_every_effect_with_elements_is_a_model_of_the_hard_cases() -> None:
    others = {
        "buoyancy",
        "cable",
        "cavity",
        "contact",
        "fixed",
        "gravity",
        "growth",
        "membrane",
        "muscle",
        "rayleigh",
        "rod",
        "target",
        "touch",
        "traction",
        "wind",
    }
    others |= {"cutting", "damage", "plasticity", "poroelasticity", "prony"}  # beside laws: test_memory_of_materials.py
    assert {model.effect for model in MODELS.values()} == set(known_effects()) - others


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in CASES if c.energy > 1e-6 and not c.several], ids=lambda case: case.name)
def test_energy_that_rises_is_an_error_of_the_time_step(case: Case, tmp_path: Path) -> None:
    """What the notes of the table say of every case that is allowed to gain energy."""
    smaller, usual = (run_case(finer(case, times, steps=75), tmp_path) for times in (10, 1))
    assert smaller.rise < 0.5 * usual.rise


@pytest.mark.parametrize("split", SPLITS)
def test_stable_neo_hookean_from_anywhere_does_not_fly_apart(split: str) -> None:
    """By default; with clamped eigenvalues most do. On finer bars, of more seeds: deploy/run bench hard_cases."""
    ends = [fate("stable_neo_hookean", split, seed, cells=(2, 2, 8), steps=300) for seed in range(4)]
    assert FLOWN not in ends and ends.count(INVERTED) <= 1, ends


def test_names_of_the_table_differ() -> None:
    names = [case.name for case in CASES + MODEL_CASES]
    assert len(set(names)) == len(names)


def test_slivers_are_slivers(tmp_path: Path) -> None:
    sim = sliver_bar([], tmp_path)
    corners = sim.world.rest[sim.world.bodies[0].tets]
    edges = [np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a in range(4) for b in range(a)]
    heights = np.ptp(corners[:, :, 2], axis=1)
    assert smallest_dihedral(sim.world.rest, sim.world.bodies[0].tets) < 1
    assert (np.max(edges, axis=0) / heights).max() >= 1 / THICKNESS


def test_mirrored_bar_is_inside_out() -> None:
    sim = Simulation.load(FREE_BAR)
    mirrored(0)(sim)
    corners = sim.world.x[sim.world.bodies[0].tets]
    assert (np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0).all()


def test_warp_helps_while_spinning() -> None:
    """0.2 rad a step: without the warp a factor of ten steps ago is of another orientation."""
    mean = {}
    for warp in ("true", "false"):
        sim = Simulation.load(FREE_BAR, [f"solver.warp={warp}"])
        spinning(10)(sim)
        records = Driver(sim).advance(100)
        mean[warp] = records["iterations"][10:].mean()
    assert mean["true"] < 0.25 * mean["false"]


def test_what_breaks_the_rules_is_told() -> None:
    """The check is not one that lets everything pass: one complaint for each rule."""
    case = Case("made up", "nothing", iterations=5, recovered=100)
    good = Outcome(True, 0.0, 0.0, 1.0, Counter(converged=10), 0, np.ones(10), 2.0, 1e-6, 1.0, 50, 1.0, 0)
    assert broken(case, good) == []
    bad: dict[str, Any] = {
        "finite": False, "energy": math.nan, "status": Counter(converged=9, budget=1), "recovered": 101,
        "upright": None, "farthest": 1e-3, "with_factor": 6.0,
    }  # fmt: skip
    for name, value in bad.items():
        assert len(broken(case, replace(good, **{name: value}))) == 1, name
    assert len(broken(replace(case, rests="same"), replace(good, distance=1.0))) == 1
    refused = replace(good, status=Counter(not_finite=400), named=3, farthest=0.0, recovered=400, distance=0.0)
    assert broken(replace(case, refused=True), refused) == []
    worse: dict[str, Any] = {"status": Counter(converged=400), "named": 0, "farthest": 0.1, "recovered": None}
    for name, value in worse.items():
        assert len(broken(replace(case, refused=True), replace(refused, **{name: value}))) == 1, name
    lost = replace(good, finite=False)
    assert unexpected(case, lost) == broken(case, lost) and len(unexpected(replace(case, fails=True), good)) == 1
    assert len(unexpected(replace(case, fails=True), lost)) == 1  # not told
    assert unexpected(replace(case, fails=True), replace(lost, status=Counter(not_finite=10))) == []


def test_a_late_factor_is_not_left_for_being_slow_at_first() -> None:
    """Under a small limit of iterations too: CG speeds up, and block Jacobi would be further away at the end."""
    heterogeneous = BAR.parents[2] / "deploy" / "scenes" / "heterogeneous.toml"
    sim = Simulation.load(heterogeneous, ["solver.update=lockstep-30", "solver.max_iterations=20"])
    records = Driver(sim).advance(120)[30:]
    assert records["fallbacks"].sum() == 0
    assert (records["status"] == 0).mean() > 0.8
