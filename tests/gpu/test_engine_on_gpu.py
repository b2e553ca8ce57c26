# SPDX-License-Identifier: MIT
"""The native loop on a GPU that is there: what comes home while it runs, what goes in, what it cannot take."""

import dataclasses
import gc
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.errors import DeviceError
from sim_server.service.step_warnings import not_finite_lines
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Job

pytestmark = pytest.mark.gpu
SCENE = "deploy/scenes/beam.toml"
JACOBI = "solver.preconditioner=block_jacobi"
MOST = 1_000_000  # steps of a run that a test stops: a minute or more


@pytest.fixture(autouse=True)
def cp():
    from sim_server.backends.gpu.device import cupy

    try:
        package = cupy()
    except DeviceError as error:
        pytest.skip(str(error))
    yield package
    package.get_default_memory_pool().set_limit(size=0)


def on_gpu(*overrides: str) -> Simulation:
    return Simulation.load(SCENE, [JACOBI, *overrides], "gpu")


def factor_of(sim: Simulation):
    """One that is fresh."""
    driver = Driver(sim)
    sim.engine.assemble()
    driver.inline.submit(Job("beam", 1, sim.engine.step, True, sim.system.values, "float32"))
    sim.engine.solve()
    return driver.inline.poll()[0]


@contextmanager
def running(sim: Simulation) -> Iterator[threading.Thread]:
    """A run in a thread of its own, which is stopped at the end, however the test ends."""
    thread = threading.Thread(target=sim.engine.run, args=(MOST,))
    thread.start()
    try:
        yield thread
    finally:
        sim.engine.loop.stop = 1
        thread.join()


def test_steps_are_reported_with_their_own_times():
    sim = on_gpu()
    assert sim.engine.run(300) == 300
    records = sim.engine.records()
    assert records["step"].tolist() == list(range(1, 301))
    assert (records["solve"] > 0).all()
    assert (records["whole"] > records["solve"]).all()
    assert len(set(records["whole"].tolist())) > 20
    assert (records["status"] == SolveStatus.CONVERGED).all()


def test_matrices_and_frames_that_come_home_beside_the_steps_are_of_their_step():
    sim, frames, matrices = on_gpu(), [], []
    sim.engine.loop.frame_every = 7
    target = None
    with running(sim) as thread:
        alive = True
        while alive:
            alive = thread.is_alive()
            frames += sim.engine.frames()
            if len(frames) >= 5 and len(matrices) >= 3:
                sim.engine.loop.stop = 1
            if target is None and alive:
                target = np.zeros_like(sim.system.values)
                sim.engine.request_matrix(0, target)
            if target is not None and (step := sim.engine.matrix_step(0)) >= 0:
                matrices.append((step, target))
                target = None
    assert len(frames) >= 5
    assert len(matrices) >= 2
    again = on_gpu()
    for step, values in [matrices[0], matrices[-1]]:
        again.engine.run(step - again.engine.step)
        again.engine.assemble()
        assert np.array_equal(values, again.system.values), "the same bits"
        again.engine.solve()
    again = on_gpu()
    for step, x, v in frames[:5]:
        again.engine.run(step - again.engine.step)
        world = again.fetch()
        assert np.array_equal(x, world.x)
        assert np.array_equal(v, world.v)


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_frames_and_matrices_of_less_precise_runs_come_home_as_float64(precision):
    sim, exact = on_gpu(f"solver.precision={precision}", "solver.tolerance=1e-4"), on_gpu()
    target = np.zeros_like(sim.system.values)
    sim.engine.loop.frame_every = 2
    sim.engine.request_matrix(0, target)
    sim.engine.run(4)
    exact.engine.assemble()
    first = exact.system.values.copy()
    exact.engine.solve()
    exact.engine.run(3)
    frames = sim.engine.frames()
    assert [step for step, _, _ in frames] == [2, 4]
    assert np.array_equal(frames[-1][1], sim.fetch().x) and frames[-1][1].dtype == np.float64
    assert np.abs(frames[-1][1] - exact.fetch().x).max() < 1e-3
    assert sim.engine.matrix_step(0) == 0
    assert np.abs(target - first).max() < 1e-5 * np.abs(target).max()


