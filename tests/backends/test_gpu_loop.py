# SPDX-License-Identifier: MIT
"""The native GPU loop on a GPU made of NumPy: batches, mailboxes, frames, matrices, errors."""

import gc
import threading
import time
import weakref
from functools import partial
from typing import Any

import numpy as np
import pytest

from sim_server.backends import ring_buffers
from sim_server.backends.cpu.structs import REACTION, REACTION_KINDS
from sim_server.backends.gpu import loop as loop_module
from sim_server.backends.gpu.loop import BATCH, CAPACITY, FRAMES
from sim_server.backends.gpu.mailbox import ChangeMailbox
from sim_server.backends.gpu.structs import NEWTON_RESULT, PAIR_SUM, STAGE_RESULT
from sim_server.backends.measured import Measured
from sim_server.backends.rosenbrock import FORMS
from sim_server.errors import DeviceLost
from tests.backends.fake_cuda import (
    BALANCE_GRAPH,
    COPY_GRAPHS,
    ELASTIC_GRAPH,
    NOT_READY,
    RECORD_GRAPHS,
    STEPS,
    TIMED,
    FakeScene,
    number,
)

MATRIX_GRAPH, GRABS_GRAPH = 13, 14
ONE_STEP = next(graph for graph, steps in STEPS.items() if steps == 1 and graph not in TIMED)


def steps_ahead(scene: FakeScene) -> list[int]:
    """Steps launched before each of its batches was reported, beyond those reported by then."""
    ahead: list[int] = []
    launch = scene.device.graph_launch

    def counted(graph: int, stream: int) -> int:
        if graph not in (BALANCE_GRAPH, *RECORD_GRAPHS):
            ahead.append(int(scene.loop.loop.launched) - scene.loop.step)
        return launch(graph, stream)

    scene.device.set("graph_launch", counted)
    return ahead


def launched(scene: FakeScene) -> list[int]:
    """Graphs as they are launched from now on."""
    graphs: list[int] = []
    launch = scene.device.graph_launch
    scene.device.set("graph_launch", lambda graph, stream: graphs.append(graph) or launch(graph, stream))
    return graphs


def test_every_step_is_reported_once_and_in_order():
    scene = FakeScene(bodies=2)
    assert scene.loop.run(300) == 300  # the device's rings go round several times
    records = scene.loop.records()
    assert records["step"].tolist() == np.repeat(np.arange(1, 301), 2).tolist()
    assert records["body"].tolist() == [0, 1] * 300
    np.testing.assert_allclose(records["residual"], 1e-7 * (records["step"] - 1))
    np.testing.assert_allclose(records["time"], 0.5 * records["step"])
    assert (records["solve"] == 1e-6).all()
    assert scene.done == scene.loop.step == 300
    assert scene.clock[0] == 150.0


def test_what_a_search_has_come_to_is_reported_where_there_is_one():
    once, often = FakeScene(bodies=2), FakeScene(bodies=2)
    found = np.zeros((CAPACITY, 2), NEWTON_RESULT)
    found["linearizations"], found["nonlinear"] = np.arange(2 * CAPACITY).reshape(-1, 2), 0.5
    often.loop.loop.newton_results = found.ctypes.data
    for scene in (once, often):
        scene.loop.run(100)
    records = often.loop.records()
    slot = (records["step"] - 1) % CAPACITY
    assert records["linearizations"].tolist() == (2 * slot + records["body"]).tolist()
    assert (records["nonlinear"] == 0.5).all()
    records = once.loop.records()
    assert (records["linearizations"] == 1).all() and (records["nonlinear"] == -1).all()


def test_form_and_estimate_are_reported_where_there_are_stages():
    scene, found = FakeScene(bodies=2), np.zeros((CAPACITY, 2), STAGE_RESULT)
    slots = np.arange(2 * CAPACITY).reshape(-1, 2)
    found["form"], found["estimate"], found["inconsistency"] = slots % 3 + 1, 1e-3 * slots, 1e-4 * slots
    scene.loop.loop.stage_results = found.ctypes.data
    scene.loop.run(100)
    records = scene.loop.records()
    slot = 2 * ((records["step"] - 1) % CAPACITY) + records["body"]
    assert records["form"].tolist() == (slot % 3 + 1).tolist() and (records["estimate"] == 1e-3 * slot).all()
    by_factor = records["form"] == FORMS["FACTOR"]
    assert (records["residual"][by_factor] == 1e-4 * slot[by_factor]).all()


def test_a_matrix_that_no_step_makes_is_made_before_the_step_for_a_copy():
    scene, made, target = FakeScene(bodies=2), [], np.zeros((2, 3, 3))
    scene.device.graphs[MATRIX_GRAPH] = lambda: (made.append(scene.done), scene.values.fill(100 + scene.done))
    scene.loop.loop.matrix = MATRIX_GRAPH
    scene.loop.run(5)
    positions = np.zeros((2, 3))
    scene.loop.request_positions(0, positions)
    scene.loop.run(5)
    assert not made and scene.loop.matrix_step(0) == 5 and (positions == 6).all()
    scene.loop.request_matrix(1, target)
    scene.loop.run(5)
    assert made == [10] and scene.loop.matrix_step(1) == 10 and (target == 110).all()
    scene.loop.request_positions(0, positions)
    scene.loop.request_matrix(1, target)
    for _ in range(2):  # one kind of copy at a time
        scene.loop.run(5)
    assert made == [10, 15] and scene.loop.matrix_step(1) == 15 and (target == 115).all()
    assert scene.loop.matrix_step(0) == 20 and (positions == 21).all()


