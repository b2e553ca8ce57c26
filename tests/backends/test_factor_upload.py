# SPDX-License-Identifier: MIT
"""Upload of factors to the GPU loop: two storages, none written while a step may read it; lack of memory."""

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim_server.backends.compiler import CompileError
from sim_server.backends.gpu import factor_upload as module
from sim_server.backends.gpu.factor_upload import FactorUpload
from sim_server.backends.gpu.upload import inverse_builds, inverse_posts
from tests.backends.fake_cuda import FakeScene


class Event:
    """The event of a build under way; the test completes it."""

    def __init__(self, scene: FakeScene):
        self._device, self.ptr = scene.device, scene.device.event()
        scene.device.begin(self.ptr)

    def synchronize(self) -> None:
        self._device.record(self.ptr)


class NoMemory(MemoryError):
    """As CuPy raises it."""


class Maker:
    """Stands for the solver and its inverse builder; a storage is a list that holds the value written to it."""

    def __init__(self, scene: FakeScene):
        self.scene = scene
        self.bodies = np.zeros(1, [("setting", "i8"), ("factor", "i8")])
        self.storages: list[list[int]] = []
        self.events: list[Event] = []
        self.limits: list[int | None] = []  # multiprocessors of each build
        self.reserved: set[tuple[int, int]] = set()  # bodies with vectors, and for which plans
        self.waits: list[int] = []  # builds that were begun before each wait for new vectors
        self.fail: Exception | None = None
        self.thread = ThreadPoolExecutor(1)
        self.unusable: set[int] = set()  # bodies for whose vectors there is no memory
        self.fine: set[int] = set()  # values whose inverses need 22 binary digits
        self.planes_used: list[int] = []
        self.each_known: list[set[tuple[int, int]]] = []  # of all calls
        self.planning: list[Future] | None = None  # plans that are not made yet; None: it is made
        self.planned: Future = Future()
        self.planned.set_result(SimpleNamespace(builder=self, plan=None))

    def planes_of(self, factors: list[tuple[SimpleNamespace, np.ndarray]]) -> list[int]:
        return [2 if values[0] in self.fine else 1 for _, values in factors]

    def begin_plan(self, body: int, pattern: SimpleNamespace, planes: int | None = None) -> Future:
        if self.planning is None and not isinstance(self.fail, ValueError):
            return self.planned
        made: Future = Future()
        if isinstance(self.fail, ValueError):
            made.set_exception(self.fail)
        else:
            self.planning.append(made)
        return made

    def beside(self, work: Callable[[], Any]) -> Future:
        return self.thread.submit(work)

    def storage(self) -> list[int]:
        self.storages.append([])
        return self.storages[-1]

    def several_storages(self, number: int) -> list[list[int]]:
        return [self.storage() for _ in range(number)]

    spared, planes = 8, None
    most = 3  # inverses that are built together

    def build_many(self, values: list[np.ndarray], storages: list[list[int]], multiprocessors: int | None) -> Event:
        if self.fail:
            raise self.fail
        assert 0 < len(values) == len(storages) <= self.most
        self.limits.append(multiprocessors)
        self.events.append(Event(self.scene))
        for each, storage in zip(values, storages, strict=True):
            storage[:] = [int(each[0])]
        return self.events[-1]

    def thread_blocks(self, bodies: np.ndarray) -> list[int]:
        return [1] * len(bodies)

    def without_vectors(self, bodies: list[int], plan: Any) -> list[int]:
        return [row for row, body in enumerate(bodies) if (body, id(plan)) not in self.reserved]

    def reserve_vectors(self, body: int, plan: Any) -> None:
        self.reserved.add((body, id(plan)))

    def wait(self) -> None:
        """Stands for the default stream's end of work, in which vectors are made."""
        self.waits.append(len(self.events))

    def apply(self, storage: list[int], r: np.ndarray, multiprocessors: int | None = None) -> np.ndarray:
        """In place of a factor the number that it is."""
        return r / storage[0]

    def forget_plans(self, kept: set[tuple[int, int]]) -> None:
        self.known = kept
        self.each_known.append(kept)

    def use(
        self, bodies: np.ndarray, planned: SimpleNamespace, storages: list[list[int]], planes: int, steps: list[int]
    ) -> np.ndarray:
        if self.unusable.intersection(bodies.tolist()):
            raise NoMemory("no vectors")
        self.bodies["factor"][bodies] = [storage[0] for storage in storages]
        self.planes_used.append(planes)
        return self.bodies["factor"][bodies].view(np.uint8).reshape(len(bodies), 8)