def test_settings_and_factors_are_taken_up_while_it_runs():
    sim = on_gpu()
    factor = factor_of(sim)
    sim.engine.records()
    sim.engine.loop.patient = 1
    planes = sim.engine.solver.planes_of([(factor.pattern, factor.values)])[0]
    sim.engine.solver.begin_plan(0, factor.pattern, planes).result()  # kernels may be compiled for it
    records = []
    with running(sim) as thread:
        while thread.is_alive() and sim.engine.step < 32:
            time.sleep(1e-3)
        sim.engine.settings(0).kind = 3
        for step in (11, 12, 13):
            sim.engine.post_factor(0, factor.pattern, factor.values, step)
        while thread.is_alive():
            records.append(sim.engine.records())
            if len(records[-1]) and records[-1]["factor_step"][-1] == 13:
                sim.engine.loop.stop = 1
    records.append(sim.engine.records())
    r = np.concatenate(records)
    steps = r["factor_step"].tolist()
    assert steps == sorted(steps)
    assert {-1, 11, 13} <= set(steps) <= {-1, 11, 12, 13}
    assert (r["status"] == SolveStatus.CONVERGED).all()
    assert sim.engine.factor_step(0) == 13
    used = r["factor_step"] >= 0
    assert r["iterations"][used].mean() < r["iterations"][~used].mean()


def test_a_scene_that_does_not_fit_is_refused_with_what_is_free(cp):
    gc.collect()
    cp.get_default_memory_pool().free_all_blocks()
    cp.get_default_memory_pool().set_limit(size=8 << 20)
    with pytest.raises(DeviceError, match=r"does not fit into the memory of the GPU: Out of memory allocating .* free"):
        Simulation.load(SCENE, ["object.beam.mesh.bar=[10,10,40]"], "gpu")


def test_a_factor_that_does_not_fit_leaves_block_jacobi(cp, caplog):
    sim = on_gpu()
    factor = factor_of(sim)
    sim.engine.settings(0).kind = 3
    pool = cp.get_default_memory_pool()
    pool.free_all_blocks()
    pool.set_limit(size=pool.used_bytes() + 1024)
    with caplog.at_level(logging.WARNING):
        for step in (1, 2):
            sim.engine.post_factor(0, factor.pattern, factor.values, step)
            sim.engine.settle_factors()
            sim.engine.run(2)
    pool.set_limit(size=0)
    assert caplog.text.count("not enough GPU memory") == 1
    records = sim.engine.records()
    assert (records["factor_step"] == -1).all() and (records["status"] == SolveStatus.CONVERGED).all()
    sim.engine.post_factor(0, factor.pattern, factor.values, 3)
    sim.engine.settle_factors()
    sim.engine.run(1)
    assert sim.engine.records()["factor_step"].tolist() == [3]


def test_numbers_that_are_not_finite_are_told_as_on_the_cpu():
    lines = []
    for device in ("gpu", "cpu"):
        sim = Simulation.load(SCENE, [JACOBI], device)
        sim.engine.run(2)
        if device == "gpu":
            sim.world.backend.twin(sim.world.v)[40] = np.nan
        else:
            sim.world.v[40] = np.nan
        sim.engine.run(1)
        records = sim.engine.records()
        assert records[-1]["status"] == SolveStatus.NOT_FINITE
        lines.append(not_finite_lines(sim, records, set()))
    assert lines[0] == lines[1]
    assert len(lines[0]) == 1
    assert lines[0][0].startswith("object 'beam', step 3: force is not finite at node ")


def test_a_prepared_factor_is_applied_for_its_check_and_used_once_it_is_posted():
    sim = Simulation.load(SCENE, ["solver.preconditioner=cholesky", "solver.update=never"], "gpu")
    driver, first = Driver(sim), factor_of(sim)
    check, last = driver.check, sim.engine.step
    r = check.vector(first.object, 1)
    values = sim.engine.factor_memory(len(first.values), first.values.dtype)
    values[:] = first.values
    factor = dataclasses.replace(first, values=values)
    applied = sim.engine.prepare_factor(0, factor, r)
    z = applied()
    assert check.reject_reasons([(factor, None)], lambda: z) == [""]
    exact, told = check.probe(first, None), check.probe_all([(factor, None)], lambda: z)[0]
    assert abs(told.zr / exact.zr - 1) < 1e-3
    sim.engine.run(2)
    assert (sim.engine.records()["factor_step"][-2:] != factor.step).all(), "it was not posted"
    sim.engine.post_factors([0], [factor])
    sim.engine.settle_factors()
    sim.engine.run(1)
    used = sim.engine.records()[-1]
    assert used["factor_step"] == factor.step and used["status"] == SolveStatus.CONVERGED and last < used["step"]
    other = dataclasses.replace(first, values=-first.values, step=factor.step + 1)
    assert sim.engine.prepare_factor(0, other, r)() is not None
    sim.engine.drop_factor(0, other)
    sim.engine.run(2)
    assert (sim.engine.records()["factor_step"] == factor.step).all()