def test_memory_of_copies_may_be_made_before_the_first_request(monkeypatch):
    scene, made = FakeScene(bodies=2), []
    scene.loop.prepare_copies()
    monkeypatch.setattr(scene.device, "pinned", made.append)
    monkeypatch.setattr(scene.device, "memory", made.append)
    target = np.zeros((2, 3, 3))
    scene.loop.request_matrix(1, target)
    scene.loop.run(5)
    assert scene.loop.matrix_step(1) >= 0 and made == []


def test_the_elastic_energy_is_evaluated_after_the_steps_where_it_is_wanted():
    scene = FakeScene(bodies=2)
    scene.loop.run(2 * BATCH)
    scene.loop.records()
    scene.loop.loop.energy_every = 5
    scene.loop.run(20 * BATCH)
    records = scene.loop.records()
    due = records["step"] % 5 == 0
    assert due.sum() == 128 and (records["kinetic"] == records["step"] - 1).all()
    assert (records["elastic"][due] == 1000 + records["step"][due]).all() and np.isnan(records["elastic"][~due]).all()
    assert (records["work"] == 1 - records["step"]).all()
    scene.loop.loop.energy_every = 0
    graphs = launched(scene)
    scene.loop.run(10 * BATCH)
    assert np.isnan(scene.loop.records()["elastic"]).all()
    assert set(RECORD_GRAPHS) < set(graphs) and ELASTIC_GRAPH not in graphs


def test_what_the_device_has_frozen_is_told_as_a_runaway():
    scene = FakeScene()
    scene.loop.run(1)
    scene.phase, scene.factor[0] = 2, 9
    scene.loop.run(2)
    scene.results["status"] = 5
    scene.loop.run(1)
    records = scene.loop.records()
    assert records["status"].tolist() == [0, 7, 7, 7]
    assert records["factor_step"].tolist() == [0, -1, -1, -1]


def test_a_body_that_runs_away_by_what_is_no_number_says_so():
    scene = FakeScene()
    scene.phase, scene.found, scene.results["status"] = 2, 1, 5
    scene.loop.run(1)
    assert scene.loop.records()["status"].tolist() == [5]  # not_finite says more


def test_the_time_of_a_step_is_its_own_and_not_a_share_of_its_batch():
    scene = FakeScene()
    scene.loop.run(100)
    records = scene.loop.records()
    np.testing.assert_allclose(records["whole"], 1e-8 * records["step"], rtol=1e-9)
    assert (records["cpu"] > 0).all()


def test_the_next_batch_is_under_way_before_the_last_one_is_reported():
    scene = FakeScene()
    scene.loop.run(BATCH)
    ahead = steps_ahead(scene)
    scene.loop.run(8 * BATCH)
    assert max(ahead[:2]) < BATCH  # nothing to be ahead of
    assert min(ahead[2:]) >= BATCH
    assert max(ahead) < 2 * BATCH


def test_in_real_time_no_step_is_begun_before_the_last_one_is_reported():
    scene = FakeScene()
    scene.loop.loop.realtime, scene.loop.loop.dt = 1, 1e-4
    ahead = steps_ahead(scene)
    scene.loop.run(6)
    assert ahead == [0] * 6


def test_a_step_whose_wait_lasted_too_long_began_late():
    scene = FakeScene()
    loop = scene.loop.loop
    loop.realtime, loop.dt, loop.frame_every = 1, 0.02, 1
    query, asked = scene.device.event_query, []

    def slow(event: int) -> int:
        if event != loop.frame_copies[1].arrived or len(asked) > 3:
            return query(event)
        asked.append(event)
        if len(asked) == 3:  # while the next step is waited for: before that it is looked for once or twice
            time.sleep(max(loop.deadline + 1.2 * loop.dt - time.monotonic(), 0))
        return NOT_READY

    scene.device.set("event_query", slow)
    scene.loop.run(5)
    assert len(asked) > 3 and scene.loop.records()["late"].max() > loop.dt and loop.late_steps >= 1


def test_the_clock_is_noted_first_where_the_device_had_nothing_to_do():
    scene = FakeScene()
    scene.loop.run(BATCH)
    scene.device.pieces = 1  # slow enough to be busy
    graphs = launched(scene)
    scene.loop.run(3 * BATCH)
    first, *others = [graph for graph in graphs if graph in STEPS]
    assert first in TIMED and not set(others) & set(TIMED), "only the first found the device idle"
    assert sum(STEPS[graph] for graph in (first, *others)) == 3 * BATCH


def test_few_launches_do_for_many_steps():
    scene = FakeScene()
    scene.loop.run(BATCH)
    graphs = launched(scene)
    scene.loop.run(10 * BATCH)
    assert sum(STEPS.get(graph, 0) for graph in graphs) == 10 * BATCH
    assert len(graphs) <= 10 * BATCH // 4, "most launches make many steps"