PATTERN = SimpleNamespace(id=1)


@pytest.fixture
def parts(monkeypatch):
    for each in (inverse_builds, inverse_posts):
        monkeypatch.setattr(each, "no_memory_left", lambda error: isinstance(error, NoMemory))
    scene = FakeScene()
    maker = Maker(scene)
    stream = SimpleNamespace(synchronize=maker.wait)
    gpu = SimpleNamespace(cp=SimpleNamespace(cuda=SimpleNamespace(get_current_stream=lambda: stream)))
    return scene, maker, FactorUpload(gpu, maker, scene.loop, ["beam"], scene.loop.mailboxes_of_bodies(1))


def held_builds(maker: Maker) -> threading.Event:
    """Has builds of inverses wait until the event is set."""
    go, build = threading.Event(), maker.build_many

    def slow(*arguments: Any) -> Event:
        assert go.wait(30)
        return build(*arguments)

    maker.build_many = slow
    return go


def post(upload: FactorUpload, value: int) -> None:
    upload.post(0, PATTERN, np.array([value]), value)


def post_all(upload: FactorUpload, values: list[int]) -> None:
    """Of each body, one that is made of another value."""
    upload.post_many([(body, PATTERN, np.array([value]), value, 0) for body, value in enumerate(values)])


def used(scene: FakeScene) -> list[int]:
    return scene.loop.records()["factor_step"].tolist()


def test_a_factor_is_used_when_it_is_made(parts):
    scene, maker, upload = parts
    post(upload, 5)
    scene.loop.run(1)
    assert upload.step(0) == -1
    maker.events[0].synchronize()
    scene.loop.run(1)
    assert upload.step(0) == 5
    assert used(scene) == [0, 5]


@pytest.mark.parametrize(("realtime", "seconds", "limit"), [(1, 1e-4, None), (1, 0.9, 8), (0, 1e-4, 8), (1, 0.0, 8)])
def test_builds_have_the_whole_device_where_steps_in_real_time_leave_it_idle(parts, realtime, seconds, limit):
    """seconds: of a step; 0: not known yet."""
    scene, maker, upload = parts
    scene.loop.loop.realtime, scene.loop.loop.step_seconds, scene.loop.loop.dt = realtime, seconds, 1.0
    post(upload, 5)
    assert maker.limits == [limit]


def test_what_comes_too_early_waits_and_the_newest_wins(parts):
    scene, maker, upload = parts
    for value in (5, 6, 7):
        post(upload, value)
    assert [t[0] for t in maker.storages] == [5]
    maker.events[0].synchronize()
    scene.loop.run(1)
    upload.advance()
    assert [t[0] for t in maker.storages] == [5, 7]
    maker.events[1].synchronize()
    scene.loop.run(1)
    assert used(scene) == [5, 7]
    assert upload.step(0) == 7


def test_two_storages_do_and_the_one_in_use_is_never_written_to(parts):
    scene, maker, upload = parts
    for value in range(1, 40):
        post(upload, value)
        maker.events[-1].synchronize()
        if value % 3 == 0:
            scene.loop.run(1)
            upload.advance()
            assert scene.factor[0] == upload.step(0) and [upload.step(0)] in maker.storages
    assert len(maker.storages) == 2


def test_what_was_launched_with_a_factor_ends_before_its_storage_is_written_again(parts):
    scene, maker, upload = parts
    post(upload, 1)
    upload.settle()
    scene.loop.run(1)
    post(upload, 2)
    upload.settle()
    scene.loop.run(1)
    assert upload.step(0) == 2
    post(upload, 3)
    upload.settle()
    scene.loop.run(1)
    scene.loop.loop.step -= 2  # as if the steps that were launched before it was taken were under way
    post(upload, 4)
    assert [t[0] for t in maker.storages] == [3, 2]
    scene.loop.loop.step += 1
    upload.advance()
    assert [t[0] for t in maker.storages] == [3, 4]


def test_nobody_waits_for_a_plan_and_the_newest_factor_wins(parts):
    scene, maker, upload = parts
    maker.planning = plans = []
    for value in (5, 6, 7):
        post(upload, value)
        upload.advance()
    scene.loop.run(1)  # goes without
    assert len(plans) == 1 and maker.storages == [] and upload.step(0) == -1
    maker.planning = None
    plans[0].set_result(SimpleNamespace(builder=maker, plan=None))
    upload.settle()  # the first one is withdrawn, since another waits
    scene.loop.run(1)
    assert used(scene) == [0, 7] and upload.step(0) == 7


