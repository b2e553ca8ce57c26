# SPDX-License-Identifier: MIT
"""Factors in parts, without a network: whatever comes, the values are those that were announced, or there are none."""

import itertools
import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from precond_worker.network import offered_factors
from precond_worker.network.offered_factors import OfferedFactors
from protocol.channels import PROTOCOL
from protocol.counters import Counters
from protocol.messages_pb2 import FactorPart, Header
from protocol.network.factor_parts import bytes_of, part, part_checksums
from protocol.refused import Refused
from sim_server.network import arriving_factor, factor_fetch
from sim_server.network.arriving_factor import ArrivingFactor
from sim_server.network.factor_fetch import ATTEMPTS, FactorFetch
from tests.support.in_flight import in_flight

INCARNATION, JOB = 7, 3
COUNTERS = Counters(logging.getLogger("test"))
Sent = list[tuple[str, int]]  # what comes, and as which part


def values_of(count: int, dtype: str = "float32") -> Any:
    return np.arange(1, count + 1).astype(dtype)


@given(
    st.integers(1, 40),
    st.sampled_from(["float32", "float64"]),
    st.integers(1, 50),
    st.lists(st.tuples(st.sampled_from(["right", "another", "changed", "short", "long", "empty"]), st.integers(0, 45))),
)
@settings(max_examples=100, deadline=None)
def test_any_parts_in_any_order(count: int, dtype: str, part_bytes: int, sent: Sent) -> None:
    """It is complete once each part has come right, however often, in whatever order and beside whatever else."""
    values = values_of(count, dtype)
    data = bytes_of(values)
    sums = part_checksums(data, part_bytes)
    arriving, there = ArrivingFactor(count, dtype, part_bytes, sums), set[int]()
    for what, number in [*sent, *(("right", k) for k in reversed(range(len(sums))))]:
        right = part(data, number, part_bytes)
        came = {
            "right": right, "another": part(data, (number + 1) % len(sums), part_bytes), "changed": right ^ 1,
            "short": right[:-1], "long": np.append(right, np.uint8(0)), "empty": right[:0],
        }[what]  # fmt: skip
        good = number < len(sums) and number not in there and np.array_equal(came, right)
        if good:
            arriving.take(number, came)
            there.add(number)
        else:
            with pytest.raises(Refused):
                arriving.take(number, came)
        assert arriving.missing == set(range(len(sums))) - there
    assert arriving.complete and arriving.values.dtype == dtype and np.array_equal(arriving.values, values)


def test_every_order_of_five_parts() -> None:
    values = values_of(9)
    data = bytes_of(values)
    for order in itertools.permutations(range(5)):
        arriving = ArrivingFactor(9, "float32", 8, part_checksums(data, 8))
        for number in order:
            assert not arriving.complete
            arriving.take(number, part(data, number, 8))
        assert arriving.complete and np.array_equal(arriving.values, values)


@pytest.mark.parametrize("count", [0, 4, 6, 8000])
def test_another_number_of_parts_than_the_pattern_has_is_refused(count: int) -> None:
    with pytest.raises(Refused, match=rf"Factor.parts has {count} entries; allowed: 5 of 8 bytes"):
        ArrivingFactor(9, "float32", 8, [0] * count)


def test_what_does_not_fit_is_refused_before_memory_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arriving_factor, "available_memory", lambda: 35)
    monkeypatch.setattr(arriving_factor.np, "empty", lambda *_: pytest.fail("memory was taken"))
    with pytest.raises(Refused, match="Factor of 36 bytes: only 35 bytes of memory are available") as refused:
        ArrivingFactor(9, "float32", 8, [0] * 5)
    assert refused.value.kind == "memory"


# --- asking for them ------------------------------------------------------------------------------------------------

ANSWERS = (
    "right",
    "changed",
    "another part",
    "another job",
    "another life",
    "no message",
    "error",
    "a slot of its own",
)