def test_mail_holds_from_the_next_batch_on_and_the_last_one_wins():
    scene = FakeScene()
    box = scene.loop.mailboxes[0]
    for value in (3, 4, 5):
        box.post(number(value))
    assert not box.taken
    scene.loop.run(2)
    assert box.taken
    box.post(number(6))
    scene.loop.run(1)
    assert scene.loop.records()["iterations"].tolist() == [5, 5, 6]


def test_mail_says_from_which_step_on_it_holds():
    """As logs need it to repeat a run: the arguments of step k + 1 are those with the largest `taken` up to k."""
    scene = FakeScene()
    box, posted = scene.loop.mailboxes[-1], []
    for value in range(1, 41):
        posted.append((box.post(number(value)), value))
        if value % 3:  # the others are replaced before the loop sees them
            scene.loop.run(value % 7 + 1)
    scene.loop.run(BATCH)
    taken = {mail.taken: value for mail, value in posted if mail.taken >= 0}
    assert [mail.taken < 0 for mail, _ in posted] == [value % 3 == 0 for _, value in posted]
    held = [max(step for step in taken if step <= k) for k in range(scene.done)]
    assert scene.seen == [taken[step] for step in held]


def test_arguments_that_come_while_others_have_run_hold_from_the_next_step_on():
    scene = FakeScene()
    scene.loop.run(3)
    scene.loop.open_step()
    late, settings = scene.loop.mailboxes[-1].post(number(8)), scene.loop.mailboxes[0].post(number(4))
    scene.loop.renew_mail()
    assert settings.taken == 3 and late.taken == -1
    scene.device.graph_launch(ONE_STEP, scene.device.stream)
    scene.loop.close_step()
    scene.loop.run(1)
    assert late.taken == 4 and scene.seen == [0, 0, 0, 0, 8]
    assert scene.loop.records()["iterations"].tolist() == [0, 0, 0, 4, 4]


def test_a_factor_is_used_once_its_event_is_done():
    scene = FakeScene()
    event, box = scene.device.event(), scene.loop.mailboxes[1]
    scene.device.begin(event)
    box.post(number(9), event=event)
    scene.loop.run(2)
    assert not box.taken
    scene.device.record(event)
    scene.loop.run(1)
    assert box.taken
    assert scene.loop.records()["factor_step"].tolist() == [0, 0, 9]


def test_what_was_not_taken_can_be_withdrawn():
    scene = FakeScene()
    event, box = scene.device.event(), scene.loop.mailboxes[1]
    scene.device.begin(event)
    box.post(number(9), event=event)
    scene.loop.run(1)  # the loop holds it, but does not use it
    assert box.withdraw()
    scene.device.record(event)
    box.post(number(10))
    scene.loop.run(1)
    assert not box.withdraw()
    assert scene.loop.records()["factor_step"].tolist() == [0, 10]


class MailEvent:
    """An event of a build as CuPy has it."""

    def __init__(self, scene: FakeScene, done: bool):
        self.ptr = scene.device.event()
        scene.device.begin(self.ptr)
        if done:
            scene.device.record(self.ptr)


def test_mail_that_is_posted_together_is_taken_as_if_it_were_posted_alone():
    """Each waits for its own event, what was not taken is replaced, and its memory lives as long as it is used."""
    scene = FakeScene(bodies=3)
    boxes, all_of_them = scene.loop.mailboxes_of_bodies(3), np.arange(3)
    late, done = MailEvent(scene, done=False), MailEvent(scene, done=True)

    def post(bodies: list[int], values: list[int], event: MailEvent) -> None:
        boxes.post(np.array(bodies), np.array(values, np.int64)[:, None].view(np.uint8), event)

    post([0, 1, 2], [5, 6, 7], done)
    post([2, 0], [10, 8], done)
    post([1], [9], late)
    gc.collect()
    scene.loop.run(2)
    assert boxes.taken(all_of_them).tolist() == [True, False, True]
    scene.device.record(late.ptr)
    scene.loop.run(1)
    assert boxes.taken(all_of_them).all() and boxes.after(all_of_them).tolist() == [0, 2, 0]
    assert scene.loop.records()["factor_step"].reshape(3, 3).tolist() == [[8, 0, 10], [8, 0, 10], [8, 9, 10]]


def test_of_many_mailboxes_what_was_not_taken_can_be_withdrawn():
    scene = FakeScene(bodies=2)
    boxes, late = scene.loop.mailboxes_of_bodies(2), MailEvent(scene, done=False)
    boxes.post(np.arange(2), np.array([[5], [6]], np.int64).view(np.uint8), late)
    scene.loop.run(1)  # the loop holds them, but does not use them
    assert boxes.withdraw(1) and not boxes.withdraw(1)
    scene.device.record(late.ptr)
    scene.loop.run(1)
    assert not boxes.withdraw(0) and scene.factor.tolist() == [5, 0]


def test_what_mail_of_bodies_points_to_lives_until_the_device_is_done_with_it():
    """A step under way may use what was posted before the last mail."""
    scene = FakeScene(bodies=2)
    boxes, kept = scene.loop.mailboxes_of_bodies(2), list[weakref.ref]()
    for value in range(4):
        what = Held()
        boxes.post(np.arange(2), np.full((2, 1), value).view(np.uint8), keep=what)
        kept.append(weakref.ref(what))
        del what
        gc.collect()
        assert [each() is not None for each in kept[-2:]] == [True] * len(kept[-2:])
        scene.loop.run(1)
    assert kept[0]() is None and scene.factor.tolist() == [3, 3]


