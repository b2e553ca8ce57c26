# SPDX-License-Identifier: MIT
"""Factors in parts between real processes: every factor counts as large here, and parts are of 64 bytes."""

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pytest
import zenoh
from hand_worker import HandWorker
from link_helpers import Driver, chain, dense, light_worker, matrix, product

from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import Factor, FactorPart, Header, Matrix
from protocol.network.factor_parts import bytes_of, part, part_checksums
from protocol.network.session import open_session
from protocol.shared_memory import limits as shm_limits
from sim_server.network import factor_fetch, job_sender
from sim_server.network.factor_fetch import FactorFetch
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint

pytestmark = pytest.mark.system
shared = pytest.mark.skipif(bool(shm_limits.obstacle()), reason=f"no shared memory here: {shm_limits.obstacle()}")
ways = pytest.mark.parametrize("way", [pytest.param("shm", marks=shared), "no-shm"])

BEAM, BLOCK = chain(), chain(object="block")
PART = 64  # bytes


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_sender, "PART_BYTES", PART)
    monkeypatch.setattr(job_sender, "SLOT_SHARE", 1 << 40)  # no slot is lent for a whole factor


class Gate:
    """Holds fetches before they take a part, after so many of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, object: str, after: int):
        self.reached, self.open, self.left = threading.Event(), threading.Event(), after
        took = FactorFetch.took

        def held(fetch: FactorFetch, number: int, *rest: Any) -> bool:
            if fetch.job.object == object and not self.open.is_set():
                if self.left == 0:
                    self.reached.set()
                    assert self.open.wait(60)
                self.left -= 1
            return took(fetch, number, *rest)

        monkeypatch.setattr(FactorFetch, "took", held)


class UnderWay(NamedTuple):
    """A factor of the beam on its way from a worker; no part comes until the gate is opened."""

    gate: Gate
    endpoint: str
    link: ServerLink
    driver: Driver
    worker: subprocess.Popen[str]


@contextmanager
def under_way(
    monkeypatch: pytest.MonkeyPatch, parts: int, *way: str, silence: float = 2.0
) -> Iterator[UnderWay]:  # fmt: skip
    """The first `parts` parts have come."""
    gate, endpoint = Gate(monkeypatch, "beam", parts), free_endpoint()
    with ServerLink(listen=[endpoint], silence=silence) as link, light_worker(endpoint, "light", *way) as worker:
        driver = Driver(link)
        link.announce(BEAM)
        driver.submit(BEAM, 1)
        driver.until(gate.reached.is_set, f"{parts} parts")
        yield UnderWay(gate, endpoint, link, driver, worker)


def is_right(factor: Any, shift: float = 0.0) -> bool:
    return np.allclose(product(factor), dense(BEAM, matrix(BEAM, shift)), atol=1e-5)


@ways
def test_ordinary_factors_travel_in_many_parts(way: str) -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint, "light", way):
        driver = Driver(link)
        link.announce(BEAM)
        for step in range(1, 6):
            dtype = "float32" if step % 2 else "float64"
            factor = driver.factor(BEAM, step, 0.1 * step, dtype)
            assert is_right(factor, 0.1 * step) and factor.values.dtype == dtype
            assert factor.values.nbytes > 4 * PART
        assert link.counters.refused == 0 and driver.failures == []
        in_memory = link.counters.bulk_shared if way == "shm" else link.counters.bulk_copied
        assert in_memory == 10, "five matrices and five factors, the first one, too"
        assert link.slots_lent == 0


def test_what_is_not_large_travels_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """No question is asked for a factor of at most four parts, and none of a worker that sends it whole."""
    monkeypatch.setattr(job_sender, "PART_BYTES", 300)  # of 1200
    monkeypatch.setattr(FactorFetch, "__init__", lambda *_: pytest.fail("a part was asked for"))
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint, "light", "no-shm"):
        link.announce(BEAM)
        assert is_right(Driver(link).factor(BEAM, 1))


@ways
def test_the_worker_is_killed_in_the_middle(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    with under_way(monkeypatch, 3, way) as (gate, endpoint, link, driver, worker):
        os.kill(worker.pid, signal.SIGKILL)
        driver.until(lambda: driver.failures, "the loss")
        assert driver.failures[0] == ("beam", "factorization of beam at step 1 was lost with worker light")
        gate.open.set()
        driver.until(lambda: not link.dispatch.decoding, "the end of the fetch")
        assert driver.factors == [] and link.slots_lent == 0
        with light_worker(endpoint, "second", way):
            assert is_right(driver.factor(BEAM, 2))


@ways
def test_a_worker_that_stops_is_given_up_and_answers_again_later(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    """Slots that it may still write to are not lent again."""
    monkeypatch.setattr(factor_fetch, "QUESTION_TIME", 0.3)
    with under_way(monkeypatch, 3, way, silence=60) as (gate, _, link, driver, worker):
        os.kill(worker.pid, signal.SIGSTOP)
        gate.open.set()
        driver.until(lambda: driver.failures, "the end of patience")
        os.kill(worker.pid, signal.SIGCONT)
        assert "did not come from worker light" in driver.failures[0][1] or "lost" in driver.failures[0][1]
        assert is_right(driver.factor(BEAM, 2, 0.5), 0.5)
        driver.until(lambda: not link.dispatch.decoding, "the end of the fetch")
        assert link.slots_lent == 0


def test_a_large_factor_holds_up_no_other_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the parts of one are under way its worker has the job of another, whose factor overtakes it."""
    with under_way(monkeypatch, 2) as (gate, _, link, driver, _):
        link.announce(BLOCK)
        assert driver.factor(BLOCK, 7).object == "block"
        assert [factor.object for factor in driver.factors] == ["block"]
        gate.open.set()
        driver.until(lambda: len(driver.factors) == 2, "the other one")
        assert is_right(driver.factors[1]) and driver.failures == []


