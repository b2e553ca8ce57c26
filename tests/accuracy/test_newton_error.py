# SPDX-License-Identifier: MIT
"""Errors of whole steps in metres: how far estimates can be trusted, and what a bound of them costs."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from precond_worker.factorization.registry import make_factorization
from protocol import messages_pb2 as pb
from protocol.method import Method
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import Recording
from sim_server.replay.report import Comparison
from sim_server.replay.run import Replay
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver

SCENE = """
dt = 0.02
[effects]
gravity = { g = [0, -9.81, 0] }
[[object]]
name = "bar"
mesh = { bar = [2, 2, 8], size = [1, 1, 4], split = "kuhn" }
[object.effects]
stable_neo_hookean = { young = 1e6, poisson = 0.45 }
rayleigh = { mass = 0.1 }
fixed = { where = "Z < 0.01" }
"""
WARPED = ("solver.preconditioner=cholesky", "solver.update=lockstep-5", "solver.warp=true")
EXACT = (
    "integrator.linearizations=40", "integrator.tolerance=1e-12", "solver.tolerance=1e-13",
    "solver.preconditioner=cholesky", "solver.update=every-1", "solver.factor_precision=float64",
)  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory: Any) -> Path:
    path: Path = tmp_path_factory.mktemp("scene") / "bar.toml"
    path.write_text(SCENE)
    return path


def state(sim: Simulation) -> list[NDArray[np.float64]]:
    """The arrays that a step begins with."""
    w, i = sim.world, sim.integrator
    return [w.x, w.v, w.predictor, w.damping_velocity, i.inertial_increment, i.before]


def steps(path: Path, count: int, *overrides: str) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Positions after each step (count, n, 3) [m], and records."""
    driver, x, records = Driver(Simulation.load(path, overrides)), [], []
    for _ in range(count):
        records.append(driver.advance(1))
        x.append(driver.simulation.world.x.copy())
    return np.array(x), np.concatenate(records)