class Held:
    """What mail points to."""


def test_what_mail_points_to_lives_until_the_device_is_done_with_it():
    scene = FakeScene()
    box = scene.loop.mailboxes[-1]

    def post(value: int) -> weakref.ref:
        what = Held()
        box.post(number(value), keep=what)
        return weakref.ref(what)

    in_use = post(1)
    scene.loop.run(1)
    waiting = [post(k) for k in range(2, 22)]
    gc.collect()
    assert in_use() is not None
    assert sum(w() is not None for w in waiting) == 1
    scene.loop.run(3)
    post(50)
    scene.loop.run(1)
    post(51)
    gc.collect()
    assert in_use() is None
    assert scene.seen == [1, 21, 21, 21, 50]


@pytest.mark.parametrize("real", ["f4", "f8"])
def test_frames_are_the_states_of_their_steps(real):
    scene = FakeScene(real=real)
    scene.loop.loop.frame_every = 3
    scene.loop.run(14)
    frames = scene.loop.frames()
    assert [step for step, _, _ in frames] == [3, 6, 9, 12]
    for step, x, v in frames:
        assert (x == step).all()
        assert (v == 1 - step).all()
        assert x.dtype == v.dtype == np.float64
    assert scene.loop.frames() == []


def test_frames_that_nobody_fetches_are_dropped_and_counted():
    scene = FakeScene()
    scene.loop.loop.frame_every = 1
    assert scene.loop.run(50) == 50
    assert [step for step, _, _ in scene.loop.frames()] == list(range(1, FRAMES + 1))
    assert scene.loop.loop.frames_dropped == 50 - FRAMES


def test_a_patient_loop_waits_for_its_reader():
    scene = FakeScene(records=10)
    scene.loop.loop.patient = scene.loop.loop.frame_every = 1
    thread = threading.Thread(target=scene.loop.run, args=(200,))
    thread.start()
    steps: list[int] = []
    frames: list[tuple[int, float]] = []
    alive = True
    while alive:
        alive = thread.is_alive()  # once more after its end
        steps += scene.loop.records()["step"].tolist()
        frames += [(step, float(x[0, 0])) for step, x, _ in scene.loop.frames()]
    assert steps == list(range(1, 201))
    assert frames == [(k, k) for k in range(1, 201)]
    assert scene.loop.loop.records_dropped == scene.loop.loop.frames_dropped == 0


def test_records_that_nobody_fetches_are_dropped_by_whole_steps_and_counted():
    scene = FakeScene(bodies=3, records=13)
    scene.loop.run(40)
    kept = scene.loop.records()
    assert kept["step"].tolist() == np.repeat(np.arange(1, 5), 3).tolist()
    assert len(kept) + scene.loop.loop.records_dropped == 120


def test_records_are_written_by_batches_where_there_is_room_and_else_by_steps():
    scene = FakeScene(bodies=3, records=3 * (2 * BATCH + 5))
    graphs = launched(scene)
    scene.loop.run(2 * BATCH)
    by_batches = sum(graph in RECORD_GRAPHS for graph in graphs)
    assert by_batches == scene.loop.loop.finished
    scene.loop.run(BATCH)  # there is room for five steps
    assert sum(graph in RECORD_GRAPHS for graph in graphs) == scene.loop.loop.finished + 5
    records = scene.loop.records()
    assert records["step"].tolist() == np.repeat(np.arange(1, 2 * BATCH + 6), 3).tolist()
    assert scene.loop.loop.records_dropped == 3 * (BATCH - 5)
    scene.loop.run(BATCH)
    records = scene.loop.records()
    assert records["step"].tolist() == np.repeat(np.arange(3 * BATCH + 1, 4 * BATCH + 1), 3).tolist()
    np.testing.assert_allclose(records["residual"], 1e-7 * (records["step"] - 1))


def test_records_are_written_by_batches_again_once_they_are_fetched():
    """In one run; a batch whose records had no place leaves one to those behind it."""
    scene = FakeScene(records=2 * BATCH + 5)
    graphs, launch, steps = [], scene.device.graph_launch, list[int]()

    def reader(graph: int, stream: int) -> int:
        graphs.append(graph)
        if scene.loop.loop.records_dropped:
            steps.extend(scene.loop.records()["step"])
        return launch(graph, stream)

    scene.device.set("graph_launch", reader)
    scene.loop.run(20 * BATCH)
    steps.extend(scene.loop.records()["step"])
    assert steps == sorted(set(steps)) and len(steps) + scene.loop.loop.records_dropped == 20 * BATCH
    assert 0 < scene.loop.loop.records_dropped <= 2 * BATCH
    by_steps = sum(graph in RECORD_GRAPHS for graph in graphs) - scene.loop.loop.finished
    assert by_steps <= 3 * BATCH


