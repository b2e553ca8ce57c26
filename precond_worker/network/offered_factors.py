# SPDX-License-Identifier: MIT
"""Large factors that the server asks for in parts. Each is kept until its object has another job."""

import logging
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from queue import Full, Queue
from typing import Any, NamedTuple

import zenoh
from numpy.typing import NDArray

from protocol.channels import CHANNELS, PROTOCOL, key
from protocol.counters import Counters
from protocol.messages_pb2 import FactorPart, Header
from protocol.network.factor_parts import Bytes, bytes_of, part, part_checksums, part_count
from protocol.network.session import Session
from protocol.refused import Refused
from protocol.shared_memory.view import SlotMap
from protocol.validate import check_header, parse

log = logging.getLogger(__name__)

QUESTIONS = 64  # that may wait; beyond that a new one is dropped, and asked again
KEPT = 60.0  # s after the last question; the server asks twice as often at least, or has given the factor up


class OfferedFactor(NamedTuple):
    """incarnation: of the server that asks. job: header.sequence of the matrix it was made from"""

    incarnation: int
    job: int
    data: Bytes
    part_bytes: int


class OfferedFactors:
    """Answers questions for parts, in a thread of its own, so that the worker goes on with its next job meanwhile.

    The answers have the priority of the question, a low one: small factors and heartbeats overtake
    parts.
    """

    def __init__(
        self, session: Session, server: str, worker: str, counters: Counters,
        clock: Callable[[], float] = time.monotonic,
    ):  # fmt: skip
        self._counters, self._clock = counters, clock
        self._key = key("part", server, worker=worker)
        self._slots = SlotMap()
        self._lock = threading.Lock()
        self._offered: dict[str, OfferedFactor] = {}  # by object
        self._asked: dict[str, float] = {}  # when it was offered, or a part was asked for last [s, monotonic]
        # A queue of our own: zenoh's cannot be undeclared while a thread waits for it.
        self._questions: Queue[zenoh.Query | None] = Queue(QUESTIONS)
        ended = partial(self._questions.put, None)
        self._queryable = session.zenoh.declare_queryable(self._key, zenoh.handlers.Callback(self._receive, ended))
        session.thread("parts of factors", self._run)

    def offer(self, object: str, header: Header, job: int, values: NDArray[Any], part_bytes: int) -> list[int]:
        """Keeps the values of a factor, which must not change any more; returns the checksum of each part."""
        data = bytes_of(values)
        with self._lock:
            self._offered[object] = OfferedFactor(header.incarnation, job, data, part_bytes)
            self._asked[object] = self._clock()
        return part_checksums(data, part_bytes)

    def withdraw(self, objects: Iterable[str]) -> None:
        """Drops the factors of objects, if there are any: they have been fetched, or nobody waits for them."""
        with self._lock:
            if self._offered:
                for object in objects:
                    self._offered.pop(object, None)

    def clear(self) -> None:
        """Drops all factors, when their server is gone."""
        with self._lock:
            self._offered.clear()
            self._slots.clear()

    def expire(self) -> None:
        """Drops the factors that nobody has asked for in a while."""
        end = self._clock() - KEPT
        with self._lock:
            for object in [object for object in self._offered if self._asked[object] < end]:
                del self._offered[object]

    @property
    def kept(self) -> int:
        """Number of factors that are kept. A probe for tests."""
        with self._lock:
            return len(self._offered)

    def close(self) -> None:
        """Answers no more questions."""
        self.clear()
        self._queryable.undeclare()

    def _receive(self, query: zenoh.Query) -> None:
        try:
            self._questions.put_nowait(query)
        except Full:
            query.drop()

    def _run(self) -> None:
        """Ends when the session is closed, or this."""
        for query in iter(self._questions.get, None):
            try:
                self._answer(query)
            except Refused as refusal:
                self._counters.refuse(refusal)
            except zenoh.ZError as error:
                log.debug("a part of a factor was not sent: %s", error)
            except Exception:
                log.exception("a part of a factor was not sent")
            finally:
                query.drop()

    def _answer(self, query: zenoh.Query) -> None:
        question = parse(FactorPart, query.payload, CHANNELS["part"].limit)
        check_header(question)
        with self._lock:
            answer, payload = self.part(question)
        query.reply(self._key, payload, attachment=answer.SerializeToString())

    def part(self, question: FactorPart) -> tuple[FactorPart, bytes]:
        """Returns the answer to a question, and the part unless it was written into a slot."""
        wanted = question.header.incarnation, question.job
        found = next((name for name, each in self._offered.items() if (each.incarnation, each.job) == wanted), None)
        if found is None:
            raise Refused(f"FactorPart.job is {question.job}, of which no factor is kept any more", "late")
        offered = self._offered[found]
        count = part_count(len(offered.data), offered.part_bytes)
        if question.number >= count:
            raise Refused(f"FactorPart.number is {question.number}; allowed: less than {count}", "shape")
        self._asked[found] = self._clock()
        data = part(offered.data, question.number, offered.part_bytes)
        header = Header(protocol=PROTOCOL, incarnation=offered.incarnation)
        answer = FactorPart(header=header, job=question.job, number=question.number)
        if not question.HasField("slot"):
            return answer, data.tobytes()
        target = self._slots.array(question.slot, data.dtype, len(data))
        if not self._slots.is_current(question.slot):
            raise Refused("the slot for a part was lent to somebody else: this answer is late", "late")
        target[:] = data
        answer.slot.CopyFrom(question.slot)
        return answer, b""
