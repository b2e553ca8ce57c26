# SPDX-License-Identifier: MIT
"""Every kind of wrong answer is refused and counted, and right ones still pass."""

import math
import random
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hand_worker import HandWorker, change
from link_helpers import DenseAnalysis, Driver, chain, dense, matrix, product

from protocol.messages_pb2 import Factor, FactorPattern, Matrix
from sim_server.network.link import ServerLink
from sim_server.updates.factor_source import Job
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

BEAM = chain()


@pytest.fixture(scope="module")
def stage() -> Iterator[tuple[Driver, HandWorker]]:
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint], shared_memory=False, silence=60) as link,
        HandWorker(endpoint, link.incarnation) as hand,
    ):
        driver = Driver(link)
        link.announce(BEAM)
        hand.hello()
        driver.until(link.dispatch.ready, "the worker")
        yield driver, hand


def good_round(driver: Driver, hand: HandWorker, step: int) -> None:
    """One matrix, one right answer, one factor."""
    driver.submit(BEAM, step, shift=0.5)
    answer, values = hand.right_answer(hand.receive(), BEAM, 0.5)
    hand.answer(answer, values)
    factor = driver.until(lambda: next((f for f in driver.factors if f.step == step), None), "a good factor")
    assert np.allclose(product(factor), dense(BEAM, matrix(BEAM, 0.5)), atol=1e-5)
    assert (factor.worker, factor.warp, factor.epoch, factor.object) == ("hand", True, 1, "beam")


def refused(driver: Driver, kind: str, count: int) -> Callable[[], bool]:
    return lambda: driver.link.counters.refusals[kind] >= count


STEPS = iter(range(1, 1000))
Wrong = Callable[[HandWorker, Matrix, Factor, np.ndarray], None]


def with_field(**changes: object) -> Wrong:
    def wrong(hand: HandWorker, job: Matrix, answer: Factor, values: np.ndarray) -> None:
        change(answer, changes)
        hand.answer(answer, values, "beam")

    return wrong


def with_values(edit: Callable[[np.ndarray], np.ndarray | bytes], *, checksum: bool = True) -> Wrong:
    def wrong(hand: HandWorker, job: Matrix, answer: Factor, values: np.ndarray) -> None:
        from protocol.validate import checksum as sum_of

        edited = edit(values.copy())
        if checksum:
            answer.checksum = sum_of(edited)
        hand.answer(answer, edited)

    return wrong