def test_a_reader_that_is_a_batch_late_slows_nothing_down():
    """In the room that the ring has for many bodies: each batch finds its place, and none is written step by step."""
    scene = FakeScene(bodies=3, records=3 * ring_buffers.STEPS)
    graphs, launch, steps = [], scene.device.graph_launch, list[int]()

    def reader(graph: int, stream: int) -> int:
        graphs.append(graph)
        if graph in RECORD_GRAPHS:
            steps.extend(scene.loop.records()["step"][::3])
        return launch(graph, stream)

    scene.device.set("graph_launch", reader)
    scene.loop.run(20 * BATCH)
    steps.extend(scene.loop.records()["step"][::3])
    assert steps == list(range(1, 20 * BATCH + 1)) and scene.loop.loop.records_dropped == 0
    assert sum(graph in RECORD_GRAPHS for graph in graphs) == scene.loop.loop.finished


@pytest.mark.parametrize("real", ["f4", "f8"])
def test_matrices_are_those_of_the_step_after_the_request_in_all_bodies(real):
    scene = FakeScene(bodies=3, real=real)
    scene.loop.run(20)
    targets = [np.full((2, 3, 3), np.nan) for _ in range(2)]
    scene.loop.request_matrix(0, targets[0])
    scene.loop.request_matrix(2, targets[1])
    assert scene.loop.matrix_step(0) == scene.loop.matrix_step(2) == -1
    scene.loop.run(40)
    assert [scene.loop.matrix_step(k) for k in range(3)] == [20, -1, 20]
    assert all((t == 20).all() for t in targets)


@pytest.mark.parametrize("real", ["f4", "f8"])
def test_positions_are_those_at_the_end_of_the_step_beside_matrices_of_other_bodies(real):
    scene = FakeScene(bodies=3, real=real)
    scene.loop.run(20)
    positions, matrix = np.full((2, 3), np.nan), np.full((2, 3, 3), np.nan)
    scene.loop.request_positions(1, positions)
    scene.loop.request_matrix(2, matrix)
    scene.loop.run(40)
    assert [scene.loop.matrix_step(k) for k in range(3)] == [-1, 20, 20]
    assert (matrix == 20).all()
    assert (positions == 21).all()
    with pytest.raises(ValueError, match="ahead"):
        scene.loop.request_positions(1, positions, 0.1)


def test_a_matrix_asked_for_while_it_runs_is_whole():
    """Its copy is made aside: the steps that follow do not reach it."""
    scene = FakeScene()
    scene.loop.run(1)
    thread = threading.Thread(target=scene.loop.run, args=(4000,))
    thread.start()
    found = []
    target = np.zeros((2, 3, 3))
    while thread.is_alive():
        scene.loop.request_matrix(0, target)
        while scene.loop.matrix_step(0) < 0 and thread.is_alive():
            scene.loop.records()
        if (step := scene.loop.matrix_step(0)) >= 0:
            found.append((step, target.min(), target.max()))
    assert found
    assert all(step == low == high for step, low, high in found)
    assert [step for step, _, _ in found] == sorted({step for step, _, _ in found})


def test_a_pause_ends_what_is_under_way_and_resumes():
    scene = FakeScene()
    done: list[int] = []
    scene.loop.loop.pause = 1
    thread = threading.Thread(target=lambda: done.append(scene.loop.run(30)))
    thread.start()
    thread.join(0.05)
    assert thread.is_alive()
    assert scene.loop.step == scene.loop.loop.launched == 0
    scene.loop.loop.pause = 0
    thread.join(20)
    assert done == [30]
    scene.loop.loop.stop = 1
    assert scene.loop.run(5) == 0


def test_a_paused_loop_makes_single_steps_and_stands_still_on_request():
    scene = FakeScene()
    loop = scene.loop.loop
    loop.pause = 1
    thread = threading.Thread(target=lambda: scene.loop.run(30))
    thread.start()
    loop.single = 3
    while not (loop.single == 0 and loop.halted == 1):
        time.sleep(1e-3)
    assert scene.loop.step == loop.launched == 3
    loop.hold = 7
    while loop.held != 7:
        time.sleep(1e-3)
    loop.pause = 0
    thread.join(0.02)
    assert scene.loop.step == loop.launched == 3, "not before it is let go"
    loop.hold = 0
    thread.join(20)
    assert scene.loop.step == 30


@pytest.mark.parametrize("call", ["graph_launch", "event_query", "event_record"])
def test_a_device_that_fails_is_told_with_the_call_that_failed(call):
    scene = FakeScene()
    scene.loop.run(3)
    scene.device.fail = call
    with pytest.raises(DeviceLost, match=rf"the GPU failed at step 3: {call}: fake error 700"):
        scene.loop.run(3)


def test_half_a_step_by_hand_is_a_step():
    scene = FakeScene()
    target = np.zeros((2, 3, 3))
    scene.loop.request_matrix(0, target)
    scene.loop.open_step()
    scene.loop.mailboxes[0].post(number(4))
    scene.device.event_wait(_recorded(scene))  # the caller waits for the first half
    scene.loop.renew_mail()
    scene.device.graph_launch(ONE_STEP, scene.device.stream)
    scene.loop.close_step()
    assert scene.loop.records()[["step", "iterations"]].tolist() == [(1, 4)]
    assert scene.loop.matrix_step(0) == 0
    assert scene.loop.run(2) == 2


def _recorded(scene: FakeScene) -> int:
    event = scene.device.event()
    scene.device.event_record(event, scene.device.stream)
    return event