def test_a_plan_that_fails_beside_the_caller_is_told_once(parts, caplog):
    scene, maker, upload = parts
    maker.planning = plans = []
    post(upload, 5)
    plans[0].set_exception(ValueError("not by nodes"))
    with caplog.at_level(logging.WARNING):
        upload.settle()
    assert "not by nodes" in caplog.text and len(caplog.records) == 1
    maker.planning = None
    post(upload, 6)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [6]


def test_large_factors_are_built_beside_the_caller(parts, monkeypatch):
    scene, maker, upload = parts
    monkeypatch.setattr(module, "SMALL", 0)
    begun, callers = threading.Event(), []
    build = maker.build_many

    def slow(*arguments: Any) -> Event:
        callers.append(threading.current_thread())
        begun.wait(30)
        return build(*arguments)

    maker.build_many = slow
    post(upload, 5)
    post(upload, 6)
    assert upload.step(0) == -1 and maker.storages in ([], [[]])  # it is under way
    begun.set()
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [6] and threading.current_thread() not in callers


R = np.ones(3)


def prepared(upload: FactorUpload, value: int) -> tuple[np.ndarray, Future]:
    values = np.array([value])
    return values, upload.prepare(0, PATTERN, values, value, R)


def test_a_prepared_factor_is_built_and_applied_and_used_once_it_is_posted(parts):
    scene, maker, upload = parts
    values, applied = prepared(upload, 5)
    np.testing.assert_array_equal(applied.result(30), R / 5)
    maker.thread.submit(lambda: None).result()
    maker.events[0].synchronize()
    upload.advance()
    scene.loop.run(2)
    assert upload.step(0) == -1, "nobody has posted it"
    upload.post(0, PATTERN, values, 5)
    scene.loop.run(1)
    assert upload.step(0) == 5 and len(maker.storages) == 1 and used(scene) == [0, 0, 5]


def test_what_is_posted_before_it_is_built_is_used_then(parts):
    scene, maker, upload = parts
    go = held_builds(maker)
    values, _ = prepared(upload, 5)
    upload.post(0, PATTERN, values, 5)
    go.set()
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [5] and len(maker.events) == 1


@pytest.mark.parametrize("late", [False, True])
def test_a_dropped_factor_is_never_used_and_leaves_its_storage(parts, late):
    scene, maker, upload = parts
    post(upload, 4)
    upload.settle()
    scene.loop.run(1)
    for value in (5, 6, 7):
        values, applied = prepared(upload, value)
        if late:
            applied.result(30)
            maker.thread.submit(lambda: None).result()
            upload.advance()
        upload.drop(0, np.array([value]))  # equal, but not the same: another factor
        upload.drop(0, values)
        assert applied.done() or not late
        maker.thread.submit(lambda: None).result()
        upload.advance()
        scene.loop.run(1)
    post(upload, 8)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [4, 4, 4, 4, 8] and len(maker.storages) == 2


def test_a_newer_factor_takes_the_place_of_a_prepared_one_and_its_check_is_told(parts):
    scene, maker, upload = parts
    _, applied = prepared(upload, 5)
    applied.result(30)
    maker.thread.submit(lambda: None).result()
    upload.advance()
    post(upload, 6)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [6]
    post(upload, 7)
    post(upload, 8)  # waits for the loop
    _, waiting = prepared(upload, 9)
    prepared(upload, 10)
    assert waiting.result(0) is None


def test_where_a_prepared_factor_cannot_be_applied_its_check_goes_without(parts, monkeypatch, caplog):
    """The device writes into its storage by then, so that it is kept."""
    scene, maker, upload = parts

    def full(*arguments: Any) -> None:
        raise NoMemory("full")

    monkeypatch.setattr(maker, "apply", full)
    with caplog.at_level(logging.WARNING):
        values, applied = prepared(upload, 5)
        assert applied.result(30) is None
        maker.thread.submit(lambda: None).result()
    assert [each.message for each in caplog.records] == ["object 'beam': a factor is not applied for its check: full"]
    upload.post(0, PATTERN, values, 5)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [5] and len(maker.events) == len(maker.storages) == 1