def answer_to(question: FactorPart, what: str, data: Any, part_bytes: int) -> Any:
    """A reply as zenoh has it."""
    number = question.number + (what == "another part")
    life = INCARNATION + (what == "another life")
    message = FactorPart(
        header=Header(protocol=PROTOCOL, incarnation=life), job=JOB + (what == "another job"), number=number
    )
    if what == "a slot of its own":  # though none was lent
        message.slot.segment = "1.zenoh"
    payload = part(data, question.number, part_bytes)
    sample = SimpleNamespace(
        payload=(payload ^ 1 if what == "changed" else payload).tobytes(),
        attachment=b"\xff" if what == "no message" else message.SerializeToString(),
    )
    return SimpleNamespace(ok=None if what == "error" else sample)


class ScriptedSession:
    """Answers each question with what the script has next for that part; then right."""

    def __init__(self, data: Any, part_bytes: int, script: dict[int, list[list[str]]]):
        self._data, self._part_bytes, self._script = data, part_bytes, script
        self.asked: list[int] = []
        self.under_way = 0

    def get(self, *_: Any, payload: bytes, **options: Any) -> Any:
        question = FactorPart.FromString(payload)
        assert question.job == JOB and not question.HasField("slot")
        self.asked.append(question.number)
        tries = self._script.get(question.number, [])
        return [
            answer_to(question, what, self._data, self._part_bytes) for what in (tries.pop(0) if tries else ["right"])
        ]


def fetch_of(session: Any, count: int, part_bytes: int, parts: list[int]) -> FactorFetch:
    job = in_flight(JOB, "beam", 1, 1, "float32", "w", 0.0, part_bytes=part_bytes)
    return FactorFetch(session, "sim", INCARNATION, COUNTERS, job, count, parts, ())


@given(
    st.integers(1, 30),
    st.dictionaries(st.integers(0, 10), st.lists(st.lists(st.sampled_from(ANSWERS), max_size=4), max_size=4)),
)
@settings(max_examples=100, deadline=None)
def test_whatever_answers_a_question(count: int, script: dict[int, list[list[str]]]) -> None:
    """A right answer among the first questions for a part is found; else the factor is given up, with a reason."""
    values = values_of(count)
    data, pause = bytes_of(values), factor_fetch.PAUSE
    factor_fetch.PAUSE = 0.0
    try:
        sums = part_checksums(data, 12)
        wanted = range(len(sums))
        # Without a lent slot one that is named is not looked at: the payload counts.
        good = {"right", "a slot of its own"}
        tries = {k: [*script.get(k, []), ["right"]] for k in wanted}
        found = {k: next(i for i, t in enumerate(tries[k]) if good & set(t)) for k in wanted}
        session = ScriptedSession(data, 12, {k: list(t) for k, t in script.items()})
        fetch = fetch_of(session, count, 12, sums)
        if all(i < ATTEMPTS for i in found.values()):
            assert np.array_equal(fetch.run(), values)
            assert len(session.asked) == sum(i + 1 for i in found.values())
            assert fetch.clean == all(i == 0 for i in found.values())
        else:
            with pytest.raises(Refused, match=rf"part \d+ of {len(sums)} of a factor did not come from worker w"):
                fetch.run()
            assert not fetch.clean and max(session.asked.count(k) for k in wanted) == ATTEMPTS
    finally:
        factor_fetch.PAUSE = pause


def test_a_few_parts_are_asked_for_ahead_and_no_more() -> None:
    data = bytes_of(values_of(30))
    session = ScriptedSession(data, 12, {0: [["changed"], ["changed"], ["changed"]]})
    with pytest.raises(Refused):
        fetch_of(session, 30, 12, part_checksums(data, 12)).run()
    assert sorted(set(session.asked)) == list(range(factor_fetch.AHEAD)), "nothing beyond what is missing"