def held_scene(most: int = 4) -> FakeScene:
    """A scene whose last mailbox says how many interactions there are; the first of them is a push."""
    scene = FakeScene()
    reactions, counts = np.zeros((CAPACITY, most), REACTION), np.zeros(CAPACITY, np.int64)

    def tell() -> None:
        slot, count = (scene.done - 1) % CAPACITY, int(scene.argument[0])
        counts[slot] = count
        told = reactions[slot, :count]
        told["number"] = np.arange(count)[:most]
        told["number"][:1] = -1
        told["step"], told["kind"] = scene.done, REACTION_KINDS["ON_GRAB"]

    scene.device.graphs[GRABS_GRAPH] = tell
    scene.loop.report_grabs(GRABS_GRAPH, len(scene.loop.mailboxes) - 1, reactions, counts)
    return scene


def test_forces_on_grabs_are_asked_for_only_while_something_is_held():
    scene = held_scene()
    graphs = launched(scene)
    scene.loop.run(20)
    assert GRABS_GRAPH not in graphs
    scene.loop.mailboxes[-1].post(number(3))
    scene.loop.run(3 * CAPACITY)
    scene.loop.mailboxes[-1].post(number(0))
    scene.loop.run(20)
    assert graphs.count(GRABS_GRAPH) == 3 * CAPACITY
    assert scene.loop.records()["step"].tolist() == list(range(1, 3 * CAPACITY + 41))
    told = scene.loop.other_reactions()
    assert told["step"].tolist() == np.repeat(np.arange(21, 21 + 3 * CAPACITY), 2).tolist()
    assert told["number"].tolist() == [1, 2] * 3 * CAPACITY
    assert scene.loop.loop.others_dropped == 0 and len(scene.loop.other_reactions()) == 0


def test_forces_on_more_grabs_than_there_is_room_for_are_counted():
    scene = held_scene(most=4)
    scene.loop.mailboxes[-1].post(number(6))
    scene.loop.run(10)
    scene.loop.records()
    assert len(scene.loop.other_reactions()) == 10 * 3 and scene.loop.loop.others_dropped == 10 * 2


def test_what_bodies_exert_on_each_other_is_told_of_both():
    """The first one has rows against the others, the second one against the first; a body more has no place."""
    scene = FakeScene(bodies=3)
    sums, counts = np.zeros((CAPACITY, 3, 2), PAIR_SUM), np.zeros((CAPACITY, 3), np.int32)
    sums["normal"], sums["force"] = 2.0, (0, 2.0, 0)
    sums["point"], sums["torque"] = (2.0, 0, 0), (0, 0, 2.0)  # at (1, 0, 0)
    counts[0::2] = 2, 1, 0
    sums[:, 0, :]["other"], sums[:, 1, 0]["other"] = (1, 2), 0
    sums[:, 1, 0]["force"], sums[:, 1, 0]["torque"] = (0, -3.0, 0), (0, 0, -3.0)
    counts[2, 2] = 3
    sums[2, 2]["other"] = 1, 0
    scene.loop.report_pairs(sums, counts)
    scene.loop.run(3)
    scene.loop.records()
    told = scene.loop.other_reactions()
    assert (told["kind"] == REACTION_KINDS["ON_OBJECT"]).all() and scene.loop.loop.others_dropped == 1
    first = told[told["step"] == 1]
    assert first["body"].tolist() == [0, 1, 0, 2] and first["number"].tolist() == [1, 0, 2, 0]
    assert first["force"][:, 1].tolist() == [-5.0, 5.0, -2.0, 2.0]
    assert (first["point"] == (1, 0, 0)).all() and not first["torque"].any()
    assert not (told["step"] == 2).any() and (told["step"] == 3).sum() == 6


def test_records_come_with_the_numbers_of_their_bodies() -> None:
    scene = FakeScene(bodies=3)
    measured = [Measured(body, "cable", "tension", "N", np.zeros(1), 0) for body in (0, 2, 2)]
    results = np.arange(3.0 * CAPACITY).reshape(CAPACITY, 3)
    scene.loop.report_measured(measured, results)
    scene.loop.run(CAPACITY + 1)
    records = scene.loop.records()
    assert records["body"][-3:].tolist() == [0, 1, 2]
    told = scene.loop.readings.reshape(CAPACITY + 1, 3, 2)
    expected = np.concatenate([results, results[:1]])
    assert (told[:, 0, 0] == expected[:, 0]).all() and (told[:, 2] == expected[:, 1:]).all()


def test_forces_wait_for_the_record_of_their_step():
    scene = held_scene()
    scene.loop.mailboxes[-1].post(number(2))
    scene.loop.run(5)
    assert len(scene.loop.other_reactions()) == 0
    scene.loop.records()
    assert scene.loop.other_reactions()["step"].tolist() == [1, 2, 3, 4, 5]