def put(index: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def edit(values: np.ndarray) -> np.ndarray:
        values[index] = value
        return values

    return edit


def of_another_pattern(hand: HandWorker, job: Matrix, answer: Factor, values: np.ndarray) -> None:
    answer.pattern ^= 1
    hand.answer(answer, values)


def of_another_worker(hand: HandWorker, job: Matrix, answer: Factor, values: np.ndarray) -> None:
    answer.worker = "other"
    hand.put("factor", values.tobytes(), answer.SerializeToString(), worker="other", object="beam")


# Wrong in its content: the job is over, and the object may be sent again at once.
CONTENT: dict[str, tuple[str, Wrong]] = {
    "NaN": ("not_finite", with_values(put(5, math.nan))),
    "infinity at the end": ("not_finite", with_values(put(-1, math.inf))),
    "diagonal zero": ("not_positive", with_values(put(0, 0.0))),
    "diagonal negative": ("not_positive", with_values(put(-1, -1.0))),
    "values flipped after the checksum": ("checksum", with_values(put(7, 0.25), checksum=False)),
    "one value short": ("size", with_values(lambda values: values[:-1])),
    "one byte long": ("size", with_values(lambda values: values.tobytes() + b"\0")),
    "no values": ("size", with_values(lambda values: b"")),
    "float64 for float32": ("size", with_values(lambda values: values.astype(np.float64))),
    "other dtype": ("malformed", with_field(dtype="float16")),
    "other step": ("malformed", with_field(step=12345)),
    "other warp": ("malformed", with_field(warp=False)),
    "other size": ("shape", with_field(nonzeros=2**62)),
    "pattern never sent": ("pattern", of_another_pattern),
    "slot that was not lent": ("slot", with_field(slot__segment="1.zenoh", slot__offset=64)),
}

# Not an answer to this job at all: it is dropped, and the right answer may still come.
ENVELOPE: dict[str, tuple[str, Wrong]] = {
    "other protocol": ("version", with_field(header__protocol=99)),
    "an earlier life of the server": ("incarnation", with_field(header__incarnation=1)),
    "unknown object": ("object", with_field(header__object="liver")),
    "object that cannot be": ("malformed", with_field(header__object="../x")),
    "future epoch": ("epoch", with_field(header__epoch=2)),
    "job never sent": ("sequence", with_field(job=10**9)),
    "job of the past": ("duplicate", with_field(job=1)),
    "job of another worker": ("duplicate", of_another_worker),
    "name of another worker": ("worker", with_field(worker="other")),
    "NaN seconds": ("not_finite", with_field(seconds=math.nan)),
    "negative seconds": ("malformed", with_field(seconds=-1.0)),
    "endless text": ("size", with_field(failure="x" * 10_000)),
    "no message": (
        "malformed",
        lambda hand, job, answer, values: hand.put("factor", b"", worker="hand", object="beam"),
    ),
    "random bytes": (
        "malformed",
        lambda hand, job, answer, values: hand.put("factor", b"", b"\xff" * 40, worker="hand", object="beam"),
    ),
    "message too long": (
        "size",
        lambda hand, job, answer, values: hand.put("factor", b"", b"\0" * (1 << 17), worker="hand", object="beam"),
    ),
    "cut message": (
        "malformed",
        lambda hand, job, answer, values: hand.put(
            "factor", b"", answer.SerializeToString()[:-3], worker="hand", object="beam"
        ),
    ),
    "key of another object": ("object", lambda hand, job, answer, values: hand.answer(answer, values, "liver")),
    "matrix sent back": (
        "malformed",
        lambda hand, job, answer, values: hand.put("factor", b"", b"\x12\x80", worker="hand", object="beam"),
    ),
}


@pytest.mark.parametrize("name", CONTENT)
def test_a_wrong_factor_ends_the_job_and_nothing_else(stage: tuple[Driver, HandWorker], name: str) -> None:
    driver, hand = stage
    kind, wrong = CONTENT[name]
    good_round(driver, hand, next(STEPS))
    before, factors = driver.link.counters.refusals[kind], len(driver.factors)
    driver.submit(BEAM, next(STEPS))
    job = hand.receive()
    wrong(hand, job, *hand.right_answer(job, BEAM))
    driver.until(refused(driver, kind, before + 1), name)
    assert len(driver.factors) == factors
    assert driver.failures[-1][0] == "beam" and "was refused" in driver.failures[-1][1]
    good_round(driver, hand, next(STEPS))


@pytest.mark.parametrize("name", ENVELOPE)
def test_what_answers_no_job_is_dropped_and_the_answer_still_counts(
    stage: tuple[Driver, HandWorker], name: str
) -> None:
    driver, hand = stage
    kind, wrong = ENVELOPE[name]
    good_round(driver, hand, next(STEPS))
    before, step, failed = driver.link.counters.refusals[kind], next(STEPS), len(driver.failures)
    driver.submit(BEAM, step)
    job = hand.receive()
    answer, values = hand.right_answer(job, BEAM)
    spoiled = Factor.FromString(answer.SerializeToString())
    wrong(hand, job, spoiled, values)
    driver.until(refused(driver, kind, before + 1), name)
    assert len(driver.failures) == failed
    hand.answer(answer, values)
    driver.until(lambda: driver.factors[-1].step == step, "the right answer")


def test_an_answer_counts_once(stage: tuple[Driver, HandWorker]) -> None:
    driver, hand = stage
    step = next(STEPS)
    driver.submit(BEAM, step)
    answer, values = hand.right_answer(hand.receive(), BEAM)
    before = driver.link.counters.refusals["duplicate"]
    for _ in range(3):
        hand.answer(answer, values)
    driver.until(refused(driver, "duplicate", before + 2), "two duplicates")
    assert [factor.step for factor in driver.factors].count(step) == 1


def test_what_the_worker_could_not_do_is_reported(stage: tuple[Driver, HandWorker]) -> None:
    driver, hand = stage
    driver.submit(BEAM, next(STEPS))
    answer, _ = hand.right_answer(hand.receive(), BEAM)
    answer.failure = "not positive definite at node 3"
    hand.answer(answer)
    driver.until(lambda: any("node 3" in reason for _, reason in driver.failures), "the failure")
    good_round(driver, hand, next(STEPS))


def test_an_answer_of_the_last_epoch_is_refused(stage: tuple[Driver, HandWorker]) -> None:
    driver, hand = stage
    driver.link.announce(chain(6, "cut", 1))
    driver.submit(chain(6, "cut", 1), 1)
    answer, values = hand.right_answer(hand.receive(), chain(6, "cut", 1))
    driver.link.announce(chain(5, "cut", 2))
    before = driver.link.counters.refusals["epoch"]
    hand.answer(answer, values)
    driver.until(refused(driver, "epoch", before + 1), "the refusal")
    assert not [f for f in driver.factors if f.object == "cut"]
    driver.until(driver.link.dispatch.ready, "the worker to be free again")
    assert driver.link.counters.leases_over == 0  # freed by its answer, though that was worth nothing
    driver.submit(chain(5, "cut", 2), 2)
    hand.answer(*hand.right_answer(hand.receive(), chain(5, "cut", 2)))
    driver.until(lambda: [f for f in driver.factors if f.object == "cut" and f.epoch == 2], "a factor of epoch 2")


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"header__incarnation": 3}, "incarnation"),
        ({"worker": "somebody"}, "worker"),
        ({"worker": "a/b"}, "malformed"),
        ({"host": "x" * 300}, "size"),
        ({"pid": 2}, "worker"),
    ],
)
def test_wrong_hellos_are_refused(stage: tuple[Driver, HandWorker], changes: dict[str, object], kind: str) -> None:
    driver, hand = stage
    before = driver.link.counters.refusals[kind]
    hand.hello()
    hand.hello(**changes)
    driver.until(refused(driver, kind, before + 1), kind)
    assert [info.worker for info in driver.link.dispatch.workers()] == ["hand"]
    good_round(driver, hand, next(STEPS))