def test_a_build_that_fails_leaves_those_that_are_under_way(many, caplog):
    """Of one plan, of which the builder takes a few at a time."""
    maker, upload, boxes = many
    build, asked = maker.build_many, count(1)

    def full(*arguments: Any) -> Event:
        if next(asked) == 2:
            raise NoMemory("full")
        return build(*arguments)

    maker.build_many = full
    with caplog.at_level(logging.WARNING):
        post_all(upload, list(range(1, len(boxes) + 1)))
        maker.thread.submit(lambda: None).result()
        upload.advance()
    assert [box.posted for box in boxes] == [1, 2, 3, 0]
    assert [each.message.split("'")[1] for each in caplog.records] == ["beam3"]


def test_who_checks_is_told_that_nothing_can_be_built(parts, caplog):
    scene, maker, upload = parts
    maker.fail = NoMemory("none")
    values, applied = prepared(upload, 5)
    assert applied.result(30) is None
    maker.thread.submit(lambda: None).result()
    maker.fail = None
    with caplog.at_level(logging.WARNING):
        upload.advance()
    assert "not enough GPU memory" in caplog.text
    upload.post(0, PATTERN, values, 5)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [5]


def test_plans_are_kept_of_the_last_two_patterns_alone(parts):
    """Each split of an object makes another one."""
    scene, maker, upload = parts
    for number in range(1, 6):
        upload.post(0, SimpleNamespace(id=number), np.array([number]), 0)
        upload.settle()
        scene.loop.run(1)
        assert maker.known == {(n, 1) for n in range(max(1, number - 1), number + 1)}


def test_plans_of_factors_that_were_made_together_are_kept_until_all_are_posted(many):
    """Else each but the first would be planned once more, and whoever posts would wait for it."""
    maker, upload, boxes = many
    kinds = [SimpleNamespace(id=number) for number in range(1, len(boxes) + 1)]
    upload.post_many([(body, kind, np.array([kind.id]), kind.id, 0) for body, kind in enumerate(kinds)])
    maker.thread.submit(lambda: None).result()
    upload.advance()
    assert [box.posted for box in boxes] == [kind.id for kind in kinds]
    assert maker.each_known and all({(kind.id, 1) for kind in kinds} <= known for known in maker.each_known)


def test_plans_of_factors_that_are_expected_are_kept(many):
    """Such as those of large bodies, which a server makes as it starts; of each body those of one pattern."""
    maker, upload, _ = many
    for number in (7, 8, 9):
        upload.expect(1, SimpleNamespace(id=number))
    post(upload, 5)
    assert maker.known == {(PATTERN.id, 1), (9, 1), (9, 2)}
    upload.post(1, SimpleNamespace(id=10), np.array([6]), 1)
    assert maker.known == {(PATTERN.id, 1), (10, 1)}, "it came with another one"


def test_each_inverse_has_as_many_digits_as_its_factor_needs(parts, caplog):
    """Two storages of each kind are reused; what changes is logged."""
    scene, maker, upload = parts
    maker.fine = {7, 8, 11}
    with caplog.at_level(logging.INFO):
        for value in range(5, 12):
            post(upload, value)
            upload.settle()
            scene.loop.run(1)
    assert maker.planes_used == [1, 1, 2, 2, 1, 1, 2]
    assert used(scene) == list(range(5, 12))
    assert len(maker.storages) == 4 and maker.known == {(PATTERN.id, 1), (PATTERN.id, 2)}
    assert [
        f"{digits} binary digits" in each.message for each, digits in zip(caplog.records, (22, 11, 22), strict=True)
    ]


@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("prepare", [False, True])
def test_a_large_factor_is_looked_at_and_built_beside_the_caller(parts, monkeypatch, prepare, waits):
    """Where its plan is not made yet it is built behind that. prepare: before it is posted"""
    scene, maker, upload = parts
    monkeypatch.setattr(module, "SMALL", 0)
    maker.fine, threads = {5}, []
    choose = maker.planes_of

    def seen(*arguments: Any) -> int:
        threads.append(threading.current_thread())
        return choose(*arguments)

    def queued(body: int, pattern: SimpleNamespace, planes: int) -> Future:
        return maker.thread.submit(lambda: SimpleNamespace(builder=maker, plan=None))

    maker.planes_of = seen
    if waits:
        maker.begin_plan = queued
    values = np.array([5])
    if prepare:
        np.testing.assert_array_equal(upload.prepare(0, PATTERN, values, 5, R).result(30), R / 5)
    upload.post(0, PATTERN, values, 5)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [5] and maker.planes_used == [2]
    assert len(maker.events) == (1 if waits else 2), "it was begun with 11 digits where that had a plan"
    assert threads and threading.current_thread() not in threads


