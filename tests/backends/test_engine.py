# SPDX-License-Identifier: MIT
"""The loop's mailboxes and rings: what goes in between steps, what comes out."""

import ctypes
import gc
import threading
import time
import weakref

import numpy as np
import pytest

from protocol.factor import Factor
from sim_server.backends.cpu import structs
from sim_server.backends.cpu.device import module
from sim_server.backends.cpu.engine import CpuEngine
from sim_server.backends.cpu.library import loop_library
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from tests.scenes import bar, factor_of, simulation


def falling(**table) -> Simulation:
    return simulation(bar(young=1e5, fixed="X < 0.01"), gravity=(0, -9.81, 0), **table)


def test_run_is_assemble_and_solve():
    whole, halves = falling(), falling()
    assert whole.engine.run(5) == 5
    for _ in range(5):
        halves.engine.assemble()
        halves.engine.solve()
    assert np.array_equal(whole.world.x, halves.world.x)
    assert whole.engine.step == halves.engine.step == 5


def test_a_record_says_what_was_done():
    sim = falling(dt=0.01)
    sim.engine.run(3)
    records = sim.engine.records()
    assert records.dtype == RECORD
    assert records["step"].tolist() == [1, 2, 3]
    np.testing.assert_allclose(records["time"], [0.01, 0.02, 0.03], rtol=1e-14)
    assert (records["residual"] <= 1e-6).all()
    assert (records["kind"] == Kind.BLOCK_JACOBI).all()  # asked for a factor, there is none
    assert (records["bad_node"] == -1).all()
    parts = records["assemble"] + records["solve"] + records["integrate"]
    assert (parts > 0).all()
    assert (records["whole"] >= parts * 0.99).all()
    assert len(sim.engine.records()) == 0


def small_ring(sim: Simulation, records: int) -> CpuEngine:
    """The same loop with room for few records."""
    return CpuEngine(sim.engine_input(), records=records, frames=4)


def test_records_that_nobody_fetches_are_dropped_and_counted_and_the_run_goes_on():
    sim = falling()
    engine = small_ring(sim, 10)
    engine.settings(0).max_iterations, engine.settings(0).tolerance = 500, 1e-6
    assert engine.run(25) == 25
    kept = engine.records()
    assert kept["step"].tolist() == list(range(1, len(kept) + 1))
    assert len(kept) + engine.loop.records_dropped == 25
    assert 8 <= len(kept) <= 10
    engine.run(2)
    assert engine.records()["step"].tolist() == [26, 27]


def test_a_patient_loop_waits_for_its_reader():
    sim = falling()
    engine = small_ring(sim, 10)
    engine.loop.patient, engine.loop.frame_every = 1, 1
    engine.settings(0).max_iterations, engine.settings(0).tolerance = 500, 1e-6
    thread = threading.Thread(target=engine.run, args=(200,))
    thread.start()
    steps: list[int] = []
    frames: list[int] = []
    while thread.is_alive() or len(steps) < 200:
        steps += engine.records()["step"].tolist()
        frames += [step for step, _, _ in engine.frames()]
        if not thread.is_alive():
            steps += engine.records()["step"].tolist()
            frames += [step for step, _, _ in engine.frames()]
            break
    thread.join()
    assert steps == list(range(1, 201))
    assert frames == list(range(1, 201))
    assert engine.loop.records_dropped == engine.loop.frames_dropped == 0


def test_frames_are_the_states():
    sim = falling()
    sim.engine.loop.frame_every = 2
    states = {}
    for _ in range(6):
        sim.engine.run(1)
        states[sim.engine.step] = (sim.world.x.copy(), sim.world.v.copy())
    frames = sim.engine.frames()
    assert [step for step, _, _ in frames] == [2, 4, 6]
    for step, x, v in frames:
        assert np.array_equal(x, states[step][0])
        assert np.array_equal(v, states[step][1])
    assert sim.engine.frames() == []


def test_a_matrix_asked_for_is_that_of_the_next_step_and_comes_once():
    sim = falling()
    sim.engine.run(2)
    target = np.full_like(sim.system.values, np.nan)
    sim.engine.request_matrix(0, target)
    assert sim.engine.matrix_step(0) == -1
    sim.engine.assemble()
    assert sim.engine.matrix_step(0) == 2
    assert np.array_equal(target, sim.system.values)
    sim.engine.solve()
    sim.engine.run(3)
    assert sim.engine.matrix_step(0) == 2
    assert not np.array_equal(target, sim.system.values)