def test_a_hello_without_a_token_makes_no_worker(stage: tuple[Driver, HandWorker]) -> None:
    driver, hand = stage
    with HandWorker.__new__(HandWorker) as ghost:
        ghost.__dict__.update(hand.__dict__ | {"name": "ghost", "close": lambda: None})
        ghost.hello()
        hand.hello()
        before = driver.link.counters.refusals["sequence"]
        hand.sequence -= 1
        hand.hello()  # in order behind the ghost's
        driver.until(refused(driver, "sequence", before + 1), "the ghost's hello to be taken in")
    assert [info.worker for info in driver.link.dispatch.workers()] == ["hand"]


def test_wrong_patterns_are_refused(stage: tuple[Driver, HandWorker]) -> None:
    driver, hand = stage
    pattern = DenseAnalysis(np.frombuffer(BEAM.row_start, np.int32), np.frombuffer(BEAM.columns, np.int32)).pattern
    good = pattern.message(hand.header("beam", 1))
    small = DenseAnalysis(np.frombuffer(chain(2).row_start, np.int32), np.frombuffer(chain(2).columns, np.int32))
    for wrong, kind in (
        ({"header__epoch": 9}, "epoch"),
        ({"header__object": "liver"}, "object"),
        ({"id": 5}, "checksum"),
        ({"rows": good.rows[:-4]}, "pattern"),
        ({"permutation": b"\0" * len(good.permutation)}, "pattern"),
    ):
        spoiled = FactorPattern.FromString(good.SerializeToString())
        change(spoiled, wrong)
        before = driver.link.counters.refusals[kind]
        hand.put("pattern", spoiled.SerializeToString(), worker="hand", object="beam")
        driver.until(refused(driver, kind, before + 1), str(wrong))
    before = driver.link.counters.refusals["shape"]
    hand.put("pattern", small.pattern.message(hand.header("beam", 1)).SerializeToString(), worker="hand", object="beam")
    driver.until(refused(driver, "shape", before + 1), "a pattern of another size")
    good_round(driver, hand, next(STEPS))


def test_random_bytes_on_every_channel_do_no_harm(stage: tuple[Driver, HandWorker]) -> None:
    driver, hand = stage
    noise, before = random.Random(1), driver.link.counters.refused
    for _ in range(20):
        data = noise.randbytes(noise.randrange(1, 200))
        hand.put("factor", data, data, worker="hand", object="beam")
        hand.put("pattern", data, worker="hand", object="beam")
        hand.put("worker", data, worker="hand")
    driver.until(lambda: driver.link.counters.refused >= before + 60, "60 refusals")
    good_round(driver, hand, next(STEPS))


def test_a_job_that_does_not_fit_what_was_announced_is_a_programming_error(stage: tuple[Driver, HandWorker]) -> None:
    driver, _ = stage
    for job, text in (
        (Job("nobody", 1, 1, True, matrix(BEAM)), "not announced"),
        (Job("beam", 7, 1, True, matrix(BEAM)), "not announced"),
        (Job("beam", 1, 1, True, matrix(BEAM)[1:]), "allowed: float64"),
    ):
        with pytest.raises(ValueError, match=text):
            driver.link.dispatch.submit(job)