@pytest.mark.parametrize("fine", [False, True])
def test_an_inverse_is_built_while_its_digits_are_found_and_told_of_once_they_are(parts, fine):
    """With as many digits as the one before; with others it is built again, and only that is told."""
    scene, maker, upload = parts
    went, known = threading.Event(), threading.Event()
    builds = maker.build_many
    maker.fine = {5} if fine else set()

    def begun(*arguments: Any) -> Event:
        found = builds(*arguments)
        went.set()
        return found

    def planes_of(factors: list[tuple[SimpleNamespace, np.ndarray]]) -> list[int]:
        assert known.wait(30)
        return [2 if values[0] in maker.fine else 1 for _, values in factors]

    maker.build_many, maker.planes_of = begun, planes_of
    values, applied = prepared(upload, 5)
    assert went.wait(30) and not applied.done()
    known.set()
    np.testing.assert_array_equal(applied.result(30), R / 5)
    upload.post(0, PATTERN, values, 5)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [5] and maker.planes_used == [2 if fine else 1]
    assert len(maker.events) == (2 if fine else 1)


def test_settled_means_used_by_the_next_step_even_if_others_wait(parts):
    scene, maker, upload = parts
    for value in (5, 6, 7):
        post(upload, value)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [7]
    assert len(maker.storages) <= 2


@pytest.mark.parametrize(
    "error", [ValueError("not by nodes"), NoMemory("Out of memory allocating 5,000 bytes"), CompileError("x.cu(3): no")]
)
def test_a_factor_that_does_not_fit_leaves_what_is_there_and_is_told_once(parts, caplog, error):
    scene, maker, upload = parts
    post(upload, 5)
    upload.settle()
    maker.fail = error
    with caplog.at_level(logging.WARNING):
        for value in (6, 7, 8):
            scene.loop.run(1)
            post(upload, value)
            upload.settle()
    assert used(scene) == [5, 5, 5]
    assert upload.step(0) == 5
    assert len(caplog.records) == 1
    assert "object 'beam'" in caplog.text and str(error) in caplog.text and "the factor that it has" in caplog.text
    maker.fail = None
    post(upload, 9)
    upload.settle()
    scene.loop.run(1)
    assert used(scene) == [9]


def test_a_build_waits_for_vectors_that_are_new_and_only_for_them(parts):
    scene, maker, upload = parts
    for value in (5, 7, 9):
        post(upload, value)
        upload.settle()
        scene.loop.run(1)
    assert len(maker.events) == 3 and maker.waits == [0]


def test_other_errors_are_not_hidden(parts):
    _, maker, upload = parts
    maker.fail = RuntimeError("broken")
    with pytest.raises(RuntimeError, match="broken"):
        post(upload, 5)


@pytest.fixture
def many(parts, monkeypatch):
    """Bodies enough for their factors to be many."""
    scene, maker, _ = parts
    maker.bodies = np.zeros(module.MANY, maker.bodies.dtype)
    boxes = [Mailbox() for _ in maker.bodies]
    stream = SimpleNamespace(synchronize=maker.wait)
    gpu = SimpleNamespace(cp=SimpleNamespace(cuda=SimpleNamespace(get_current_stream=lambda: stream)))
    return maker, FactorUpload(gpu, maker, scene.loop, [f"beam{k}" for k in range(len(boxes))], Boxes(boxes)), boxes


class Mailbox:
    """A mailbox whose mail the test takes."""

    taken, posted, row, count = False, 0, b"", 0


class Boxes:
    """Such ones as mailbox.Mailboxes."""

    def __init__(self, boxes: list[Mailbox]):
        self.boxes = boxes

    def __len__(self) -> int:
        return len(self.boxes)

    def post(self, bodies: np.ndarray, data: np.ndarray, event: Event, keep: Any) -> None:
        for body, row in zip(bodies.tolist(), data, strict=True):
            box = self.boxes[body]
            box.taken, box.posted, box.row, box.count = False, int(row.view(np.int64)[0]), row.tobytes(), box.count + 1

    def taken(self, bodies: np.ndarray) -> np.ndarray:
        return np.array([self.boxes[body].taken for body in bodies.tolist()], bool)

    def after(self, bodies: np.ndarray) -> np.ndarray:
        return np.zeros(len(bodies), np.int64)