def test_one_that_nobody_waits_for_any_more_ends_before_it_asks() -> None:
    data = bytes_of(values_of(30))
    session = ScriptedSession(data, 12, {})
    fetch = fetch_of(session, 30, 12, part_checksums(data, 12))
    fetch.gone.set()
    with pytest.raises(Refused, match="not waited for any more"):
        fetch.run()
    assert session.asked == []


def test_an_answer_that_cannot_be_read_leaves_time_for_the_right_one(monkeypatch: pytest.MonkeyPatch) -> None:
    values, take = values_of(9), ArrivingFactor.take
    data, tries = bytes_of(values), iter([True, False])

    def broken(arriving: ArrivingFactor, number: int, data: Any) -> None:
        if number == 1 and next(tries, False):
            raise TypeError("no bytes")
        take(arriving, number, data)

    monkeypatch.setattr(ArrivingFactor, "take", broken)
    monkeypatch.setattr(factor_fetch, "PAUSE", 0.0)
    before = COUNTERS.refusals["unexpected"]
    session = ScriptedSession(data, 12, {})
    assert np.array_equal(fetch_of(session, 9, 12, part_checksums(data, 12)).run(), values)
    assert sorted(session.asked) == [0, 1, 1, 2]
    assert COUNTERS.refusals["unexpected"] == before + 1


# --- answering ------------------------------------------------------------------------------------------------------


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def offered(clock: Clock) -> OfferedFactors:
    queries = SimpleNamespace(declare_queryable=lambda *_: SimpleNamespace(undeclare=lambda: None))
    session: Any = SimpleNamespace(zenoh=queries, thread=lambda *_: None)
    return OfferedFactors(session, "sim", "w", COUNTERS, clock)


def ask(offered: OfferedFactors, number: int, job: int = JOB, incarnation: int = INCARNATION) -> tuple[Any, bytes]:
    header = Header(protocol=PROTOCOL, incarnation=incarnation)
    return offered.part(FactorPart(header=header, job=job, number=number))


def test_a_worker_answers_with_the_parts_that_it_announced(offered: OfferedFactors) -> None:
    values = values_of(9)
    sums = offered.offer("beam", Header(incarnation=INCARNATION), JOB, values, 8)
    answers = [ask(offered, k) for k in range(len(sums))]
    assert b"".join(payload for _, payload in answers) == values.tobytes()
    assert [(answer.job, answer.number) for answer, _ in answers] == [(JOB, k) for k in range(5)]


@pytest.mark.parametrize(
    ("question", "kind"),
    [((5,), "shape"), ((2**32 - 1,), "shape"), ((0, JOB + 1), "late"), ((0, JOB, INCARNATION + 1), "late")],
)
def test_questions_for_anything_else_are_refused(
    offered: OfferedFactors, question: tuple[int, ...], kind: str
) -> None:  # fmt: skip
    offered.offer("beam", Header(incarnation=INCARNATION), JOB, values_of(9), 8)
    with pytest.raises(Refused) as refused:
        ask(offered, *question)
    assert refused.value.kind == kind


def test_a_factor_is_kept_until_its_object_has_another_or_nobody_asks(offered: OfferedFactors, clock: Clock) -> None:
    header = Header(incarnation=INCARNATION)
    offered.offer("beam", header, 1, values_of(9), 8)
    offered.offer("block", header, 2, values_of(9), 8)
    offered.offer("beam", header, 3, values_of(9), 8)
    assert offered.kept == 2, "the newer one of the beam"
    with pytest.raises(Refused, match="job is 1, of which no factor is kept any more"):
        ask(offered, 0, 1)
    clock.now = 0.9 * offered_factors.KEPT
    ask(offered, 0, 3)
    clock.now = 1.1 * offered_factors.KEPT
    offered.expire()
    assert offered.kept == 1 and ask(offered, 0, 3)
    offered.withdraw(["beam"])
    offered.withdraw(["beam"])
    assert offered.kept == 0