def test_parameters_are_copied_between_batches_all_together() -> None:
    """In the order of the steps, with the graphs that make work of them around; what waits can be taken back."""
    scene, order = FakeScene(), []
    box, other = ChangeMailbox(scene.loop.loop), np.zeros(2)
    for name, graph in (("before", 21), ("after", 22)):
        scene.device.graphs[graph] = partial(lambda name: order.append((name, int(scene.argument[0]), other[1])), name)

    def post(first: int, second: float) -> Any:
        new = np.array([first]), np.array([0, second])
        targets = zip((scene.argument, other), new, strict=True)
        copies = [(int(a.ctypes.data), int(b.ctypes.data), int(a.nbytes)) for a, b in targets]
        return box.post(copies, 21, 22, new)

    scene.loop.run(3)
    waits = post(5, 6.0)
    assert box.withdraw() and not box.withdraw() and waits.taken == -1
    scene.loop.run(2)
    taken = post(7, 8.0)
    assert taken.taken == -1
    scene.loop.run(20)
    assert not box.withdraw() and taken.taken == 5
    assert scene.seen == [0] * 5 + [7] * 20
    assert order == [("before", 0, 0.0), ("after", 7, 8.0)]
    post(9, 9.0)
    scene.device.fail = "on_device"
    with pytest.raises(DeviceLost, match="on_device"):
        scene.loop.run(1)


def test_a_batch_has_several_steps_where_these_are_short():
    """What is requested and posted waits for two batches."""
    batches = []
    for seconds in (1e-12, 1.0):
        scene = FakeScene()
        scene.loop.loop.batch_seconds = seconds
        scene.loop.run(40)
        assert scene.loop.records()["step"].tolist() == list(range(1, 41))
        batches.append(int(scene.loop.loop.begun))
    assert batches[0] == 40 and batches[1] < 10


def test_a_matrix_in_the_memory_of_the_loop_is_not_copied_once_more():
    """A request with other memory is served as ever; each leaves alone the matrix of the request before."""
    scene = FakeScene(bodies=3)
    scene.loop.run(20)
    own, target = [scene.loop.copy_memory(k) for k in range(3)], np.full((2, 3, 3), np.nan)
    assert all(scene.loop.copy_memory(k) is memory and memory.shape == (2, 3, 3) for k, memory in enumerate(own))
    scene.loop.request_matrix(0, own[0])
    scene.loop.request_matrix(2, own[2])
    assert scene.loop.matrix_steps(np.array([0, 1, 2])).tolist() == [-1, -1, -1]
    scene.loop.run(40)
    assert scene.loop.matrix_steps(np.array([2, 1, 0])).tolist() == [20, -1, 20]
    assert (own[0] == 20).all() and (own[2] == 20).all() and not own[1].any()
    next_one = scene.loop.copy_memory(0)
    scene.loop.request_matrix(0, next_one)
    scene.loop.request_matrix(1, own[1])
    scene.loop.run(40)
    assert scene.loop.matrix_steps(np.array([0, 1, 2])).tolist() == [60, 60, 20]
    assert (own[0] == 20).all() and (next_one == 60).all() and (own[1] == 60).all() and (own[2] == 20).all()
    scene.loop.request_matrix(1, target)
    scene.loop.request_matrix(0, scene.loop.copy_memory(0))
    scene.loop.run(40)
    assert scene.loop.matrix_steps(np.array([0, 1, 2])).tolist() == [100, 100, 20]
    assert (own[0] == 100).all() and (next_one == 60).all() and (own[1] == 60).all() and (target == 100).all()


def test_matrices_of_several_bodies_are_requested_at_once_as_one_by_one():
    scene = FakeScene(bodies=3)
    scene.loop.run(20)
    first = [scene.loop.copy_memory(k) for k in range(3)]
    asked, at = scene.loop.request_matrices(np.array([2, 0]))
    assert asked[0] is first[2] and asked[1] is first[0]
    assert at.tolist() == [first[k].ctypes.data for k in (2, 0)]
    assert scene.loop.matrix_steps(np.array([0, 1, 2])).tolist() == [-1, -1, -1]
    scene.loop.run(40)
    assert scene.loop.matrix_steps(np.array([0, 1, 2])).tolist() == [20, -1, 20]
    assert (first[0] == 20).all() and (first[2] == 20).all() and not first[1].any()
    again, _ = scene.loop.request_matrices(np.array([0, 1]))
    assert again[0] is not first[0] and again[1] is first[1]
    scene.loop.run(40)
    assert scene.loop.matrix_steps(np.array([0, 1, 2])).tolist() == [60, 60, 20]
    assert (first[0] == 20).all() and (again[0] == 60).all() and (again[1] == 60).all()
    scene.loop.request_matrix(0, third := scene.loop.copy_memory(0))
    scene.loop.run(40)
    assert third is first[0] and (third == 100).all() and (again[0] == 60).all()


@pytest.mark.parametrize("real", ["f4", "f8"])
def test_matrices_of_another_type_or_large_ones_have_no_memory_of_the_loop(monkeypatch, real):
    if real == "f8":
        monkeypatch.setattr(loop_module, "DOUBLED", 100)
    scene, target = FakeScene(bodies=2, real=real), np.zeros((2, 3, 3))
    assert scene.loop.copy_memory(1) is None and scene.loop.request_matrices(np.array([0, 1])) is None
    for step in (0, 40):
        scene.loop.request_matrix(1, target)
        scene.loop.run(40)
        assert scene.loop.matrix_step(1) == step and (target == step).all()