def test_a_split_drops_what_is_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    split = chain(nodes=9, epoch=2)
    with under_way(monkeypatch, 2) as (gate, _, link, driver, _):
        link.announce(split)
        gate.open.set()
        factor = driver.factor(split, 2)
        assert (factor.epoch, factor.pattern.size) == (2, 27) and len(driver.factors) == 1
        assert len(driver.failures) == 1 and "of a mesh that was split since" in driver.failures[0][1]
        driver.until(lambda: link.slots_lent == 0, "the slots")


# --- others answer --------------------------------------------------------------------------------------------------


def garbage(question: FactorPart) -> tuple[bytes, bytes]:
    return os.urandom(PART), os.urandom(20)


def forged_part(question: FactorPart) -> tuple[bytes, bytes]:
    return bytes(PART), question.SerializeToString()


def huge_part(question: FactorPart) -> tuple[bytes, bytes]:
    return bytes(32 << 20), question.SerializeToString()


def in_a_slot(question: FactorPart) -> tuple[bytes, bytes]:
    question.slot.segment, question.slot.capacity = "1.zenoh", 1 << 30
    return b"", question.SerializeToString()


FORGERIES = (garbage, forged_part, huge_part, in_a_slot)


@ways
def test_forged_parts_change_nothing(way: str) -> None:
    """Somebody else answers each question, too: the part that was announced is the one that is taken."""
    endpoint, asked = free_endpoint(), set[str]()
    with (
        ServerLink(listen=[endpoint]) as link,
        open_session("client", connect=[endpoint], shared_memory=False) as forger,
        light_worker(endpoint, "light", way),
    ):
        driver = Driver(link)
        link.announce(BEAM)
        for step, forge in enumerate(FORGERIES):

            def answer(query: zenoh.Query, forge: Any = forge) -> None:
                asked.add(forge.__name__)
                payload, attachment = forge(FactorPart.FromString(bytes(query.payload)))
                query.reply(query.key_expr, payload, attachment=attachment)
                query.drop()

            forging = forger.zenoh.declare_queryable(key("part"), answer)
            assert is_right(driver.factor(BEAM, step, 0.1 * step), 0.1 * step)
            driver.until(lambda forge=forge: forge.__name__ in asked, "the forger")  # type: ignore[misc]
            forging.undeclare()
        assert driver.failures == []


class PartsByHand(HandWorker):
    """Answers the question for a part with what `reply` makes of it; None: not at all."""

    def serve(self, reply: Callable[[FactorPart], tuple[bytes, bytes] | None]) -> None:
        def answer(query: zenoh.Query) -> None:
            made = reply(FactorPart.FromString(bytes(query.payload)))
            if made is not None:
                query.reply(query.key_expr, made[0], attachment=made[1])
            query.drop()

        self.session.zenoh.declare_queryable(key("part", worker=self.name), answer)

    def announcement(self, job: Matrix) -> tuple[Factor, np.ndarray]:
        answer, values = self.right_answer(job, BEAM)
        answer.checksum = 0
        answer.parts.extend(part_checksums(bytes_of(values), job.part_bytes))
        return answer, values


