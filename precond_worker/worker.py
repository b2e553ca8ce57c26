# SPDX-License-Identifier: MIT
"""The worker's loop: take the newest matrix of an object, factorize it, send the factor."""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from precond_worker.builders import Builders
from precond_worker.errors import DeviceUnusable, NameTaken
from precond_worker.job import Job, accept
from precond_worker.methods import Factorization
from precond_worker.presence import ServerGone, ServersThere
from precond_worker.uplink import Uplink
from protocol import FactorPattern
from protocol.check import array, checksum
from protocol.exhausted import exhausted
from protocol.messages_pb2 import Factor
from protocol.method import Method
from protocol.refused import Refused

log = logging.getLogger(__name__)


Analyse = Callable[[NDArray[np.int32], NDArray[np.int32], Method], Factorization]  # as methods.prepared


class Worker:
    """Works for one server, one job at a time, the oldest object first, the newest matrix of each."""

    def __init__(self, uplink: Uplink, analyse: Analyse, on_server: Callable[[bool], None] = lambda found: None):
        self._uplink = uplink
        self._counters = uplink.counters
        self._analyse = analyse
        self._on_server = on_server
        self._analyses: dict[tuple[str, str], tuple[int, Method, int, Factorization]] = {}
        # of an object by name of the method: epoch, method, blocks, and what factorizes
        self._builders = Builders(uplink)
        self._pending: dict[str, Job] = {}

    def run(self) -> None:
        """Work until an exception, such as KeyboardInterrupt, ends it."""
        while True:
            self.step(1.0)

    def step(self, timeout: float) -> None:
        """Take in what came, waiting up to timeout seconds for it, and do one job."""
        self.take_in(timeout)
        self.work()

    @property
    def waiting(self) -> int:
        """Jobs taken in and not done."""
        return len(self._pending)

    def work(self) -> bool:
        """Do one job; False if there is none."""
        if not self._pending:
            return False
        self._do(self._pending.pop(next(iter(self._pending))))
        self._done()
        return True

    def _done(self) -> None:
        if not self._pending:
            self._uplink.mailbox.done()

    def take_in(self, timeout: float) -> None:
        """Take in what came; with nothing to do yet, wait up to timeout seconds for it."""
        for item in self._uplink.mailbox.take(0.0 if self._pending else timeout):
            if isinstance(item, NameTaken):
                raise item
            try:
                if isinstance(item, ServerGone):
                    self._leave_server(item.incarnation)
                elif isinstance(item, ServersThere):
                    self._choose_server(item.incarnations)
                else:
                    self._enqueue(accept(item, self._uplink.name, self._uplink.incarnation))
            except Refused as refusal:
                self._counters.refuse(refusal)
        self._done()

    def _leave_server(self, gone: int) -> None:
        if gone == self._uplink.incarnation:
            self._forget()
            self._uplink.follow(0)
            self._on_server(False)

    def _choose_server(self, there: Sequence[int]) -> None:
        """Stay with the life of the server that is served while it answers; else take one that does and has a token."""
        if self._uplink.incarnation in there:
            return
        for incarnation in there:
            if self._uplink.has_token(incarnation):
                self._forget()
                self._uplink.follow(incarnation)
                self._on_server(True)
                return

    def _forget(self) -> None:
        self._counters.add("superseded", len(self._pending))
        self._pending.clear()
        self._analyses.clear()
        self._builders.clear()

    def _enqueue(self, job: Job) -> None:
        waiting = self._pending.get(job.object)
        if waiting is not None:
            self._counters.add("superseded")
            if waiting.message.header.sequence >= job.message.header.sequence:
                return
        self._pending[job.object] = job

    def _do(self, job: Job) -> None:
        self._counters.add("jobs")
        self._counters.add("bulk_shared" if job.shared else "bulk_copied")
        if job.message.HasField("matrix_slot") and not job.shared:
            self._counters.warn("copied", "a matrix came as a copy although shared memory was tried and found to work")
        try:
            self._factorize(job)
        except Refused as refusal:
            self._counters.refuse(refusal)
            self._answer(job, failure=str(refusal))
        except (ValueError, MemoryError) as error:
            self._counters.add("failures")
            self._answer(job, failure=str(error) or type(error).__name__)
        except DeviceUnusable as error:  # for good: the process ends, and whoever started it may start another
            self._answer(job, failure=str(error))
            raise
        except zenoh.ZError as error:
            self._counters.trouble("unsent", f"a factor was not sent: {error}")
        except Exception as error:
            if why := exhausted(error):  # a library half loaded stays so: another process may have more luck
                self._answer(job, failure=why)
                raise
            log.exception("factorization of %s failed", job.object)
            self._counters.add("failures")
            self._answer(job, failure=f"{type(error).__name__}: {error}")

    def _factorize(self, job: Job) -> None:
        message = job.message
        analysis = self._analysis(job)
        values = job.values(self._uplink.slots)
        builder = self._builders.of(job.object, message.header.epoch) if job.positions else None
        begin = time.perf_counter()
        if builder is not None:
            values = builder.matrix(values)
        # Into memory of our own, so that the checksum is of what was computed whatever happens to the slot.
        factor = np.ascontiguousarray(analysis.factorize(values, np.dtype(message.factor_dtype)))
        seconds = time.perf_counter() - begin
        if analysis.pattern.id not in message.known_patterns:
            self._uplink.send_pattern(analysis.pattern, job.object, message.header.epoch)
        self._answer(job, analysis.pattern, factor, seconds, remedy=analysis.remedy)

    def _analysis(self, job: Job) -> Factorization:
        """The symbolic phase, once per epoch of an object."""
        object, epoch, blocks = job.object, job.message.header.epoch, job.message.blocks
        known = self._analyses.get((object, job.method.name))
        if known is None or known[:2] != (epoch, job.method):
            topology = self._uplink.topology(object, epoch)
            row_start = array(topology.row_start, np.int32, (topology.nodes + 1,), "Topology.row_start")
            columns = array(topology.columns, np.int32, (-1,), "Topology.columns")
            analysis = self._analyse(row_start, columns, job.method)
            known = self._analyses[object, job.method.name] = (epoch, job.method, len(columns), analysis)
            if job.method.name == "cholesky":  # of which there are several
                self._uplink.library = analysis.library
        if known[2] != blocks:
            raise Refused(f"Matrix.blocks is {blocks}; allowed: {known[2]}, as in the topology", "shape")
        return known[3]

    def _answer(
        self,
        job: Job,
        pattern: FactorPattern | None = None,
        values: NDArray[Any] | None = None,
        seconds: float = 0.0,
        failure: str = "",
        remedy: str = "",
    ) -> None:
        message, uplink = job.message, self._uplink
        answer = Factor(
            header=uplink.header(job.object, message.header.epoch, "factor"),
            step=message.step,
            warp=message.warp,
            dtype=message.factor_dtype,
            worker=uplink.name,
            seconds=seconds,
            failure=failure[:500],
            remedy=remedy,
            job=message.header.sequence,
            matrix_shared=job.shared,
        )
        payload = b""
        if pattern is not None and values is not None:
            answer.pattern, answer.nonzeros, answer.checksum = pattern.id, pattern.nonzeros, checksum(values)
            if not self._into_slot(message, answer, values):
                payload = values.tobytes()
        uplink.send_factor(answer, payload)

    def _into_slot(self, message: Any, answer: Factor, values: NDArray[Any]) -> bool:
        """Write the values into the slot lent for them, if there is one and it is still ours."""
        if not message.HasField("factor_slot") or message.factor_slot.capacity < values.nbytes:
            return False
        slot = message.factor_slot
        target = self._uplink.slots.array(slot, values.dtype, values.size)
        if not self._uplink.slots.is_current(slot):
            raise Refused("the slot for the factor was lent to somebody else: this answer is late", "late")
        np.copyto(target, values)
        answer.slot.CopyFrom(slot)
        return True
