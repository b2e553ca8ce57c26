# SPDX-License-Identifier: MIT
"""Steps and solves that a budget of wall time ends. Runs where there is a GPU."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.simulation import Simulation
from tests.accuracy.test_newton_error import SCENE, replayed

pytestmark = pytest.mark.gpu

JACOBI = "solver.preconditioner=block_jacobi"
KINDS = [("accuracy.position=1e-5",), ("integrator.linearizations=4",), ()]


@pytest.fixture(scope="module")
def path(tmp_path_factory: Any) -> Path:
    path: Path = tmp_path_factory.mktemp("scene") / "bar.toml"
    path.write_text(SCENE)
    return path


def budgeted(path: Path, budgets: Any, *overrides: str) -> tuple[Simulation, NDArray[Any]]:
    """A simulation after steps with these budgets [s], 0: none, and its records."""
    sim = Simulation.load(path, (JACOBI, "solver.budget_ms=1000", *overrides), "gpu")
    records = []
    for budget in budgets:
        sim.engine.settings(0).step_budget = budget
        sim.engine.run(1)
        records.append(sim.engine.records())
    sim.fetch()
    return sim, np.concatenate(records)


@pytest.mark.parametrize("more", KINDS)
def test_a_spent_budget_leaves_one_iteration_and_later_steps_catch_up(path, more):
    sim, records = budgeted(path, [1e-9] * 5 + [0.0] * 25, *more)
    cut = records[:5]
    assert cut["status"].tolist() == [pb.BUDGET] * 5 and cut["iterations"].tolist() == [1] * 5
    assert cut["linearizations"].tolist() == [1] * 5
    assert (cut["step_error"] > 1e-6).all() if more else (cut["solve_error"] > 1e-6).all()
    assert pb.BUDGET not in records[5:]["status"]
    exact, _ = budgeted(path, [0.0] * 30, *more)
    other = Simulation.load(path).world.x
    assert np.linalg.norm(sim.world.x - exact.world.x) < 0.5 * np.linalg.norm(exact.world.x - other)


@pytest.mark.parametrize("more", KINDS)
def test_a_budget_that_is_not_spent_changes_nothing(path, more):
    sim, records = budgeted(path, [1.0] * 10, *more)
    plain = Simulation.load(path, (JACOBI, *more), "gpu")
    plain.engine.run(10)
    found = plain.engine.records()
    for name in ("status", "linearizations"):
        assert records[name].tolist() == found[name].tolist(), name
    assert np.abs(sim.world.x - plain.fetch().x).max() < 1e-5


@pytest.mark.parametrize("more", [("accuracy.position=1e-7",), ("integrator.linearizations=5",), ()])
def test_steps_that_a_budget_ended_are_repeated(path, tmp_path, more):
    """Wherever in the step that was: budgets are of all sizes up to that of a whole step."""
    whole = np.median(budgeted(path, [0.0] * 10, *more)[1]["whole"][3:])
    sim, records = budgeted(path, np.linspace(0.05, 1.1, 60) * whole, *more)
    assert (records["status"] == pb.BUDGET).sum() > 5
    found = replayed(sim, records, tmp_path / "run.mcap")
    assert found.same, found.lines()
    assert found.solves_compared == len(records)


def test_a_budget_of_a_solve(path):
    sim = Simulation.load(path, (JACOBI, "solver.budget=1e-9"), "gpu")
    sim.engine.run(5)
    records = sim.engine.records()
    assert records["status"].tolist() == [pb.BUDGET] * 5 and records["iterations"].tolist() == [1] * 5
    assert (records["solve_error"] > 0).all()


def test_bodies_have_the_whole_budget_each():
    scene = Path(__file__).parents[2] / "deploy/scenes/four_beams.toml"
    sim = Simulation.load(scene, (JACOBI, "solver.budget_ms=1e-6"), "gpu")
    sim.engine.run(4)
    records = sim.engine.records()
    moving = records[records["iterations"] > 0]
    assert len(moving) and (moving["iterations"] == 1).all() and (moving["status"] == pb.BUDGET).all()