@contextmanager
def announced(endpoint: str) -> Iterator[tuple[PartsByHand, Driver, Factor, np.ndarray]]:
    """A worker by hand that has a job; its announcement of the factor, which is not sent yet, and the values."""
    with ServerLink(listen=[endpoint], silence=60) as link, PartsByHand(endpoint, link.incarnation) as hand:
        driver = Driver(link)
        link.announce(BEAM)
        hand.hello()
        driver.submit(BEAM, 1)
        yield hand, driver, *hand.announcement(hand.receive())


def message(question: FactorPart, **changes: int) -> bytes:
    header = Header(protocol=PROTOCOL, incarnation=question.header.incarnation + changes.pop("life", 0))
    fields = {"job": question.job, "number": question.number, **changes}
    return FactorPart(header=header, **fields).SerializeToString()


@pytest.mark.parametrize(
    ("what", "told"),
    [
        ("nothing at all", "part 0 of 19 of a factor did not come"),
        ("only the first three", "part 3 of 19 of a factor did not come"),
        ("of another factor", "part 2 of 19 of a factor did not come"),
        ("of another life", "part 0 of 19 of a factor did not come"),
        ("too few announced", "Factor.parts has 18 entries; allowed: 19 of 64 bytes"),
        ("too many announced", "Factor.parts has 8000 entries; allowed: 19 of 64 bytes"),
        ("NaN", "hold NaN"),
    ],
)
def test_what_never_completes_is_dropped_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, what: str, told: str
) -> None:  # fmt: skip
    monkeypatch.setattr(factor_fetch, "PAUSE", 0.0)
    with announced(free_endpoint()) as (hand, driver, answer, values):
        data, link = bytes_of(values), driver.link
        if what == "NaN":
            values[5] = np.nan
            answer.parts[:] = part_checksums(data, PART)
        if what.startswith("too few"):
            del answer.parts[-1]
        if what.startswith("too many"):
            answer.parts.extend([0] * (8000 - len(answer.parts)))

        def reply(question: FactorPart) -> tuple[bytes, bytes] | None:
            if what == "nothing at all" or (what.startswith("only") and question.number >= 3):
                return None
            life, other = int(what == "of another life"), what == "of another factor" and question.number == 2
            return part(data, question.number, PART).tobytes(), message(question, life=life, job=question.job + other)

        hand.serve(reply)
        hand.answer(answer)
        driver.until(lambda: driver.failures, "the refusal")
        assert "was refused" in driver.failures[0][1] and told in driver.failures[0][1]
        assert driver.factors == [] and not link.dispatch.decoding and link.slots_lent == 0
        driver.submit(BEAM, 2)
        answer, values = hand.right_answer(hand.receive(), BEAM)
        hand.answer(answer, values)  # whole, as an older worker does
        driver.until(lambda: driver.factors, "the next one")
        assert is_right(driver.factors[0])


def test_a_second_announcement_is_refused_while_the_first_is_fetched(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate(monkeypatch, "beam", after=1)
    with announced(free_endpoint()) as (hand, driver, answer, values):
        data = bytes_of(values)
        hand.serve(lambda question: (part(data, question.number, PART).tobytes(), message(question)))
        hand.answer(answer)
        driver.until(gate.reached.is_set, "a part")
        forged = Factor.FromString(answer.SerializeToString())
        forged.parts[:] = [1] * len(forged.parts)
        hand.answer(forged)
        driver.until(lambda: driver.link.counters.refusals["duplicate"] == 1, "the refusal of the second")
        gate.open.set()
        driver.until(lambda: driver.factors, "the factor")
        assert is_right(driver.factors[0]) and driver.failures == []


def test_who_announces_and_sends_nothing_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another worker has the job once no part has come for a while, and the questions that wait end at once."""
    monkeypatch.setattr(factor_fetch, "STALL", 0.2)
    monkeypatch.setattr(factor_fetch, "QUESTION_TIME", 1000.0)
    held: list[Any] = []  # questions that are never answered
    endpoint = free_endpoint()
    with announced(endpoint) as (hand, driver, answer, _):
        link = driver.link
        hand.session.zenoh.declare_queryable(key("part", worker="hand"), held.append)
        hand.answer(answer)
        driver.until(lambda: held, "a question")
        with light_worker(endpoint):
            driver.until(lambda: len(link.dispatch.workers()) == 2, "the other worker")
            driver.until(lambda: link.dispatch.reassigned() == ["beam"], "the job to be free")
            driver.until(lambda: not link.dispatch.decoding, "the end of the fetch")
            assert link.dispatch.reliability.failing_objects == {"beam"}, "it is held against who sent nothing"
            hand.close()
            assert is_right(driver.factor(BEAM, 2)) and driver.factors[0].worker == "light"