def test_of_factors_that_come_faster_than_they_are_built_the_newest_wait(many, monkeypatch):
    """The thread that builds has no more than it is about to build, so that what waits is not built when it is old:
    those first whose body has waited longest."""
    maker, upload, boxes = many
    monkeypatch.setattr(module, "TOGETHER", 1)
    go, begun, chosen, choose = threading.Event(), threading.Event(), [], maker.planes_of

    def slow(factors: list[tuple[SimpleNamespace, np.ndarray]]) -> list[int]:
        begun.set()
        assert go.wait(30)
        chosen.extend(int(values[0]) for _, values in factors)
        return choose(factors)

    maker.planes_of = slow
    for value in range(10, 80, 10):
        post_all(upload, [value + body for body in range(len(boxes))])
        upload.advance()
    assert begun.wait(30) and not chosen
    go.set()
    while not all(box.posted for box in boxes):
        maker.thread.submit(lambda: None).result()
        upload.advance()
    expected = [10, 11, *(70 + body for body in range(2, len(boxes)))]
    assert chosen == expected == [box.posted for box in boxes]


def test_many_are_built_beside_the_caller(many):
    """Who posts them waits for no build; each goes into the mailbox of its body once it is looked at again."""
    maker, upload, boxes = many
    go = held_builds(maker)
    values = list(range(1, len(boxes) + 1))
    assert len(values) == maker.most + 1
    post_all(upload, values)
    upload.advance()
    assert [box.posted for box in boxes] == [0] * len(boxes), "none is built yet"
    go.set()
    maker.thread.submit(lambda: None).result()
    upload.advance()
    assert [box.posted for box in boxes] == values and len(maker.events) == 2, "as many at a time as the builder takes"
    assert [np.frombuffer(box.row, np.int64).tolist() for box in boxes] == [[value] for value in values]
    post_all(upload, [v + 10 for v in values])  # the mail waits: these do, too
    assert len(maker.storages) == len(boxes)
    for box in boxes:
        box.taken = True
    upload.advance()
    maker.thread.submit(lambda: None).result()
    upload.advance()
    assert [box.posted for box in boxes] == [v + 10 for v in values] and len(maker.storages) == 2 * len(boxes)


def test_many_are_posted_by_the_thread_that_builds_them(many):
    """Nobody has to look whether they are built."""
    maker, upload, boxes = many
    values = list(range(1, len(boxes) + 1))
    post_all(upload, values)
    maker.thread.submit(lambda: None).result()
    assert [box.posted for box in boxes] == values
    upload.advance()
    assert [box.count for box in boxes] == [1] * len(boxes), "once"


def test_what_fails_while_they_are_posted_is_told_to_who_serves_the_loop(many, monkeypatch):
    maker, upload, boxes = many
    broken = RuntimeError("broken")

    def fails(*arguments: Any) -> Any:
        raise broken

    with monkeypatch.context() as patch:
        patch.setattr(Boxes, "post", fails)
        post_all(upload, list(range(1, len(boxes) + 1)))
        maker.thread.submit(lambda: None).result()
    with pytest.raises(RuntimeError, match="broken"):
        upload.advance()
    upload.advance()
    post_all(upload, values := [9] * len(boxes))
    maker.thread.submit(lambda: None).result()
    assert [box.posted for box in boxes] == values


def given(boxes: list[Mailbox], step: int) -> list[tuple[int, Any, np.ndarray, int, int]]:
    return [(body, PATTERN, np.array([step + body]), step + body, 0) for body in range(len(boxes))]


@pytest.mark.parametrize("early", [True, False], ids=["posted before they are built", "after"])
def test_many_that_were_prepared_are_built_once_and_used_when_they_are_posted(many, early):
    maker, upload, boxes = many
    go = held_builds(maker)
    factors = given(boxes, 10)
    upload.prepare_many(factors)
    if early:
        upload.post_many(factors)
    go.set()
    maker.thread.submit(lambda: None).result()
    upload.advance()
    if not early:
        assert [box.posted for box in boxes] == [0] * len(boxes), "nobody has posted them"
        upload.post_many(factors)
    assert [box.posted for box in boxes] == [step for *_, step, _ in factors] and len(maker.storages) == len(boxes)


