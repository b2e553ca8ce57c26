# SPDX-License-Identifier: MIT
"""Steps with a bound of the error of positions as a GPU makes them, its solver and its decisions run by threads of the
processor, beside those of a CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from protocol.messages_pb2 import SolveStatus
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.backends.newton_on_threads import JUDGING, OnThreads, compiled
from tests.backends.pcg_on_threads import compiled as compiled_solver
from tests.scenes import bar, scene

BOUND = 1e-5  # [m]
Libraries = tuple[c.CDLL, c.CDLL]


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> Libraries:
    solver = compiled_solver(tmp_path_factory.mktemp("solver"), JUDGING, "NEWTON_PHASES", "ERRORS")
    return compiled(tmp_path_factory.mktemp("newton"), "ERRORS"), solver


def bounded(*objects: dict[str, Any], position: float = BOUND, **table: Any) -> Simulation:
    """Objects whose free nodes are thrown, but for those of the one called idle."""
    table = {"preconditioner": "block_jacobi", "max_iterations": 400} | table
    made = scene(*objects, **table).resolved() | {"accuracy": {"position": position}}
    del made["solver"]["tolerance"]
    made["integrator"] = table.get("integrator", {})
    sim = Simulation(Scene.model_validate(made, context={"folder": "."}))
    for body in sim.world.bodies:
        velocity = (0.0, 0.0, 0.0) if body.name == "idle" else (0.0, 1.5, 0.3)
        sim.world.v[body.nodes] = sim.world.free[body.nodes, None] * np.array(velocity)
    return sim


def beam(**table: Any) -> dict[str, Any]:
    return bar((3, 1, 1), (2, 0.5, 0.5), **{"young": 1e5, "poisson": 0.35, "fixed": "X < 0.01"} | table)


def crowd(**table: Any) -> Simulation:
    """At rest, and thrown: each body makes its own decisions."""
    at = [{"pose": {"translate": [0, 2 * k, 0]}, "name": name} for k, name in enumerate(("idle", "stiff", "soft"))]
    return bounded(beam(**at[0]), beam(young=1e6, **at[1]), beam(young=2e4, **at[2]), **table)


def falling(**table: Any) -> Simulation:
    return bounded(beam(), gravity=(0, -9.81, 0), **table)


def give_factor(run: OnThreads, cpu: Simulation) -> None:
    """Both have a factor of the present matrix."""
    cpu.engine.assemble()
    values = cpu.engine.factor_matrix(0).copy()
    row_start, columns = cpu.system.body_pattern(0, cpu.world.nodes)
    analysis = Analysis(row_start, columns)
    cpu.engine.post_factor(0, analysis.pattern, analysis.factorize(values, np.float32), 0)
    run.pcg.post(values, 0)


def compare(run: OnThreads, cpu: Simulation, steps: int) -> np.ndarray:
    """Makes steps of both, whose decisions are the same; returns the CPU's records, (steps, bodies)."""
    made = []
    for number in range(steps):
        told, result = run.step(number), run.results[number % len(run.results)]
        cpu.engine.run(1)
        records = cpu.engine.records()
        made.append(records)
        for name, found in (("linearizations", told), ("iterations", result), ("status", result), ("kind", result)):
            assert found[name].tolist() == records[name].tolist(), (name, number)
        for name, found in (("step_error", told), ("solve_error", result)):
            known = np.nan_to_num(records[name])
            assert found[name] == pytest.approx(known, rel=0.05, abs=1e-3 * BOUND), (name, number)
        assert np.abs(run.sim.world.x - cpu.world.x).max() < 1e-3 * BOUND
    return np.array(made)


def test_bodies_decide_as_on_a_cpu_in_a_loop_and_unrolled(libraries, monkeypatch):
    runs = [OnThreads(libraries[0], crowd(), monkeypatch, loops, libraries[1], 6) for loops in (True, False)]
    records = compare(runs[0], crowd(), 2)
    made = records["linearizations"]
    assert made[0].tolist() == [1, 2, 2] and made[1, 0] == 1 and (records["status"] == 0).all()
    assert records["step_error"][:, 1:].min() > 0 and records["step_error"].max() * 3 <= BOUND
    for number in range(2):
        told = runs[1].step(number)
        for name in ("linearizations", "nonlinear", "step_error"):
            assert told[name].tobytes() == runs[0].told[number][name].tobytes(), name
        assert runs[1].ran.count("begin_newton") == 1
    assert runs[0].ran == runs[1].ran
    for name in ("x", "v"):
        ours, theirs = (getattr(run.sim.world, name) for run in runs)
        assert ours.tobytes() == theirs.tobytes()


def test_a_search_judged_by_a_factor_ends_with_what_that_leaves(libraries, monkeypatch):
    """Its P^-1 b is added: the steps are those of a CPU to a thousandth of the bound, and the last solve makes no
    iteration."""
    options: dict[str, Any] = {"preconditioner": "cholesky", "update": "never"}
    run, cpu = OnThreads(libraries[0], falling(**options), monkeypatch, solves=libraries[1]), falling(**options)
    give_factor(run, cpu)
    records = compare(run, cpu, 3)
    assert (records["linearizations"] == 2).all() and (records["iterations"] <= 4).all()
    assert run.ran.count("pcg") == 3 and run.ran.count("accept_trial") == 2 and records["step_error"].min() > 0


def test_shorter_trials_are_judged_too(libraries, monkeypatch):
    """A soft bar falls into its equilibrium at once, along tangents that lead too far."""

    def made() -> Simulation:
        held = bar((3, 1, 1), (2, 0.8, 0.8), young=None, fixed="X < 0.01")
        held["effects"]["stable_neo_hookean"] = {"young": 3e4, "poisson": 0.4}
        search = {"scheme": "quasi_static", "linearizations": 25, "trials": 5, "tolerance": 1e-12}
        return bounded(held, gravity=(0, -9.81, 0), integrator=search, projection="none", dt=0.2, position=1e-4)

    run = OnThreads(libraries[0], made(), monkeypatch, solves=libraries[1])
    records = compare(run, made(), 1)
    assert run.ran.count("accept_trial") > records["linearizations"][0, 0] > 3
    assert records["status"].tolist() == [[SolveStatus.CONVERGED]]


@pytest.mark.parametrize("most", [2, 3])
def test_a_step_that_may_make_no_more_says_what_is_left(libraries, monkeypatch, most):
    options: dict[str, Any] = {"position": 1e-12, "integrator": {"linearizations": most, "tolerance": 1e-12}}
    run, cpu = OnThreads(libraries[0], falling(**options), monkeypatch, solves=libraries[1]), falling(**options)
    records = compare(run, cpu, 1)
    assert records["status"].tolist() == [[SolveStatus.MAX_LINEARIZATIONS]] and 3 * records["step_error"][0, 0] > 1e-12
