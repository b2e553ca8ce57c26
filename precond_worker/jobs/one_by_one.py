# SPDX-License-Identifier: MIT
"""Jobs that are done one by one: each is answered with its factor, or with the reason why there is none."""

import logging
import time
from collections.abc import Callable, Sequence

import numpy as np
import zenoh

from precond_worker.arrays import Float64
from precond_worker.errors import DeviceUnusable
from precond_worker.factorization.registry import DeviceFactorization, Factorization
from precond_worker.jobs.analyses import Analyses
from precond_worker.jobs.answers import Answers
from precond_worker.jobs.job import Job
from precond_worker.network.server_connection import ServerConnection
from precond_worker.remote_assembly import Assemblers
from protocol.method import COMPLETE
from protocol.process.exhausted import exhausted
from protocol.refused import Refused

log = logging.getLogger(__name__)


def count_taken(connection: ServerConnection, jobs: Sequence[Job]) -> None:
    """Counts jobs of one message, whose values came alike."""
    first, counters = jobs[0], connection.counters
    connection.offered.withdraw([job.object for job in jobs])  # the server has the last ones, or has given them up
    counters.add("jobs", len(jobs))
    counters.add("bulk_shared" if first.shared else "bulk_copied", len(jobs))
    if (first.batch is not None or first.message.HasField("matrix_slot")) and not first.shared:
        counters.warn("copied", "a matrix came as a copy although shared memory was tried and found to work")


class OneByOne:
    """Factorizes one matrix and answers. on_factorization: told the seconds of each"""

    def __init__(
        self, connection: ServerConnection, analyses: Analyses, answers: Answers,
        on_factorization: Callable[[float], None],
    ):  # fmt: skip
        self._connection, self._counters = connection, connection.counters
        self._analyses, self._answers, self._on_factorization = analyses, answers, on_factorization
        self.assemblers = Assemblers(connection)

    def do(self, job: Job) -> None:
        """Does a job. Raises DeviceUnusable, and what shows that the process lacks something for good."""
        count_taken(self._connection, [job])
        try:
            self._factorize(job)
        except Refused as refusal:
            self._counters.refuse(refusal)
            self._answers.add_failure(job, str(refusal))
        except (ValueError, MemoryError) as error:
            self._fail(job, str(error) or type(error).__name__)
        except DeviceUnusable as error:  # for good: the process ends, and its supervisor may start another
            self._answers.add_failure(job, str(error))
            raise
        except zenoh.ZError as error:
            self._counters.trouble("unsent", f"a factor was not sent: {error}")
        except Exception as error:
            if why := exhausted(error):  # a library loaded in part stays so; another process may succeed
                self._answers.add_failure(job, why)
                raise
            log.exception("factorization of %s failed", job.object)
            self._fail(job, f"{type(error).__name__}: {error}")

    def _fail(self, job: Job, why: str) -> None:
        self._counters.add("failures")
        self._answers.add_failure(job, why)

    def _factorize(self, job: Job) -> None:
        analysis = self._analyses.of_job(job)
        values = self._on_device(job, analysis) if job.on_device else job.values(self._connection.slots)
        if values is None:
            return
        assembler = self.assemblers.of(job.object, job.epoch) if job.positions else None
        complete = job.method.name == COMPLETE  # its pattern is known beforehand
        if complete:  # so that the server can prepare for it meanwhile
            self._answers.send_pattern(job, analysis.pattern)
        begin = time.perf_counter()
        if assembler is not None:
            values = assembler.matrix(values)
        # In memory of this process, so that the checksum is of what was computed, whatever happens to the slot.
        factor = np.ascontiguousarray(analysis.factorize(values, np.dtype(job.dtype)))
        seconds = time.perf_counter() - begin
        self._on_factorization(seconds)
        if not complete:
            self._answers.send_pattern(job, analysis.pattern)
        self._answers.add(job, analysis.pattern, factor, seconds, analysis.remedy)

    def _on_device(self, job: Job, analysis: Factorization) -> Float64 | None:
        """Does a job whose matrix lies on a device; returns the matrix if that must be done on the host. Where
        it raises Refused, matrices travel through the host from then on, unless the answer is merely late."""
        try:
            return self._factorize_on_device(job, analysis)
        except Refused as refusal:
            if refusal.kind != "late":  # the next one would fare no better
                self._connection.leave_device(str(refusal))
            raise

    def _factorize_on_device(self, job: Job, analysis: Factorization) -> Float64 | None:
        """Factorizes a matrix in device memory of the server, where L is written, too, and answers. Returns the matrix
        if that must be done on the host: it may need a remedy. Raises Refused."""
        message, device = job.message, self._connection.device
        dtype, size = np.dtype(message.factor_dtype), 72 * message.blocks
        if device is None:
            raise Refused("Matrix.device_matrix is set, but this worker opens no device memory", "slot")
        matrix = device.address(message.device_matrix, size)
        room = message.device_factor.capacity
        target = device.address(message.device_factor, min(room, analysis.pattern.nonzeros * dtype.itemsize))
        self._answers.send_pattern(job, analysis.pattern)
        begin, copy = time.perf_counter(), None
        if analysis.pattern.nonzeros * dtype.itemsize <= room and isinstance(analysis, DeviceFactorization):
            copy = analysis.factorize_on_device(matrix, dtype)
        if copy is None:
            return device.read(matrix, np.dtype(np.float64), size // 8).reshape(job.shape)
        seconds = time.perf_counter() - begin
        self._on_factorization(seconds)
        if not device.is_current(message.device_factor):
            raise Refused("the slot for the factor was lent to somebody else: this answer is late", "late")
        copy(target)
        self._answers.add(job, analysis.pattern, None, seconds)
        return None
