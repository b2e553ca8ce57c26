# SPDX-License-Identifier: MIT
"""The GPU's steps beside the CPU's, on the same scenes. Runs where there is a GPU: pytest -m gpu."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.backends.gpu.solver import PCG_RESULT
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Job

pytestmark = pytest.mark.gpu


def both(overrides: list[str], steps: int, scene: str = "beam") -> list[tuple[Simulation, np.ndarray]]:
    """Simulation and records on either device."""
    path = f"deploy/scenes/{scene}.toml"
    runs = []
    for device in ("gpu", "cpu"):
        sim = Simulation.load(path, overrides, device)
        runs.append((sim, Driver(sim).advance(steps)))
        sim.fetch()
    return runs


@pytest.mark.parametrize("preconditioner", ["none", "jacobi", "block_jacobi"])
def test_simple_preconditioners_take_the_same_iterations(preconditioner):
    (on_gpu, g), (on_cpu, c) = both([f"solver.preconditioner={preconditioner}"], 30)
    assert np.abs(g["iterations"] - c["iterations"]).max() <= 1
    assert (g["status"] == SolveStatus.CONVERGED).all() and g["residual"].max() <= 1e-6
    assert np.abs(on_gpu.world.x - on_cpu.world.x).max() < 1e-6


@pytest.mark.parametrize("update", ["never", "every-5", "lockstep-4"])
def test_factors_are_taken_up_at_the_same_steps(update):
    """float16 costs at most two iterations; the answer is the same to the tolerance."""
    (on_gpu, g), (on_cpu, c) = both(["solver.preconditioner=cholesky", f"solver.update={update}"], 30)
    assert g["factor_step"].tolist() == c["factor_step"].tolist()
    assert (g["iterations"] <= c["iterations"] + 2).all() and g["residual"].max() <= 1e-6
    assert np.abs(on_gpu.world.x - on_cpu.world.x).max() < 1e-5


def test_tight_tolerances_are_reached_in_spite_of_float16():
    solver = ["solver.preconditioner=cholesky", "solver.update=every-10", "solver.tolerance=1e-11"]
    (_, g), _ = both(solver, 20)
    assert (g["status"] == SolveStatus.CONVERGED).all() and g["residual"].max() <= 1e-11


@pytest.mark.parametrize("preconditioner", ["block_jacobi", "cholesky"])
@pytest.mark.parametrize("bar", ["[3, 3, 10]", "[5, 5, 20]"])
def test_a_tolerance_out_of_reach_ends_at_rounding(preconditioner, bar):
    solver = [f"solver.preconditioner={preconditioner}", "solver.update=every-5", "solver.tolerance=1e-25"]
    solver += ["solver.max_iterations=400", f"object.beam.mesh.bar={bar}"]
    (_, g), _ = both(solver, 10)
    assert (g["status"] == SolveStatus.MAX_ITERATIONS).all()
    assert g["residual"].max() < 1e-11


@pytest.mark.parametrize("precision", ["float16", "float32"])
@pytest.mark.parametrize("nearness", [1e-6, 1e-8, 1e-10])
def test_a_start_near_the_solution_is_no_trouble(precision, nearness):
    """Its residual is not the difference of rounded vectors."""
    solver = ["solver.preconditioner=cholesky", "solver.update=never", "solver.tolerance=1e-11"]
    sim = Simulation.load("deploy/scenes/beam.toml", [*solver, f"solver.factor_precision={precision}"], "gpu")
    Driver(sim).advance(2)
    with sim.engine._steps as stream:  # one solve again and again, of the same system
        y = sim.engine.gpu.twin(sim.system.y)
        waves = sim.engine.gpu.cp.sin(sim.engine.gpu.cp.arange(y.size)).reshape(y.shape)
        y += nearness * abs(y).max() * waves
        sim.engine.gpu.twin(sim.system.moving)[:] = 1  # the end of a step has taken it back
        sim.engine.solver.launch()
        stream.synchronize()
    step = int(sim.engine.sequence.counter.get()[0])
    results = sim.engine.solver.results.get().view(PCG_RESULT)
    last = results[step % (len(results))]
    assert last["status"] == SolveStatus.CONVERGED and last["residual"] <= 1e-11
    assert last["fallbacks"] == 0 and last["iterations"] <= 6


@pytest.mark.parametrize("scale", [1e-24, 1e-12, 1e12])
def test_right_hand_sides_of_any_size(scale):
    solver = ["solver.preconditioner=cholesky", "solver.update=never", f"effects.gravity.g=[0, {-9.81 * scale}, 0]"]
    (_, g), (_, c) = both(solver, 2)
    assert (g["status"] == c["status"]).all() and (g["fallbacks"] == 0).all()
    assert (g["iterations"] <= c["iterations"] + 2).all()


def test_a_bad_number_is_named_wherever_it_is():
    for node in (36, 300, 755):  # none is fixed
        sim = Simulation.load("deploy/scenes/beam.toml", ["solver.preconditioner=block_jacobi"], "gpu")
        sim.engine.run(1)
        sim.engine.gpu.twin(sim.world.v)[node, 1] = np.nan
        sim.engine.run(1)
        record = sim.engine.records()[-1]
        assert record["status"] == SolveStatus.NOT_FINITE
        assert 0 <= record["bad_node"] <= node


def test_bodies_of_one_scene_are_solved_together():
    (on_gpu, g), (on_cpu, c) = both(["solver.preconditioner=cholesky", "solver.update=lockstep-3"], 15, "four_beams")
    assert g["body"].tolist() == c["body"].tolist()
    assert (g["status"] == SolveStatus.CONVERGED).all()
    assert np.abs(on_gpu.world.x - on_cpu.world.x).max() < 1e-5


def test_graphs_of_many_steps_are_the_same_steps():
    solver = ["solver.preconditioner=block_jacobi"]
    one, many = (Simulation.load("deploy/scenes/beam.toml", solver, "gpu") for _ in range(2))
    for _ in range(24):
        one.engine.run(1)
    many.engine.run(24)
    assert one.engine.records()["iterations"].tolist() == many.engine.records()["iterations"].tolist()
    assert np.array_equal(one.fetch().x, many.fetch().x), "the same bits: no sum depends on the order of threads"


def test_a_push_moves_it_as_on_the_cpu():
    results = []
    for device in ("gpu", "cpu"):
        sim = Simulation.load("deploy/scenes/beam.toml", ["solver.preconditioner=block_jacobi"], device)
        touch = sim.effects["touch"]
        sim.engine.run(5)
        touch.push("me", "beam", (0.5, 0.4, 4.0), 0.0, (800.0, 0.0, 0.0), 0.1)
        sim.engine.run(10)
        results.append((sim.fetch().x.copy(), touch.alive()))
    (x_gpu, alive_gpu), (x_cpu, alive_cpu) = results
    assert np.abs(x_gpu - x_cpu).max() < 1e-6 and alive_gpu == alive_cpu == []
    assert x_gpu[:, 0].max() > 1.01


def test_matrices_and_frames_come_back():
    solver = ["solver.preconditioner=block_jacobi"]
    sim = Simulation.load("deploy/scenes/beam.toml", solver, "gpu")
    reference = Simulation.load("deploy/scenes/beam.toml", solver)
    target = np.zeros_like(reference.system.values)
    sim.engine.loop.frame_every = 2
    sim.engine.request_matrix(0, target)
    sim.engine.run(4)
    reference.engine.run(1)
    assert sim.engine.matrix_step(0) == 0
    assert np.abs(target - reference.system.values).max() < 1e-9 * np.abs(target).max()
    assert [step for step, _, _ in sim.engine.frames()] == [2, 4]


def test_a_useless_factor_is_left_for_block_jacobi():
    sim = Simulation.load("deploy/scenes/beam.toml", ["solver.preconditioner=cholesky", "solver.update=never"], "gpu")
    driver = Driver(sim)
    driver.advance(1)
    driver.inline.submit(Job("beam", 1, 0, True, sim.system.values, "float32"))
    factor = driver.inline.poll()[0]
    sim.engine.post_factor(0, factor.pattern, np.full_like(factor.values, np.nan), 1)
    sim.engine.settle_factors()
    sim.engine.run(3)
    records = sim.engine.records()
    assert (records["fallbacks"] == 1).all() and (records["status"] == SolveStatus.CONVERGED).all()


@pytest.mark.parametrize("linearizations", [1, 3])
@pytest.mark.parametrize("far", [0, 1e6])
def test_a_body_at_rest_costs_no_iteration(linearizations, far):
    """On either device, and it stays where it is to the bit; a push wakes it."""
    rest = ["object.beam.effects.rayleigh={mass=3,stiffness=0.02}", f"object.beam.pose={{translate=[{far},0,0]}}"]
    rest += ["solver.preconditioner=block_jacobi", f"integrator.linearizations={linearizations}"]
    for device in ("gpu", "cpu"):
        sim = Simulation.load("deploy/scenes/beam.toml", ["object.beam.mesh.bar=[2, 2, 6]", *rest], device)
        sim.engine.run(1500)
        before = sim.fetch().x.copy()
        sim.engine.records()
        sim.engine.run(200)
        records = sim.engine.records()
        assert not records["iterations"].any() and (records["status"] == SolveStatus.CONVERGED).all()
        assert np.array_equal(sim.fetch().x, before)
        touch = sim.effects["touch"]
        touch.push("me", "beam", (float(far), 0.5, 4.0), 0.0, (0.0, 1.0, 0.0), 0.1)
        sim.engine.run(4)
        assert sim.engine.records()["iterations"].all()


def test_a_body_that_creeps_is_not_stopped():
    """Overdamped, 1000 m away: as on the CPU, step for step."""
    slow = ["object.beam.effects.rayleigh={mass=200}", "object.beam.pose={translate=[1e3,0,0]}"]
    (on_gpu, g), (on_cpu, _) = both(["solver.preconditioner=block_jacobi", *slow], 400)
    assert (g["iterations"] > 0).all()
    assert np.abs(on_gpu.world.x - on_cpu.world.x).max() < 1e-6


def test_a_factor_is_not_left_where_few_iterations_are_allowed():
    """More allowed is better: medians of the residuals at 1, 2, 3 iterations."""
    medians = []
    for most in (1, 2, 3):
        solver = ["solver.preconditioner=cholesky", "solver.update=lockstep-3", f"solver.max_iterations={most}"]
        sim = Simulation.load("deploy/scenes/beam.toml", solver, "gpu")
        records = Driver(sim).advance(60)[4:]
        assert not records["fallbacks"].any()
        medians.append(float(np.median(records["residual"])))
    assert medians[0] > medians[1] > medians[2], medians


def test_auto_takes_what_converges_within_the_iterations_allowed():
    sim = Simulation.load("deploy/scenes/beam.toml", ["solver.update=lockstep-3", "solver.max_iterations=12"], "gpu")
    records = Driver(sim).advance(80)
    assert (records["status"][8:] == SolveStatus.CONVERGED).mean() > 0.95


def test_a_record_tells_the_factor_that_was_there_for_a_probe():
    """Also where the probe went over to block Jacobi; -1 only where the loop had none."""
    sim = Simulation.load("deploy/scenes/beam.toml", ["solver.preconditioner=cholesky", "solver.update=never"], "gpu")
    driver = Driver(sim)
    driver.advance(1)
    sim.engine.settings(0).probe = 1
    records = driver.advance(3)
    assert (records["kind"] == 2).all() and (records["asked"] == 3).all() and (records["factor_step"] == 0).all()
