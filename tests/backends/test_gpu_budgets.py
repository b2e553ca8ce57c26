# SPDX-License-Identifier: MIT
"""Steps that a budget of wall time ends as a GPU makes them, its solver and its decisions run by threads of the
processor, beside those of a CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.backends.newton_on_threads import JUDGING, OnThreads, compiled
from tests.backends.pcg_on_threads import compiled as compiled_solver
from tests.scenes import bar, scene

SEARCHES: dict[str, dict[str, Any]] = {
    "bounded": {"accuracy": {"position": 1e-5}},
    "four": {"integrator": {"linearizations": 4}},
}
NAMES = ("step_budget", "budget", "most_linearizations")
Libraries = tuple[c.CDLL, c.CDLL]


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> Libraries:
    solver = compiled_solver(tmp_path_factory.mktemp("solver"), JUDGING, "NEWTON_PHASES", "ERRORS", "BUDGETS")
    return compiled(tmp_path_factory.mktemp("newton"), "ERRORS", "BUDGETS"), solver


def falling(search: str) -> Simulation:
    """A thrown beam under gravity, with a budget that its steps do not spend."""
    held = bar((3, 1, 1), (2, 0.5, 0.5), young=1e5, poisson=0.35, fixed="X < 0.01")
    options = {"preconditioner": "block_jacobi", "max_iterations": 400, "budget_ms": 1e9}
    made = scene(held, gravity=(0, -9.81, 0), **options).resolved() | SEARCHES[search]
    if "accuracy" in made:
        del made["solver"]["tolerance"], made["integrator"]
    sim = Simulation(Scene.model_validate(made, context={"folder": "."}))
    sim.world.v[:] = sim.world.free[:, None] * np.array([0.0, 1.5, 0.3])
    return sim


class Both:
    """The same steps by threads and by the loop of a CPU."""

    def __init__(self, libraries: Libraries, monkeypatch: pytest.MonkeyPatch, search: str):
        self.run = OnThreads(libraries[0], falling(search), monkeypatch, solves=libraries[1])
        self.cpu, self._number = falling(search), 0

    def step(self, *settings: float) -> dict[str, Any]:
        """Makes a step with these settings (NAMES) of both, which decide alike; returns what it came to."""
        row, own = self.run.pcg.solver.bodies[0], self.cpu.engine.settings(0)
        for name, value in zip(NAMES, settings, strict=True):
            row[name] = value
            setattr(own, name, value)
        told = self.run.step(self._number)[0]
        result = self.run.results[self._number % len(self.run.results)][0]
        self._number += 1
        self.cpu.engine.run(1)
        (record,) = self.cpu.engine.records()
        found = {name: result[name].item() for name in ("status", "iterations", "solve_error")}
        found |= {name: told[name].item() for name in ("linearizations", "step_error")}
        for name in ("status", "iterations", "linearizations"):
            assert found[name] == record[name], name
        cut = found["status"] == SolveStatus.BUDGET  # by z of the iteration before, where that saves a product
        for name in ("solve_error", "step_error"):
            assert found[name] == pytest.approx(np.nan_to_num(record[name]), rel=0.5 if cut else 0.05), name
        np.testing.assert_allclose(self.run.sim.world.x, self.cpu.world.x, atol=1e-8)
        return found


@pytest.mark.parametrize("search", SEARCHES)
def test_a_spent_budget_leaves_one_iteration_and_its_error(libraries, monkeypatch, search):
    both = Both(libraries, monkeypatch, search)
    for _ in range(2):
        found = both.step(1e-9, 0, 0)
        assert (found["status"], found["iterations"], found["linearizations"]) == (SolveStatus.BUDGET, 1, 1)
        assert found["step_error"] > 1e-5 and found["solve_error"] > 0
    found = both.step(1e9, 0, 0)  # catches up
    assert found["status"] == SolveStatus.CONVERGED and found["linearizations"] > 1


@pytest.mark.parametrize("search", SEARCHES)
def test_a_step_that_was_ended_is_repeated_by_its_counts(libraries, monkeypatch, search):
    """Within the second solve, and between two of them."""
    whole = Both(libraries, monkeypatch, search).step(0, 0, 0)
    first = Both(libraries, monkeypatch, search).step(0, -401, 1)  # no solve has so many
    both = Both(libraries, monkeypatch, search)
    assert first["status"] == SolveStatus.BUDGET and 0 < first["iterations"] < whole["iterations"] - 2
    found = both.step(0, -(first["iterations"] + 3), 2)
    assert (found["status"], found["linearizations"]) == (SolveStatus.BUDGET, 2)
    assert found["iterations"] == first["iterations"] + 2 and found["step_error"] > 0
    assert both.step(0, 0, 0)["status"] == SolveStatus.CONVERGED