@pytest.mark.parametrize("real", ["f4", "f8"])
@pytest.mark.parametrize("doubled", [True, False])
def test_the_memory_of_copies_is_what_the_limit_of_memory_counts(monkeypatch, real, doubled):
    if not doubled:
        monkeypatch.setattr(loop_module, "DOUBLED", 100)
    scene, made = FakeScene(bodies=3, real=real), []

    def pinned(size: int) -> np.ndarray:
        made.append(size)
        return np.zeros(size, np.uint8)

    monkeypatch.setattr(scene.device, "pinned", pinned)
    scene.loop.prepare_copies()
    scene.loop.prepare_copies()
    assert made == [loop_module.bytes_of_copies([2, 2, 2], real)]
    assert made == [(2 if doubled else 1) * 3 * 2 * 9 * np.dtype(real).itemsize]


def transfers(scene: FakeScene) -> list[tuple[int, int]]:
    """Copies of matrices to the host from now on: first byte of the memory of copies, and bytes."""
    found: list[tuple[int, int]] = []
    to_host = scene.device.to_host

    def noted(to: int, source: int, count: int, stream: int) -> int:
        found.append((to - int(scene.loop.loop.host_matrices), count))
        return to_host(to, source, count, stream)

    scene.device.set("to_host", noted)
    return found


def test_matrices_that_are_asked_together_are_copied_in_one_launch_and_come_in_one_transfer():
    """Those of neighbours, in any order, whose last copies lie in places of the same number."""
    scene, size = FakeScene(bodies=6), 2 * 72
    scene.loop.run(20)
    graphs, found = launched(scene), transfers(scene)
    first, _ = scene.loop.request_matrices(np.array([4, 2, 3]))
    scene.loop.run(20)
    assert graphs.count(COPY_GRAPHS[2]) == 1 and found == [(6 * size + 2 * size, 3 * size)]
    found.clear()
    second, _ = scene.loop.request_matrices(np.array([0, 1, 2, 3, 5]))
    scene.loop.run(20)
    assert found == [(2 * size, 2 * size), (6 * size, 2 * size), (11 * size, size)]
    assert graphs.count(COPY_GRAPHS[2]) == 2
    assert all((each == 20).all() for each in first) and all((each == 40).all() for each in second)


def test_all_mail_of_a_batch_is_delivered_in_one_launch_and_none_where_there_is_none():
    scene = FakeScene(bodies=5)
    scene.loop.run(20)
    graphs = launched(scene)
    for body, value in ((3, 7), (0, 8), (4, 9)):
        scene.loop.mailboxes[body].post(number(value))
    scene.loop.run(60)
    assert sum(graph in COPY_GRAPHS for graph in graphs) == 1
    records = scene.loop.records()
    assert records["iterations"][-5:].tolist() == [8, 0, 0, 7, 9]


def test_batches_are_shorter_while_matrices_and_mail_come_and_go():
    lengths = []
    for exchange in (True, False):
        scene = FakeScene()
        scene.loop.loop.batch_seconds, scene.loop.loop.exchange_seconds = 1.0, 1e-12
        scene.loop.run(20)
        if exchange:  # its event never comes
            scene.loop.mailboxes[0].post(number(5), event=scene.device.event())
        begun = int(scene.loop.loop.begun)
        scene.loop.run(40)
        lengths.append(40 / (int(scene.loop.loop.begun) - begun))
        assert scene.loop.records()["step"].tolist() == list(range(1, 61))
    assert lengths[0] == 1 and lengths[1] > 4


def test_a_copy_that_has_arrived_is_published_while_the_next_batch_is_under_way():
    """Without a wait for the end of that batch."""
    scene = FakeScene()
    loop, query = scene.loop.loop, scene.device.event_query
    loop.batch_seconds = loop.exchange_seconds = 1e-12  # one step each
    scene.loop.run(5)
    scene.loop.request_matrix(0, np.zeros((2, 3, 3)))
    published = []

    def noted(event: int) -> int:
        if scene.loop.step == 6 and event != loop.copied_event:  # the next batch is awaited
            scene.device.finish_copies()
        if scene.loop.matrix_step(0) >= 0:
            published.append(scene.loop.step)
        return query(event)

    scene.device.set("event_query", noted)
    scene.device.pieces, loop.energy_every = 1, 1  # a batch takes several queries
    scene.loop.run(8)
    assert published[0] == 6 and scene.loop.matrix_step(0) == 5


@pytest.mark.parametrize(("lead", "first"), [(1e-4, 7), (1.0, 8)])
def test_what_comes_while_a_batch_is_under_way_goes_with_the_next_one(lead, first):
    """Unless that is launched long before its end: the mail comes when the sixth step is the only one under way."""
    scene = FakeScene(bodies=2)
    loop, query, posted = scene.loop.loop, scene.device.event_query, []
    loop.batch_seconds = loop.exchange_seconds = 1e-12  # one step each
    loop.lead, scene.lasts, scene.device.pieces = lead, 10_000_000, 1
    scene.loop.mailboxes[1].post(number(3), event=scene.device.event())  # which never comes: more mail is expected
    scene.loop.run(4)

    def noted(event: int) -> int:
        if scene.loop.step == 5 and not posted:
            posted.append(scene.loop.mailboxes[0].post(number(9)))
        return query(event)

    scene.device.set("event_query", noted)
    scene.loop.run(6)
    records = scene.loop.records()
    found = records[records["body"] == 0]
    assert found["step"][np.flatnonzero(found["iterations"] == 9)[0]] == first