def test_of_many_that_were_prepared_what_is_dropped_or_replaced_is_not_used(many):
    maker, upload, boxes = many
    first, second = given(boxes, 10), given(boxes, 20)
    upload.prepare_many(first)
    maker.thread.submit(lambda: None).result()
    for body, _, values, *_ in first[:2]:
        upload.drop(body, values)
    upload.post_many(second[1:])  # those of the others are replaced, as their factors were never posted
    maker.thread.submit(lambda: None).result()
    upload.advance()
    assert [box.posted for box in boxes] == [0, *(20 + body for body in range(1, len(boxes)))]
    upload.post_many(second[:1])
    assert boxes[0].posted == 20


def test_a_factor_that_is_never_posted_holds_up_none_after_it(many):
    """It is being built when the next one comes, which waits until then."""
    maker, upload, boxes = many
    go = held_builds(maker)
    upload.prepare_many(given(boxes, 10))
    upload.prepare_many(given(boxes, 15))  # one comes already
    upload.post_many(given(boxes, 20))
    go.set()
    for _ in range(3):
        maker.thread.submit(lambda: None).result()
        upload.advance()
    assert [box.posted for box in boxes] == [20 + body for body in range(len(boxes))]


def test_a_factor_that_is_never_posted_is_replaced_by_one_that_is_checked_alone(many):
    """Its job was over when its check had ended: nobody drops it, and nobody waits for that."""
    maker, upload, boxes = many
    upload.prepare_many(given(boxes, 10))
    maker.thread.submit(lambda: None).result()
    assert upload.may_prepare(0)
    values, applied = prepared(upload, 5)
    np.testing.assert_array_equal(applied.result(30), R / 5)
    maker.thread.submit(lambda: None).result()
    upload.post(0, PATTERN, values, 5)
    assert [box.posted for box in boxes] == [5, *[0] * (len(boxes) - 1)] and len(maker.storages) == len(boxes)


@pytest.mark.parametrize("alone", [False, True])
def test_what_is_posted_while_newer_ones_are_prepared_does_not_come_behind_them(many, alone):
    """The check of the older ones may end later: it waits for the one under way."""
    maker, upload, boxes = many
    go = held_builds(maker)
    upload.prepare_many(newer := given(boxes, 20))
    for factors in (given(boxes, 10), newer):
        if alone:
            for each in factors:
                upload.post(*each[:4])
        else:
            upload.post_many(factors)
    go.set()
    for _ in range(3):
        maker.thread.submit(lambda: None).result()
        upload.advance()
        for box in boxes:
            box.taken = True
    assert [box.posted for box in boxes] == [20 + body for body in range(len(boxes))]
    assert [box.count for box in boxes] == [1] * len(boxes)


def test_few_are_not_prepared(many):
    maker, upload, boxes = many
    upload.prepare_many(given(boxes, 10)[:-2])
    maker.thread.submit(lambda: None).result()
    assert maker.storages == []
    post_all(upload, [7] * len(boxes))
    maker.thread.submit(lambda: None).result()
    assert [box.posted for box in boxes] == [7] * len(boxes)


def test_of_several_of_one_body_among_many_the_last_one_is_used(many):
    maker, upload, boxes = many
    given = [*range(len(boxes)), 0]
    upload.post_many([(body, PATTERN, np.array([step]), step, 0) for step, body in enumerate(given, 1)])
    maker.thread.submit(lambda: None).result()
    upload.advance()
    assert [box.posted for box in boxes] == [len(given), *range(2, len(given))]


def test_what_is_dropped_while_it_is_built_is_not_applied(parts, monkeypatch):
    _, maker, upload = parts
    go, applications = held_builds(maker), []
    monkeypatch.setattr(maker, "apply", lambda *arguments: applications.append(arguments))
    values, applied = prepared(upload, 5)
    upload.drop(0, values)
    assert applied.result(0) is None
    go.set()
    maker.thread.submit(lambda: None).result()
    upload.advance()
    assert len(maker.events) == 1 and applications == []


def test_few_are_built_at_once(many):
    maker, upload, boxes = many
    post_all(upload, [1, 2])
    assert [box.posted for box in boxes[:2]] == [1, 2] and len(maker.storages) == 2