def true_errors(path: Path, count: int, *overrides: str) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Largest distance of a node from where the exactly solved step from the same state has it [m], and records."""
    same = [text for text in overrides if text.startswith(("integrator.scheme", "object."))]
    driver, exact = Driver(Simulation.load(path, overrides)), Driver(Simulation.load(path, (*EXACT, *same)))
    sims, errors, records = (driver.simulation, exact.simulation), [], []
    for _ in range(count):
        for mine, its in zip(state(sims[1]), state(sims[0]), strict=True):
            mine[:] = its
        records.append(driver.advance(1))
        exact.advance(1)
        errors.append(np.linalg.norm(sims[0].world.x - sims[1].world.x, axis=1).max())
    return np.array(errors), np.concatenate(records)


def distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(a - b, axis=2).max())


@pytest.mark.parametrize(
    ("position", "overrides"),
    [
        (1e-3, WARPED),
        (1e-5, WARPED),
        (1e-3, ("solver.preconditioner=cholesky", "solver.update=lockstep-20", "solver.warp=false")),
        (1e-3, ("solver.preconditioner=block_jacobi",)),
        (1e-4, ("solver.preconditioner=ssor",)),
        (1e-4, ("integrator.scheme=newmark", *WARPED)),
        (1e-4, ("integrator.scheme=bdf2", "solver.preconditioner=block_jacobi")),
    ],
    ids=lambda value: str(value) if isinstance(value, float) else " ".join(v.partition("=")[2] for v in value),
)
def test_steps_are_as_exact_as_the_scene_asks(path, position, overrides):
    """After one linearization an estimate is above the error by what a warped factor takes off in the end."""
    errors, records = true_errors(path, 100, f"accuracy.position={position}", *overrides)
    assert (errors <= position).mean() >= 0.98 and errors.max() <= 3 * position
    assert set(records["status"].tolist()) == {pb.CONVERGED}
    effectivity = records["step_error"] / errors
    assert 0.3 < np.median(effectivity) < (40 if "solver.warp=true" in overrides else 4)
    assert effectivity.min() > 0.05


def test_a_stiff_body_is_as_exact_before_its_first_factor(path):
    """Where block Jacobi has a tenth of |b| left it has not seen the softest modes, and no estimate has."""
    stiff = "object.bar.effects.stable_neo_hookean.young=1e8"
    errors, records = true_errors(path, 12, "accuracy.position=1e-6", "solver.preconditioner=block_jacobi", stiff)
    assert errors.max() <= 1e-6 and set(records["status"].tolist()) == {pb.CONVERGED}


def test_estimates_of_states_are_the_errors_where_nothing_is_added(path):
    """In a step that ends with as many linearizations as it may have."""
    overrides = ("integrator.linearizations=2", "solver.preconditioner=cholesky", "solver.update=every-1")
    errors, records = true_errors(path, 40, "accuracy.position=1e-12", *overrides)
    assert set(records["status"].tolist()) == {pb.MAX_LINEARIZATIONS}
    effectivity = records["step_error"] / errors
    assert 0.8 < np.median(effectivity) < 1.25 and 0.5 < effectivity.min() <= effectivity.max() < 2


def test_a_bound_is_cheaper_than_fixed_settings_at_least_as_exact(path):
    exact, _ = steps(path, 60, *EXACT)
    x, records = steps(path, 60, "accuracy.position=1e-3", *WARPED)
    error, cost, exacter = distance(x, exact), records["iterations"].mean(), 0
    for linearizations in (2, 3, 4):
        for tolerance in (1e-1, 1e-2, 1e-4):
            fixed = (f"integrator.linearizations={linearizations}", "integrator.tolerance=1e-12")
            other, others = steps(path, 60, *fixed, f"solver.tolerance={tolerance}", *WARPED)
            if distance(other, exact) <= error:
                exacter += 1
                assert others["iterations"].mean() > 1.2 * cost
    assert exacter


def test_a_smaller_bound_is_nearer_to_the_exact_motion(path):
    exact, _ = steps(path, 20, *EXACT)
    errors = [distance(steps(path, 20, f"accuracy.position={p}", *WARPED)[0], exact) for p in (1e-2, 1e-4, 1e-6, 1e-9)]
    assert all(nearer < farther for farther, nearer in pairwise(errors))
    assert errors[-1] < 1e-7


def test_a_percentage_is_the_same_as_its_length(path):
    a, _ = steps(path, 10, "accuracy.position=0.004", *WARPED)
    b, _ = steps(path, 10, "accuracy.position='0.1 %'", *WARPED)
    assert np.array_equal(a, b)


def test_a_body_at_rest_takes_no_iterations(path):
    x, records = steps(path, 5, "accuracy.position=1e-6", "effects.gravity.g=[0, 0, 0]", *WARPED)
    assert np.array_equal(x[0], x[-1])
    assert records["iterations"].tolist() == [0] * 5 and records["step_error"].tolist() == [0] * 5


def budgeted(path: Path, budgets: Sequence[float], *overrides: str) -> tuple[Simulation, NDArray[Any]]:
    """A simulation after steps with these budgets [s], 0: none, and its records."""
    sim = Simulation.load(path, ("solver.preconditioner=block_jacobi", "solver.budget_ms=1000", *overrides))
    records = []
    for budget in budgets:
        sim.engine.settings(0).step_budget = budget
        sim.engine.assemble()
        sim.engine.solve()
        records.append(sim.engine.records())
    return sim, np.concatenate(records)


@pytest.mark.parametrize("more", [("accuracy.position=1e-5",), ("integrator.linearizations=4",), ()])
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


def replayed(sim: Simulation, records: NDArray[Any], path: Path) -> Comparison:
    """What a replay of a log with these records, and the state at their end, finds."""
    with Recorder(path) as recorder:
        recorder.scene(messages.scene(sim))
        recorder.topology(messages.topology(sim, sim.world.bodies[0]))
        for step in messages.steps(sim, records):
            recorder.step(step)
        w, last = sim.fetch(), len(records)
        recorder.state(messages.state(sim.world.bodies[0], last, last * w.dt, w.x, w.v))
    with Recording(path) as recording:
        return Replay(recording).run()


@pytest.mark.parametrize(
    "more",
    [
        ("accuracy.position=1e-7",),
        ("integrator.linearizations=5",),
        ("integrator.linearizations=5", "solver.max_iterations=4"),  # no system is solved
    ],
)
def test_steps_that_a_budget_ended_are_repeated(path, tmp_path, more):
    """Wherever in the step that was: budgets are of all sizes up to that of a whole step."""
    whole = budgeted(path, [0.0] * 3, *more)[1]["whole"].min()
    sim, records = budgeted(path, np.linspace(0.02, 1.1, 60) * whole, *more)
    assert (records["status"] == pb.BUDGET).sum() > 5
    found = replayed(sim, records, tmp_path / "run.mcap")
    assert found.same, found.lines()
    assert found.solves_compared == len(records)


def test_bodies_that_are_tied_have_one_budget():
    scene = Path(__file__).parents[2] / "deploy/scenes/graft.toml"
    sim = Simulation.load(scene, ("solver.budget_ms=1e-6", "solver.preconditioner=block_jacobi"))
    sim.engine.run(3)
    records = sim.engine.records()
    assert set(records["status"].tolist()) == {pb.BUDGET} and set(records["iterations"].tolist()) == {1}


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_factor_of_a_wrong_scale_deceives_no_step(path, scale):
    """P^-1 r is then too large or too small by 1e6."""
    position = 1e-3
    sim = Simulation.load(path, (f"accuracy.position={position}", "solver.preconditioner=cholesky"))
    exact = Simulation.load(path, (*EXACT, "solver.preconditioner=block_jacobi"))
    body = sim.world.bodies[0]
    analysis = make_factorization(*sim.system.body_pattern(body.first, body.last), Method(), "auto")
    sim.engine.assemble()
    values = analysis.factorize(sim.system.body_values(body.first, body.last), np.float32) * np.float32(scale)
    sim.engine.post_factor(0, analysis.pattern, values, 0)
    sim.engine.solve()
    for _ in range(8):
        for mine, its in zip(state(exact), state(sim), strict=True):
            mine[:] = its
        for each in (sim, exact):
            each.engine.assemble()
            each.engine.solve()
        error = np.linalg.norm(sim.world.x - exact.world.x, axis=1).max()
        assert error <= position
    assert set(sim.engine.records()["status"].tolist()) <= {pb.CONVERGED, pb.MAX_LINEARIZATIONS}
