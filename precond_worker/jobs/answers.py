# SPDX-License-Identifier: MIT
"""How factors, and failures, leave for the server: with others of their message, or alone."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from precond_worker.jobs.batch import Batch, BatchAnswer
from precond_worker.jobs.job import Job
from precond_worker.network.server_connection import ServerConnection
from protocol.channels import WHOLE_PARTS
from protocol.factor import FactorPattern
from protocol.messages_pb2 import Factor, Matrix
from protocol.refused import Refused
from protocol.validate import checksum, copied

LONGEST = 500  # characters of a failure


class Answers:
    """Answers to the jobs of one server. Those to jobs of one message are kept until `send`."""

    def __init__(self, connection: ServerConnection):
        self._connection, self._counters = connection, connection.counters
        self._kept: dict[int, BatchAnswer] = {}  # by id of the batch; sent before a batch is forgotten

    def send_pattern(self, job: Job, pattern: FactorPattern) -> None:
        """Sends the pattern of L if the server does not know it."""
        if pattern.id not in job.known_patterns:
            self._connection.send_pattern(pattern, job.object, job.epoch)

    def add_all(
        self, jobs: Sequence[Job], pattern: FactorPattern, values: NDArray[Any], rows: Sequence[int], seconds: float
    ) -> None:  # fmt: skip
        """Answers jobs of one message, or one that came alone, with factors that were made together. Raises Refused if
        the answer is late.

        rows: of their factors in `values`, (k, nonzeros)
        """
        for job in jobs:
            self.send_pattern(job, pattern)
        batch, alone = jobs[0].batch, [job.place for job in jobs]
        if batch is not None:
            alone = self._to(batch).add(alone, self._connection.slots, pattern, values, rows, seconds)
            self._counters.add("factors", len(jobs) - len(alone))
        if alone:
            for job, row in zip(jobs, rows, strict=True):
                if job.place in alone:
                    self._send_alone(job, pattern, values[row], seconds)

    def add(
        self, job: Job, pattern: FactorPattern, values: NDArray[Any] | None, seconds: float, remedy: str = ""
    ) -> None:  # fmt: skip
        """Answers a job with its factor, with others of its message where the factor fits into its room there. Raises
        Refused if the answer is late.

        values: (nonzeros,); None: they lie in the slot on the device already
        """
        if job.batch is not None and values is not None:
            answer = self._to(job.batch)
            if not answer.add([job.place], self._connection.slots, pattern, values[None], [0], seconds, remedy):
                self._counters.add("factors")
                return
        self._send_alone(job, pattern, values, seconds, remedy)

    def add_failure(self, job: Job, failure: str) -> None:
        """Answers a job with the reason why it has no factor."""
        if job.batch is not None:
            self._to(job.batch).add_failure(job.place, failure[:LONGEST])
        else:
            answer = self._answer(job, 0.0, "")
            answer.failure = failure[:LONGEST]
            self._connection.send_factor(answer, b"")

    def send(self) -> None:
        """Sends the answers that are kept."""
        kept, self._kept = self._kept, {}
        for answer in kept.values():
            if not answer.message.jobs:
                continue
            try:
                self._connection.send_factors(answer.finished())
            except zenoh.ZError as error:
                self._counters.trouble("unsent", f"factors were not sent: {error}")

    def _to(self, batch: Batch) -> BatchAnswer:
        """Returns the answers to jobs of a message that leave together."""
        if id(batch) not in self._kept:
            connection = self._connection
            self._kept[id(batch)] = BatchAnswer(batch, connection.header("", 0, "factors"), connection.name)
        return self._kept[id(batch)]

    def _answer(self, job: Job, seconds: float, remedy: str) -> Factor:
        """Returns an answer without a factor."""
        message, connection = job.message, self._connection
        return Factor(
            header=connection.header(job.object, job.epoch, "factor"),
            step=message.step,
            warp=message.warp,
            dtype=message.factor_dtype,
            worker=connection.name,
            seconds=seconds,
            remedy=remedy,
            job=job.number,
            matrix_shared=job.shared,
        )

    def _send_alone(
        self, job: Job, pattern: FactorPattern, values: NDArray[Any] | None, seconds: float, remedy: str = ""
    ) -> None:  # fmt: skip
        answer, payload = self._answer(job, seconds, remedy), b""
        answer.pattern, answer.nonzeros = pattern.id, pattern.nonzeros
        if values is None:
            answer.device_slot.CopyFrom(job.message.device_factor)
        else:
            payload = self._put(job.message, answer, job.object, np.ascontiguousarray(values))
        self._connection.send_factor(answer, payload)
        self._counters.add("factors")

    def _put(self, message: Matrix, answer: Factor, object: str, values: NDArray[Any]) -> bytes:
        """Puts values where the server gets them from, and says so in the answer; returns what travels beside it."""
        if self._put_into_slot(message, answer, values):
            return b""
        if 0 < WHOLE_PARTS * message.part_bytes < values.nbytes:
            number, size = message.header.sequence, message.part_bytes
            answer.parts.extend(self._connection.offered.offer(object, answer.header, number, values, size))
            return b""
        answer.checksum = checksum(values)
        return values.tobytes()

    def _put_into_slot(self, message: Matrix, answer: Factor, values: NDArray[Any]) -> bool:
        """Writes the values into the slot lent for them, and their checksum into the answer; returns False if there is
        no slot that is large enough. Raises Refused if the slot is lent to somebody else."""
        if not message.HasField("factor_slot") or message.factor_slot.capacity < values.nbytes:
            return False
        slot = message.factor_slot
        target = self._connection.slots.array(slot, values.dtype, values.size)
        if not self._connection.slots.is_current(slot):
            raise Refused("the slot for the factor was lent to somebody else: this answer is late", "late")
        answer.checksum, _ = copied(values, target, own=values)
        answer.slot.CopyFrom(slot)
        return True