def test_one_of_many_that_cannot_be_used_is_told_alone(many, caplog):
    maker, upload, boxes = many
    storage, asked = maker.storage, count(1)

    def spoiled() -> list[int]:
        if next(asked) == 2:
            raise NoMemory("full")
        return storage()

    def full(number: int) -> list[list[int]]:
        raise NoMemory("full")  # for all together; they are made one by one then

    maker.storage, maker.several_storages = spoiled, full
    with caplog.at_level(logging.WARNING):
        post_all(upload, list(range(1, len(boxes) + 1)))
        maker.thread.submit(lambda: None).result()
        upload.advance()
    assert [box.posted for box in boxes] == [1, 0, *range(3, len(boxes) + 1)]
    assert [r.message for r in caplog.records] == [
        "object 'beam1': a factor cannot be used on the GPU: not enough GPU memory: full; it goes on with block Jacobi"
    ]


def test_one_of_many_that_has_no_vectors_is_told_alone(many, caplog):
    maker, upload, boxes = many
    maker.unusable = {1}
    with caplog.at_level(logging.WARNING):
        post_all(upload, list(range(1, len(boxes) + 1)))
        maker.thread.submit(lambda: None).result()
        upload.advance()
    assert [box.posted for box in boxes] == [1, 0, *range(3, len(boxes) + 1)]
    assert [r.message for r in caplog.records] == [
        "object 'beam1': a factor cannot be used on the GPU: not enough GPU memory: no vectors; "
        "it goes on with block Jacobi"
    ]


def test_digits_that_are_known_are_not_found_out_again(many):
    """Who checks factors finds them out; of those that are not known the others are."""
    maker, upload, boxes = many
    asked, choose = list[int](), maker.planes_of

    def planes_of(factors: list[tuple[SimpleNamespace, np.ndarray]]) -> list[int]:
        asked.extend(int(values[0]) for _, values in factors)
        return choose(factors)

    maker.planes_of, maker.fine = planes_of, {11}
    factors = [(body, PATTERN, np.array([10 + body]), 10 + body, planes) for body, planes in enumerate((2, 0, 1, 0))]
    upload.post_many(factors)
    maker.thread.submit(lambda: None).result()
    assert asked == [11, 13] and [box.posted for box in boxes] == [10, 11, 12, 13]
    assert sorted(maker.planes_used) == [1, 2]


def test_those_that_wait_are_begun_by_the_thread_that_ended_others(many, monkeypatch):
    """Nobody has to look."""
    maker, upload, boxes = many
    monkeypatch.setattr(module, "TOGETHER", 1)
    go = held_builds(maker)
    post_all(upload, values := list(range(1, len(boxes) + 1)))
    go.set()
    for _ in boxes:
        maker.thread.submit(lambda: None).result()
    assert [box.posted for box in boxes] == values


def test_a_body_whose_inverse_could_not_be_kept_gets_the_next_one(many, monkeypatch):
    maker, upload, boxes = many

    def fails(kept: set[tuple[int, int]]) -> None:
        raise RuntimeError("broken")

    with monkeypatch.context() as patch:
        patch.setattr(maker, "forget_plans", fails)
        post_all(upload, [1] * len(boxes))
        maker.thread.submit(lambda: None).result()
    with pytest.raises(RuntimeError, match="broken"):
        upload.advance()
    post_all(upload, values := [9] * len(boxes))
    maker.thread.submit(lambda: None).result()
    assert [box.posted for box in boxes] == values
    upload.settle()


def test_who_settles_is_told_what_failed_beside(many, monkeypatch):
    maker, upload, boxes = many
    go = held_builds(maker)
    with monkeypatch.context() as patch:
        patch.setattr(maker, "forget_plans", lambda kept: 1 / 0)
        post_all(upload, [1] * len(boxes))
        go.set()
        with pytest.raises(ZeroDivisionError):
            upload.settle()


@pytest.mark.parametrize(("most", "short", "limit"), [(3, 64, None), (3, 16, 8), (4, 64, 8)])
def test_many_small_ones_have_the_whole_device_for_an_instant(many, monkeypatch, most, short, limit):
    """Others would wait for them; what lasts longer, or is of few, keeps to what solves leave free. most: inverses
    that count as many. short: bytes of their values at most"""
    maker, upload, boxes = many
    monkeypatch.setattr(inverse_builds, "MANY", most)
    monkeypatch.setattr(inverse_builds, "SHORT", short)
    post_all(upload, list(range(1, len(boxes) + 1)))  # three together, and one
    maker.thread.submit(lambda: None).result()
    assert maker.limits == [limit, 8]