def test_a_factor_is_taken_up_between_steps_and_the_last_one_wins():
    sim = falling()
    sim.engine.assemble()
    pattern, values = factor_of(sim, dtype=np.float32)
    sim.engine.solve()
    assert sim.engine.factor_step(0) == -1
    for step in (10, 11, 12):
        sim.engine.post_factor(0, pattern, values, step)
    assert sim.engine.factor_step(0) == -1
    sim.engine.run(1)
    assert sim.engine.factor_step(0) == 12
    sim.engine.run(1)
    assert sim.engine.records()["factor_step"].tolist() == [-1, 12, 12]
    assert sim.engine.factor_bytes(0) == values.nbytes + pattern.rows.nbytes


def one(engine: CpuEngine, factor: Factor) -> None:
    engine.post_factor(0, factor.pattern, factor.values, factor.step)


def several(engine: CpuEngine, factor: Factor) -> None:
    engine.post_factors([0], [factor])


@pytest.mark.parametrize("ways", [(one,), (several,), (one, several), (several, several, one, one)])
def test_a_factor_in_use_is_never_overwritten(ways):
    """Two buffers do: one in use, one waiting or being filled. Values that were given over stay as they are."""
    sim = falling()
    sim.engine.assemble()
    pattern, values = factor_of(sim)
    sim.engine.solve()
    given: list[Factor] = []
    for step in range(20):
        given.append(Factor("bar", 1, step, True, pattern, values * (1 + step), "w", 0.0))
        ways[step % len(ways)](sim.engine, given[-1])
        if step % 3 == 0:
            sim.engine.run(1)
        assert sim.engine.factor_step(0) == step - step % 3
        in_use = [b for b in sim.engine.factor_buffers(0) if b.native.step == sim.engine.factor_step(0)]
        assert len(in_use) == 1
        assert np.array_equal(in_use[0].values, values * (1 + step - step % 3))
    assert len(sim.engine.factor_buffers(0)) == 2
    assert all(np.array_equal(factor.values, values * (1 + factor.step)) for factor in given)


def test_a_factor_just_taken_out_of_the_mailbox_is_not_overwritten():
    """The loop may be stopped between taking it out and noting it as the one in use."""
    sim = falling()
    sim.engine.assemble()
    pattern, values = factor_of(sim)
    sim.engine.solve()
    sim.engine.post_factor(0, pattern, values, 1)
    sim.engine.run(1)
    sim.engine.post_factor(0, pattern, values * 2, 2)
    body = ctypes.cast(sim.engine.loop.body, ctypes.POINTER(structs.Body))[0]
    taken = loop_library().wf_post_factor(ctypes.byref(body), None)  # as the loop does it
    sim.engine.post_factor(0, pattern, values * 3, 3)
    buffer = next(b for b in sim.engine.factor_buffers(0) if b.address == taken)
    assert buffer.native.step == 2
    assert np.array_equal(buffer.values, values * 2)


def test_a_launch_is_replaced_from_the_next_step_on():
    sim = falling(on_runaway="go_on")  # its energy comes from what the scene does not know
    index = next(i for i, launch in enumerate(sim.engine.launches) if launch.name == "gravity.gravity")
    w = sim.world
    g = np.array([0.0, 0.0, 50.0])
    up = module("effects/gravity.cu").bind("gravity", w.nodes, mass=w.mass, g=g, h=w.dt, b=sim.system.b)
    sim.engine.run(1)
    before = sim.world.v[:, 2].max()
    sim.engine.replace(index, up)
    sim.engine.run(1)
    assert before < 0.01
    assert sim.world.v[:, 2].max() > 0.5


