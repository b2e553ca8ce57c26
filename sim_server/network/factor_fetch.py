# SPDX-License-Identifier: MIT
"""Fetches large factors from workers part by part, beside everything else.

The server asks for each part, a few at a time, so that what is under way is bounded whatever a worker or a forger
sends; between two parts the network is free for others. A part goes through a small slot of shared memory that is lent
for it, or travels as bytes.
"""

import threading
import time
from collections.abc import Sequence

import numpy as np
import zenoh
from zenoh.handlers import FifoChannel

from protocol.channels import CHANNELS, PROTOCOL, key
from protocol.counters import Counters
from protocol.messages_pb2 import FactorPart, Header
from protocol.refused import Refused
from protocol.shared_memory.pool import Slot
from protocol.validate import check_header, parse, take
from sim_server.arrays import Float32, Float64
from sim_server.network.arriving_factor import ArrivingFactor
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.network.lease_terms import MIN_BANDWIDTH

AHEAD = 2  # parts asked for at a time: one is copied while the next is under way
ANSWERS = 4  # to a question that wait to be read; forged ones stand in the way of nobody else
QUESTION_TIME = 10.0  # s for the answer to a question
STALL = 5.0  # s without a part, after which another worker may have the job
ATTEMPTS = 3  # questions for one part
PAUSE = 0.2  # s between two of them
ALL, NONE = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE  # the key of a worker may have a forger, too


class FactorFetch:
    """One factor on its way. `run` is for a thread of its own.

    job: answered by the worker that keeps the factor; parts: checksum of each
    slots: AHEAD of them for a worker on this host; none: parts travel as bytes
    gone: set once nobody waits for the factor any more
    """

    def __init__(
        self, session: zenoh.Session, server: str, incarnation: int, counters: Counters, job: InFlightJob,
        nonzeros: int, parts: Sequence[int], slots: Sequence[Slot],
    ):  # fmt: skip
        self._session, self._incarnation, self._counters, self.job = session, incarnation, counters, job
        self._key = key("part", server, worker=job.worker)
        self._nonzeros, self.parts = nonzeros, list(parts)
        self.slots = slots
        self.gone = threading.Event()
        self.clean = False  # all questions were answered: the worker writes to no slot any more
        self._repeated = False
        self._cancelling = zenoh.CancellationToken()
        self._came = time.monotonic()  # when it was announced, or a part came last

    def give_up(self) -> None:
        """Ends `run` soon: nobody waits for the factor any more. For other threads; does not wait for it."""
        if not self.gone.is_set():
            self.gone.set()
            self._cancelling.cancel()

    @property
    def stalls(self) -> bool:
        """True if no part has come for a while."""
        return time.monotonic() > self._came + STALL

    def run(self) -> Float32 | Float64:
        """Returns the values; raises Refused."""
        if self.gone.is_set():  # while it waited for its turn
            raise Refused("a factor is not waited for any more", "late")
        arriving = ArrivingFactor(self._nonzeros, self.job.dtype, self.job.part_bytes, self.parts)
        count = len(self.parts)
        end = time.monotonic() + ATTEMPTS * QUESTION_TIME + arriving.values.nbytes / MIN_BANDWIDTH
        asked = {number: self._ask(number) for number in range(min(AHEAD, count))}
        for number in range(count):
            self._await(number, asked.pop(number), arriving)
            if time.monotonic() > end:
                raise Refused(f"{len(arriving.missing)} of {count} parts of a factor are not there in time", "late")
            if number + AHEAD < count:
                asked[number + AHEAD] = self._ask(number + AHEAD)
        self.clean = not self._repeated
        return arriving.values

    def _await(self, number: int, answers: zenoh.handlers.Handler[zenoh.Reply], arriving: ArrivingFactor) -> None:
        """Takes in a part; asks again for one that does not come."""
        for attempt in range(ATTEMPTS):
            if attempt:
                self._repeated = True
                answers = self._ask(number)
            for reply in answers:
                if self.gone.is_set():
                    break
                if reply.ok is not None and self.took(number, reply.ok, arriving):
                    return
            if self.gone.wait(PAUSE):
                raise Refused("a factor is not waited for any more", "late")
        count = len(self.parts)
        raise Refused(f"part {number} of {count} of a factor did not come from worker {self.job.worker}", "late")

    def took(self, number: int, sample: zenoh.Sample, arriving: ArrivingFactor) -> bool:
        """Takes the answer to a question, if it is one: anybody may answer."""
        try:
            answer = parse(FactorPart, sample.attachment, CHANNELS["part"].limit)
            check_header(answer, incarnation=self._incarnation)
            if (answer.job, answer.number) != (self.job.number, number):
                raise Refused(
                    f"FactorPart is {answer.number} of job {answer.job}; allowed: {number} of {self.job.number}",
                    "sequence",
                )
            size = arriving.bytes_of_part(number)
            if answer.HasField("slot") and self.slots:
                arriving.take(number, self._slot(number).array(np.uint8, size))
            else:
                arriving.take(number, np.frombuffer(take(sample.payload, size, "part of a factor"), np.uint8))
        except Refused as refusal:
            self._counters.refuse(refusal)
            return False
        except Exception as error:  # anybody may answer: the right answer may still come
            self._counters.refuse(self._counters.unexpected(error, f"a part of a factor of {self.job.object}"))
            return False
        self._came = time.monotonic()
        return True

    def _slot(self, number: int) -> Slot:
        return self.slots[number % AHEAD]

    def _ask(self, number: int) -> zenoh.handlers.Handler[zenoh.Reply]:
        header = Header(protocol=PROTOCOL, incarnation=self._incarnation)
        question = FactorPart(header=header, job=self.job.number, number=number)
        if self.slots:
            question.slot.CopyFrom(self._slot(number).message())
        try:
            return self._session.get(
                self._key, FifoChannel(ANSWERS), payload=question.SerializeToString(), timeout=QUESTION_TIME,
                target=ALL, consolidation=NONE, priority=zenoh.Priority.DATA_LOW,
                congestion_control=zenoh.CongestionControl.BLOCK, cancellation_token=self._cancelling,
            )  # fmt: skip
        except zenoh.ZError as error:
            raise Refused(f"a part of a factor was not asked for: {error}", "late") from error
