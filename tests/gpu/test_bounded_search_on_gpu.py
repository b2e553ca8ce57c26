# SPDX-License-Identifier: MIT
"""Steps with a bound of the error of positions: the GPU beside the CPU. Runs where there is a GPU."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.backends.gpu.cuda import CudaDevice
from sim_server.scene import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.gpu.test_newton_on_gpu import GRAVITY, MODELS, Run, crowd, of_law, one, run, stir, thrown, two
from tests.scenes import bar, scene
from tests.system.test_replay_of_a_server import recorded, replayed

pytestmark = pytest.mark.gpu

BOUND = 1e-5  # [m]
JACOBI = {"preconditioner": "block_jacobi", "max_iterations": 4000}


def bounded(made: Scene, position: float = BOUND, **integrator: Any) -> Scene:
    """The scene with a bound of the error in place of its tolerances. integrator: the table."""
    table = made.resolved() | {"accuracy": {"position": position}, "integrator": integrator}
    del table["solver"]["tolerance"], table["solver"]["projection"]
    return Scene.model_validate(table, context={"folder": "."})


def both(make: Callable[[], Scene], steps: int, prepare: Any = None) -> tuple[Run, Run]:
    """Runs on both devices: as many linearizations, the same status and kind, and positions within the bound; each
    step may add its error."""
    cpu, gpu = (run(device, make(), steps, prepare) for device in ("cpu", "gpu"))
    for name in ("linearizations", "status", "kind"):
        assert cpu.records[name].tolist() == gpu.records[name].tolist(), name
    far = np.abs(cpu.x - gpu.x).max(axis=(1, 2))
    assert (far <= BOUND * np.arange(1, steps + 1)).all(), far / BOUND
    assert np.nan_to_num(gpu.records["step_error"]).max() <= BOUND
    return cpu, gpu


@pytest.mark.parametrize("model", MODELS)
def test_as_many_linearizations_as_on_the_cpu(model):
    cpu, gpu = both(lambda: bounded(scene(MODELS[model](), dt=0.05, gravity=GRAVITY, **JACOBI)), 6)
    assert (gpu.records["linearizations"] > 1).any() and (gpu.records["linearizations"] < 8).all()
    assert gpu.records["step_error"] == pytest.approx(cpu.records["step_error"], rel=0.1, abs=0.01 * BOUND)


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha"])
def test_schemes_that_look_back(scheme):
    held = of_law("stable_neo_hookean", damping=(0.1, 0.01))
    made = lambda: bounded(scene(held, dt=0.05, gravity=GRAVITY, **JACOBI), scheme=scheme)  # noqa: E731
    both(made, 6, thrown((0.5, -1.0, 0.3)))


def test_the_bound_is_kept():
    """Beside the step's equation solved to rounding, from the same state."""
    held = lambda: scene(MODELS["exact"](), dt=0.05, gravity=GRAVITY, **JACOBI)  # noqa: E731
    gpu, exact = (run("gpu", bounded(held(), position), 1) for position in (BOUND, 1e-10))
    far = np.abs(gpu.x - exact.x).max()
    assert far <= BOUND and exact.records["linearizations"][0] > gpu.records["linearizations"][0], far


def test_bodies_decide_each_by_itself():
    cpu, gpu = both(lambda: bounded(crowd(), trials=3), 6, stir)
    of = cpu.records["linearizations"].reshape(-1, 6)
    assert (of[:, 0] == 1).all() and max(len(set(row)) for row in of.tolist()) >= 2, of
    idle = gpu.sim.world.bodies[0].nodes
    assert np.array_equal(gpu.x[-1, idle], gpu.x[0, idle])


def test_small_bodies_of_a_pool():
    objects = [
        bar((1, 1, 2), (0.5, 0.5, 1.0), name=f"b{k}", young=1e4 * (1 + 9 * (k % 4)), fixed="X < 0.01",
            pose={"translate": [0, 2 * k, 0]})
        for k in range(150)
    ]  # fmt: skip
    both(lambda: bounded(scene(*objects, dt=0.05, gravity=GRAVITY, **JACOBI)), 3)


def test_linearizations_that_do_not_suffice_are_told():
    made = scene(MODELS["corotational"](), dt=0.05, gravity=GRAVITY, **JACOBI)
    gpu = run("gpu", bounded(made, 1e-10, linearizations=2), 4)
    assert (gpu.records["status"] == SolveStatus.MAX_LINEARIZATIONS).all()
    assert (gpu.records["linearizations"] == 2).all() and (gpu.records["step_error"] > 1e-11).all()


@pytest.mark.parametrize("update", ["never", "every-3", "lockstep-2"])
def test_searches_are_judged_by_factors(update):
    solver = {"preconditioner": "cholesky", "update": update, "warp": True}
    runs = []
    for device in ("cpu", "gpu"):
        sim = Simulation(bounded(scene(one(), two(), dt=0.04, gravity=GRAVITY, **solver)), device)
        runs.append((Driver(sim).advance(8), sim.fetch().x.copy()))
    (c, x_cpu), (g, x_gpu) = runs
    for name in ("step", "body", "factor_step", "linearizations", "status", "kind"):
        assert c[name].tolist() == g[name].tolist(), f"{name}\n{c[name].tolist()}\n{g[name].tolist()}"
    assert (g["fallbacks"] == 0).all() and (g["linearizations"] > 1).any()
    assert np.abs(x_cpu - x_gpu).max() < 8 * BOUND


# --- what goes on around it -----------------------------------------------------------------------------------------


def stirred() -> Simulation:
    sim = Simulation(bounded(crowd(), trials=1), "gpu")
    stir(sim)
    return sim


@pytest.mark.parametrize("loops", [True, False])
def test_batches_and_halves_are_the_same_steps(monkeypatch, loops):
    monkeypatch.setattr(CudaDevice, "has_conditions", loops)
    one, many, halves = (stirred() for _ in range(3))
    for _ in range(20):
        one.engine.run(1)
        halves.engine.assemble()
        halves.engine.solve()
    many.engine.run(20)
    records = [sim.engine.records() for sim in (one, many, halves)]
    for other, sim in zip(records[1:], (many, halves), strict=True):
        for name in ("iterations", "linearizations", "nonlinear", "status", "step_error", "solve_error"):
            assert records[0][name].tobytes() == other[name].tobytes(), name
        assert np.array_equal(one.fetch().x, sim.fetch().x) and np.array_equal(one.fetch().v, sim.fetch().v)


def test_a_loop_makes_the_steps_of_the_unrolled_form_to_the_bit(monkeypatch):
    looped = stirred()
    monkeypatch.setattr(CudaDevice, "has_conditions", False)
    unrolled = stirred()
    for sim in (looped, unrolled):
        sim.engine.run(8)
    assert np.array_equal(looped.fetch().x, unrolled.fetch().x) and np.array_equal(looped.fetch().v, unrolled.fetch().v)
    ours, theirs = (sim.engine.records() for sim in (looped, unrolled))
    for name in ("iterations", "linearizations", "nonlinear", "status", "step_error", "solve_error"):
        assert ours[name].tobytes() == theirs[name].tobytes(), name


def test_a_run_is_repeated_from_its_log(tmp_path: Path) -> None:
    log = recorded(tmp_path, "[accuracy]\nposition = 1e-5", "cholesky", "--device", "gpu", "--realtime")
    assert replayed(log, 0, timeout=240)["same"]