def test_arguments_that_the_loop_may_still_read_are_kept_alive():
    """However many are posted before the loop comes round, the one in use must live until a later one was taken up."""
    sim = falling()
    index = next(i for i, launch in enumerate(sim.engine.launches) if launch.name == "gravity.gravity")
    w = sim.world

    def post(strength: float) -> weakref.ref:
        g = np.array([0.0, strength, 0.0])
        launch = module("effects/gravity.cu").bind("gravity", w.nodes, mass=w.mass, g=g, h=w.dt, b=sim.system.b)
        sim.engine.replace(index, launch)
        return weakref.ref(launch)

    in_use = post(-1.0)
    sim.engine.run(1)
    waiting = [post(float(k)) for k in range(20)]
    gc.collect()
    assert in_use() is not None
    assert waiting[-1]() is not None
    for _ in range(3):
        sim.engine.run(1)
    post(5.0)
    sim.engine.run(3)
    post(6.0)
    gc.collect()
    assert in_use() is None  # nor are they kept for ever
    assert sum(ref() is not None for ref in waiting) <= 1


def test_stop_ends_a_run_and_pause_holds_it():
    sim = falling()
    sim.engine.loop.stop = 1
    assert sim.engine.run(100) == 0
    sim.engine.loop.stop = 0
    sim.engine.loop.pause = 1
    done: list[int] = []
    thread = threading.Thread(target=lambda: done.append(sim.engine.run(3)))
    thread.start()
    thread.join(0.05)
    assert thread.is_alive()
    assert sim.engine.step == 0
    sim.engine.loop.pause = 0
    thread.join(20)
    assert done == [3]


@pytest.mark.parametrize("realtime", [0, 1])
def test_no_step_is_made_once_the_loop_says_that_it_stands_still(realtime: int):
    sim = falling(dt=1e-4)
    loop = sim.engine.loop
    loop.realtime, loop.pause = realtime, 1
    thread = threading.Thread(target=lambda: sim.engine.run(1 << 40))
    thread.start()

    def stands() -> int:
        end = time.monotonic() + 20
        while not (loop.single <= 0 and loop.halted == loop.pause):
            assert time.monotonic() < end
        return sim.engine.step

    try:
        assert stands() == 0, "before the first step"
        for number in range(2, 300):
            loop.pause = 0
            time.sleep(1e-4 * (number % 5))
            loop.pause = number
            step = stands()
            time.sleep(1e-4)
            assert sim.engine.step == step
            loop.single = 2
            assert stands() == step + 2
    finally:
        loop.stop = 1
        thread.join(20)


def test_the_clock_is_what_kernels_read():
    sim = falling(dt=0.25)
    sim.engine.loop.start_time = 100.0
    times = []
    for _ in range(3):
        sim.engine.assemble()
        times.append(float(sim.system.clock[0]))
        sim.engine.solve()
    assert times == [100.0, 100.25, 100.5]


@pytest.mark.parametrize("bodies", [1, 3])
def test_a_ring_holds_whole_steps(bodies):
    """Records of all bodies of a step are kept or dropped together."""
    sim = simulation(*[bar(name=f"b{i}", young=1e5) for i in range(bodies)], gravity=(0, -9.81, 0))
    engine = small_ring(sim, 11)
    for body in range(bodies):
        engine.settings(body).max_iterations, engine.settings(body).tolerance = 500, 1e-6
    engine.run(20)
    kept = engine.records()
    steps, counts = np.unique(kept["step"], return_counts=True)
    assert (counts == bodies).all()
    assert steps.tolist() == list(range(1, len(steps) + 1))
    assert engine.loop.records_dropped == 20 * bodies - len(kept)


def test_settings_made_within_a_step_hold_from_the_next_one():
    """A step is solved with what it began with, and its record says so: in real time most are written within a step."""
    sim = falling(preconditioner="block_jacobi", integrator={"linearizations": 3, "tolerance": 1e-12})
    settings, first = sim.engine.settings(0), ctypes.cast(sim.engine.loop.launch, ctypes.POINTER(structs.Launch))[0]
    kernel = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_int)
    original = kernel(first.kernel)

    def write(params: int, begin: int, end: int) -> None:
        settings.kind, settings.probe = int(Kind.CHOLESKY), 7  # as another thread would
        original(params, begin, end)

    replaced = kernel(write)
    first.kernel = ctypes.cast(replaced, ctypes.c_void_p).value
    sim.engine.run(2)
    records = sim.engine.records()
    assert (records["linearizations"] > 1).all()
    assert records["asked"].tolist() == [Kind.BLOCK_JACOBI, Kind.CHOLESKY]
    assert records["probe"].tolist() == [0, 7]
