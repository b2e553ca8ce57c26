# SPDX-License-Identifier: MIT
"""A second GPU that applies half of the inverses of large bodies, as far as it can be told without GPUs."""

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.gpu import helper, solver_layout
from sim_server.backends.gpu.loop import DeviceLoop
from sim_server.errors import DeviceError, InputError
from sim_server.simulation import Simulation
from tests.backends import fake_cupy
from tests.support import nvrtc


@pytest.fixture(autouse=True)
def cupy(tmp_path, monkeypatch):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    monkeypatch.setattr(helper, "LEAST_NODES", 10)
    with fake_cupy.installed(tmp_path, library, monkeypatch) as fake:
        fake.cuda.runtime.getDeviceCount = lambda: 2
        yield fake


def test_a_step_launches_the_helper_and_dismisses_it(cupy):
    sim = Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu")
    cupy.calls.clear()
    sim.engine.assemble()
    sim.engine.solve()
    names = [kernel for kernel, _ in cupy.calls]
    assert names.index("help") < names.index("pcg") < names.index("dismiss")
    body, engine = sim.world.bodies[0], sim.engine
    row_start, columns = sim.system.body_pattern(body.first, body.last)
    rows = np.repeat(np.arange(body.last - body.first), np.diff(row_start))
    values = np.where((rows == columns)[:, None, None], 50 * np.eye(3), -0.5 * np.eye(3))
    analysis = Analysis(row_start, columns)
    for step in (4, 5, 6):
        engine.post_factor(body.index, analysis.pattern, analysis.factorize(values, np.float32), step)
        engine.settle_factors()
        engine.run(1)
        row = engine.solver.bodies[body.index]
        assert row["helper"] > 0 and row["factor_step"] == step
    made = engine.solver.begin_plan(body.index, analysis.pattern).result()
    assert made.plan.plan.blocks == 2 * row["blocks"]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["integrator.scheme=ros2"], "with scheme ros2"),
        (["solver.preconditioner=block_jacobi"], 'with preconditioner = "block_jacobi"'),
        (["integrator.scheme=central_difference"], "with explicit steps"),
        (["object.beam.effects.cutting={ spare = 50 }"], "with bodies that may be split"),
    ],
)
def test_scenes_that_two_gpus_do_not_solve_are_refused(overrides, words):
    with pytest.raises(InputError, match=f"solver.gpus = 2 {words}: allowed is 1"):
        Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2", *overrides], "gpu")


@pytest.mark.parametrize("how", ["run", "close_step"])
def test_two_scenes_that_make_steps_at_once_are_refused_in_place_of_waiting_for_ever(monkeypatch, how):
    """One after the other they go; so does one beside a scene with one GPU."""
    first, second = (Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu") for _ in range(2))
    single = Simulation.load("deploy/scenes/beam.toml", [], "gpu")
    whole, tried = getattr(DeviceLoop, how), []

    def beside(loop: DeviceLoop, *given: int) -> int | None:
        if loop is first.engine and not tried:
            tried.append(loop)
            with pytest.raises(
                InputError, match=r"solver.gpus = 2: another scene of this process makes steps on these"
            ):
                second.engine.run(1)
            assert single.engine.run(1) == 1
        return whole(loop, *given)

    monkeypatch.setattr(DeviceLoop, how, beside)
    if how == "run":
        first.engine.run(2)
    else:
        first.engine.assemble()
        first.engine.solve()
    assert tried and second.engine.run(1) == 1 and second.engine.step == 1
    assert first.engine.run(1) == 1


def test_a_step_by_halves_keeps_both_gpus_until_its_end():
    """What is refused has not begun a step."""
    first, second = (Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu") for _ in range(2))
    first.engine.assemble()
    begun = second.engine.sequence.counter.get().tolist()
    with pytest.raises(InputError, match=r"solver.gpus = 2: another scene of this process makes steps on these"):
        second.engine.assemble()
    assert second.engine.step == 0 and second.engine.sequence.counter.get().tolist() == begun
    first.engine.assemble()  # again, as after an error
    first.engine.solve()
    second.engine.assemble()
    second.engine.solve()
    assert second.engine.step == first.engine.step == 1


def test_small_bodies_are_refused(monkeypatch):
    monkeypatch.setattr(helper, "LEAST_NODES", 100_000)
    with pytest.raises(InputError, match=r"solver.gpus = 2: the largest object has \d+ nodes.* allowed is 1"):
        Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu")


def test_many_bodies_are_refused_whatever_the_size_of_the_largest(monkeypatch):
    monkeypatch.setattr(solver_layout, "threads_and_blocks", lambda *given: (128, 2))
    with pytest.raises(InputError, match=r"solver.gpus = 2 with 1 objects, of which a multiprocessor takes several"):
        Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu")


def test_without_a_second_gpu_or_peer_access_a_line_says_so(cupy, monkeypatch):
    monkeypatch.setattr(cupy.cuda.runtime, "deviceCanAccessPeer", lambda a, b: int(a == 0))
    with pytest.raises(DeviceError, match=r"solver.gpus = 2: GPU 1 cannot access the memory of GPU 0"):
        Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu")
    monkeypatch.setattr(cupy.cuda.runtime, "getDeviceCount", lambda: 1)
    with pytest.raises(DeviceError, match=r"solver.gpus = 2: no second GPU; CUDA shows 1 \(CUDA_VISIBLE_DEVICES\)"):
        Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu")


def test_a_cpu_has_one():
    with pytest.raises(InputError, match=r"solver.gpus = 2: must be one of 1 on a CPU"):
        Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "cpu")
