# SPDX-License-Identifier: MIT
"""The loop of one server: takes the newest matrix of an object, factorizes it and sends the factor."""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import groupby
from math import inf
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
import zenoh
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int32
from precond_worker.batch import Batch, BatchAnswer
from precond_worker.errors import DeviceUnusable, NameTaken
from precond_worker.factorization.registry import DeviceFactorization, Factorization
from precond_worker.job import Job, accept
from precond_worker.network.presence import ServerGone, ServersThere
from precond_worker.network.server_connection import ServerConnection
from precond_worker.remote_assembly import Assemblers
from precond_worker.symbolic.preparation import LEAST_NODES, objects_to_prepare
from protocol.channels import WHOLE_PARTS
from protocol.factor import FactorPattern
from protocol.messages_pb2 import Factor, Topology
from protocol.method import COMPLETE, Method
from protocol.process.exhausted import exhausted
from protocol.refused import Refused
from protocol.validate import array, checksum, copied, topology_checksum

log = logging.getLogger(__name__)

ANSWER_SECONDS = 3e-3  # s for which answers wait for others of their batch
ASK_AGAIN = 0.1  # s until a server that does not tell yet what it simulates is asked again
ASK_FOR = 60.0  # s for which it is: its name is there before its scene is made

Analyse = Callable[[Int32, Int32, Method], Factorization]  # registry.make_factorization


class CachedAnalysis(NamedTuple):
    """The symbolic phase of an object, for the matrices of one epoch and method. blocks: of each matrix."""

    epoch: int
    method: Method
    blocks: int
    factorization: Factorization


class JobsTogether(NamedTuple):
    """Jobs whose matrices of one pattern are factorized together, since `begun` [s]."""

    jobs: Sequence[Job]
    analysis: Any
    end: Callable[[], NDArray[Any] | None]
    begun: float


class Worker:
    """Does the jobs of one server: the object that waits longest first, of each the newest matrix; together with it
    those of other objects, where a library factorizes many matrices of one pattern at a time. While it does, the next
    ones are made ready, and the last ones sent. Before there is a job the symbolic phase of large objects is done."""

    def __init__(
        self, connection: ServerConnection, analyse: Analyse, on_server: Callable[[bool], None] = lambda found: None,
        on_factorization: Callable[[float], None] = lambda seconds: None,
    ):  # fmt: skip
        self._connection = connection
        self._counters = connection.counters
        self._analyse = analyse
        self._on_server = on_server
        self._on_factorization = on_factorization
        self._analyses: dict[tuple[str, str], CachedAnalysis] = {}  # by object and name of the method
        self._complete: WeakValueDictionary[int, Factorization] = WeakValueDictionary()  # by topology
        self._blocks: dict[int, int] = {}  # of a matrix, likewise
        self._assemblers = Assemblers(connection)
        self._pending: dict[str, Job] = {}
        self._under_way: JobsTogether | None = None
        self.unprepared: deque[str | None] = deque()  # objects to be made ready for; None: the scene tells which
        self.ask_at = self._ask_until = 0.0  # when it is asked for, and until when again [s, monotonic]
        self._last_end = 0.0  # when such jobs were done last [s]
        self._answers: dict[int, BatchAnswer] = {}  # by id of the batch; sent before a batch is forgotten

    def run(self) -> None:
        """Works until an exception such as KeyboardInterrupt."""
        while True:
            self.step(1.0)

    def step(self, timeout: float) -> None:
        """Takes in what was received, waiting up to `timeout` seconds for it, and does one job."""
        self.take_in(timeout)
        self.work()

    @property
    def idle(self) -> bool:
        """True if no job waits, taken in or not."""
        return not self.waiting and self._connection.received.idle

    @property
    def waiting(self) -> int:
        """Number of jobs taken in and not done; 1 while there is something to prepare."""
        jobs = len(self._pending) + (0 if self._under_way is None else len(self._under_way.jobs))
        return jobs or int(self.pause <= 0)

    @property
    def pause(self) -> float:
        """Time [s] until there is something to prepare; inf: there is nothing."""
        return max(0.0, self.ask_at - time.monotonic()) if self.unprepared else inf

    def work(self) -> bool:
        """Does one job, or several of one pattern together; returns False if there is none."""
        if not self.waiting:
            return False
        if self.unprepared and not self._pending and self._under_way is None:
            self._prepare(self.unprepared.popleft())
            self._done()
            if not self.unprepared:
                self._connection.tell()  # the server may wait for that
            return True
        try:
            self._work()
        finally:
            self._send_answers()
        self._done()
        return True

    def _prepare(self, object: str | None) -> None:
        """Does the symbolic phase of an object, unless it is small; None: finds out of which it is to be done."""
        connection, method = self._connection, Method()
        try:
            if object is None:
                self.unprepared.extend(self._objects_to_prepare())
                return
            topology = connection.topology(object)
            if topology.nodes < LEAST_NODES:
                return
            analysis = self._analysis_of(object, topology, method)
            connection.send_pattern(analysis.pattern, object, topology.header.epoch)
            if (make_ready := getattr(analysis, "make_ready", None)) is not None:
                make_ready()
        except DeviceUnusable:
            raise
        except Exception as error:  # the first job will tell of it, if it is still so then
            if exhausted(error) and not isinstance(error, MemoryError):
                raise
            log.debug("nothing is prepared: %s", error)

    def _objects_to_prepare(self) -> list[str | None]:
        """Returns the objects that are to be made ready for; None in place of them where the server is to be asked
        again: it does not tell yet, and has sent no job."""
        try:
            return [*objects_to_prepare(self._connection.scene())]
        except Refused:
            now = time.monotonic()
            if self._analyses or now > self._ask_until:
                raise
            self.ask_at = now + ASK_AGAIN
            return [None]

    def finish(self) -> None:
        """Waits for the jobs that are under way, and answers them."""
        under_way, self._under_way = self._under_way, None
        if under_way is None:
            return
        try:
            self._end_together(under_way)
        finally:
            self._send_answers()
        self._done()

    def _work(self) -> None:
        """Does jobs of one message for a while: their answers leave together. A job that came alone is done alone."""
        end = time.perf_counter() + ANSWER_SECONDS
        while True:
            jobs: Sequence[Job] = self._next() if self._pending else ()
            begun = self._begin_together(jobs) if len(jobs) > 1 else None
            done, self._under_way = self._under_way, begun
            if done is not None:
                self._end_together(done)
            if begun is None:
                for job in jobs:
                    self._do(job)
            jobs = jobs or (done.jobs if done else ())
            following = next(iter(self._pending.values()), None)
            together = following is not None and following.batch is not None and following.batch is jobs[-1].batch
            if not together or time.perf_counter() > end:
                return

    def _next(self) -> list[Job]:
        """Takes the job that waits longest, and others that can be factorized together with it."""
        first = self._pending.pop(next(iter(self._pending)))
        shared = self._known_analysis(first)
        most: int = getattr(shared, "most", 1)
        if shared is not None:
            self._connection.together = most
        jobs = [first]
        for name, job in list(self._pending.items()):
            if len(jobs) >= most:
                break
            alike = job.dtype == first.dtype and not any(j.positions or j.on_device for j in (job, first))
            if alike and self._known_analysis(job) is shared:
                jobs.append(self._pending.pop(name))
        return jobs

    def _known_analysis(self, job: Job) -> Factorization | None:
        """Returns the symbolic phase of a job, if it is done already."""
        key, epoch = (job.object, job.method.name), job.epoch
        known = self._analyses.get(key)
        if known is not None and (known.epoch, known.method) == (epoch, job.method):
            return known.factorization
        alike = self._complete.get(job.topology) if job.method.name == COMPLETE else None
        if alike is not None:
            self._analyses[key] = CachedAnalysis(epoch, job.method, self._blocks[job.topology], alike)
        return alike

    def _begin_together(self, jobs: Sequence[Job]) -> JobsTogether | None:
        """Begins to factorize matrices of one pattern together; None if they must be done one by one."""
        analysis: Any = self._known_analysis(jobs[0])
        assert analysis is not None
        try:
            for job in jobs:
                self._analysis(job)  # the number of blocks is right
            begun = time.perf_counter()
            end = analysis.begin_many(self._matrices(jobs), np.dtype(jobs[0].dtype))
        except DeviceUnusable as error:
            self._give_up(jobs, error)
            raise
        except (Refused, ValueError, MemoryError):
            return None
        return None if end is None else JobsTogether(jobs, analysis, end, begun)

    def _matrices(self, jobs: Sequence[Job]) -> list[Float64]:
        """Returns the matrices of jobs; raises Refused."""
        slots, found = self._connection.slots, []
        for batch, group in groupby(jobs, lambda job: job.batch):
            if batch is None:
                found += [job.values(slots) for job in group]
            else:
                found += batch.matrices([job.place for job in group], slots)
        return found

    def _give_up(self, jobs: Sequence[Job], error: DeviceUnusable) -> None:
        waiting = self._under_way.jobs if self._under_way else ()
        for job in (*waiting, *jobs):
            self._answer(job, failure=str(error))

    def _end_together(self, together: JobsTogether) -> None:
        """Waits for factors and answers with them; makes them one by one if one of them has none."""
        jobs, analysis = together.jobs, together.analysis
        try:
            factors = together.end()
        except DeviceUnusable as error:
            self._give_up(jobs, error)
            raise
        if factors is None:
            for job in jobs:
                self._do(job)
            return
        now = time.perf_counter()
        seconds = (now - max(together.begun, self._last_end)) / len(jobs)  # not what was made before these
        self._last_end = now
        made = zip(jobs, factors, strict=True)
        for _, group in groupby(made, lambda each: each[0].batch or each[0]):
            answered, values = zip(*group, strict=True)
            self._count(answered)
            for _ in answered:
                self._on_factorization(seconds)
            try:
                self._answer_all(answered, analysis.pattern, values, seconds)
            except Refused as refusal:  # their slot was lent to somebody else
                self._counters.refuse(refusal)
            except zenoh.ZError as error:
                self._counters.trouble("unsent", f"a factor was not sent: {error}")

    def _answer_all(
        self, jobs: Sequence[Job], pattern: FactorPattern, values: Sequence[NDArray[Any]], seconds: float
    ) -> None:  # fmt: skip
        """Answers jobs of one message, or one that came alone, with factors that were made together."""
        for job in jobs:
            self._send_pattern(job, pattern)
        alone, batch = [job.place for job in jobs], jobs[0].batch
        if batch is not None:
            alone = self._answers_to(batch).add(alone, self._connection.slots, pattern, values, seconds)
            self._counters.add("factors", len(jobs) - len(alone))
        for job, factor in zip(jobs, values, strict=True):
            if job.place in alone:
                self._answer_alone(job, pattern, factor, seconds)

    def _done(self) -> None:
        if not self.waiting:
            self._connection.received.done()

    def take_in(self, timeout: float) -> None:
        """Takes in what was received; without a waiting job, waits up to `timeout` seconds for it."""
        for item in self._connection.received.take(0.0 if self.waiting else min(timeout, self.pause)):
            if isinstance(item, NameTaken):
                raise item
            try:
                if isinstance(item, ServerGone):
                    self._leave_server(item.incarnation)
                elif isinstance(item, ServersThere):
                    self._choose_server(item.incarnations)
                else:
                    connection = self._connection
                    for job in accept(item, connection.server, connection.name, connection.incarnation):
                        self._enqueue(job)
            except Refused as refusal:
                self._counters.refuse(refusal)
        self._done()

    def _leave_server(self, gone: int) -> None:
        if gone == self._connection.incarnation:
            self._forget()
            self._connection.follow(0)
            self._on_server(False)

    def _choose_server(self, there: Sequence[int]) -> None:
        """Keeps the incarnation that is served while it answers, else takes one that answers and has a token."""
        if self._connection.incarnation in there:
            return
        for incarnation in there:
            if self._connection.has_token(incarnation):
                self._forget()
                self._connection.follow(incarnation)
                self._on_server(True)
                if self._connection.shared_memory:  # topologies are large for a network, and jobs may never come
                    self.unprepared.append(None)
                    self.ask_at, self._ask_until = 0.0, time.monotonic() + ASK_FOR
                return

    def _forget(self) -> None:
        self.unprepared.clear()
        self._counters.add("superseded", self.waiting)
        self._pending.clear()
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.end()  # until then a device writes to memory that is freed with the analysis
        self._analyses.clear()
        self._assemblers.clear()
        self._connection.offered.clear()

    def _enqueue(self, job: Job) -> None:
        waiting = self._pending.get(job.object)
        if waiting is not None:
            self._counters.add("superseded")
            if waiting.number >= job.number:
                return
        self._pending[job.object] = job

    def _count(self, jobs: Sequence[Job]) -> None:
        """Counts jobs of one message, whose values came alike."""
        for job in jobs:
            self._connection.offered.withdraw(job.object)  # the server has the last one, or has given it up
        first = jobs[0]
        self._counters.add("jobs", len(jobs))
        self._counters.add("bulk_shared" if first.shared else "bulk_copied", len(jobs))
        if (first.batch is not None or first.message.HasField("matrix_slot")) and not first.shared:
            self._counters.warn("copied", "a matrix came as a copy although shared memory was tried and found to work")

    def _do(self, job: Job) -> None:
        self._count([job])
        try:
            self._factorize(job)
        except Refused as refusal:
            self._counters.refuse(refusal)
            self._answer(job, failure=str(refusal))
        except (ValueError, MemoryError) as error:
            self._counters.add("failures")
            self._answer(job, failure=str(error) or type(error).__name__)
        except DeviceUnusable as error:  # for good: the process ends, and its supervisor may start another
            self._answer(job, failure=str(error))
            raise
        except zenoh.ZError as error:
            self._counters.trouble("unsent", f"a factor was not sent: {error}")
        except Exception as error:
            if why := exhausted(error):  # a library loaded in part stays so; another process may succeed
                self._answer(job, failure=why)
                raise
            log.exception("factorization of %s failed", job.object)
            self._counters.add("failures")
            self._answer(job, failure=f"{type(error).__name__}: {error}")

    def _factorize(self, job: Job) -> None:
        message = job.message
        analysis = self._analysis(job)
        if job.on_device:
            try:
                values = self._factorize_on_device(job, analysis)
            except Refused as refusal:
                if refusal.kind != "late":  # the next one would fare no better
                    self._connection.leave_device(str(refusal))
                raise
            if values is None:
                return
        else:
            values = job.values(self._connection.slots)
        assembler = self._assemblers.of(job.object, message.header.epoch) if job.positions else None
        complete = job.method.name == COMPLETE  # its pattern is known beforehand
        if complete:  # so that the server can prepare for it meanwhile
            self._send_pattern(job, analysis.pattern)
        begin = time.perf_counter()
        if assembler is not None:
            values = assembler.matrix(values)
        # In memory of this process, so that the checksum is of what was computed, whatever happens to the slot.
        factor = np.ascontiguousarray(analysis.factorize(values, np.dtype(message.factor_dtype)))
        seconds = time.perf_counter() - begin
        self._on_factorization(seconds)
        if not complete:
            self._send_pattern(job, analysis.pattern)
        self._answer(job, analysis.pattern, factor, seconds, remedy=analysis.remedy)

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
        self._send_pattern(job, analysis.pattern)
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
        self._answer(job, analysis.pattern, None, seconds)
        return None

    def _send_pattern(self, job: Job, pattern: FactorPattern) -> None:
        """Sends the pattern of L if the server does not know it."""
        if pattern.id not in job.known_patterns:
            self._connection.send_pattern(pattern, job.object, job.epoch)

    def _analysis(self, job: Job) -> Factorization:
        """Returns the symbolic phase, done once per epoch of an object."""
        object, epoch, blocks = job.object, job.epoch, job.blocks
        if self._known_analysis(job) is None:
            self._analysis_of(object, self._connection.topology(object, epoch), job.method)
        known = self._analyses[object, job.method.name]
        if known.blocks != blocks:
            raise Refused(f"Matrix.blocks is {blocks}; allowed: {known.blocks}, as in the topology", "shape")
        return known.factorization

    def _analysis_of(self, object: str, topology: Topology, method: Method) -> Factorization:
        """Does the symbolic phase of an object, unless one like it has had it."""
        row_start = array(topology.row_start, np.int32, (topology.nodes + 1,), "Topology.row_start")
        columns = array(topology.columns, np.int32, (-1,), "Topology.columns")
        analysis = self._shared(topology_checksum(topology), row_start, columns, method)
        self._analyses[object, method.name] = CachedAnalysis(topology.header.epoch, method, len(columns), analysis)
        if method.name == COMPLETE:  # by one of several libraries
            self._connection.library = analysis.library
        return analysis

    def _shared(self, topology: int, row_start: Int32, columns: Int32, method: Method) -> Factorization:
        """Returns the symbolic phase of a pattern; objects of one topology (its checksum) share that of complete
        factors."""
        if method.name != COMPLETE:
            return self._analyse(row_start, columns, method)
        known = self._complete.get(topology)
        if known is None:
            known = self._complete[topology] = self._analyse(row_start, columns, method)
            self._blocks = {each: count for each, count in self._blocks.items() if each in self._complete}
            self._blocks[topology] = len(columns)
        return known

    def _answer(
        self, job: Job, pattern: FactorPattern | None = None, values: NDArray[Any] | None = None, seconds: float = 0.0,
        failure: str = "", remedy: str = "",
    ) -> None:  # fmt: skip
        """Answers a job, with others of its message where its factor fits into its room there."""
        if job.batch is None:
            return self._answer_alone(job, pattern, values, seconds, failure, remedy)
        answers = self._answers_to(job.batch)
        if pattern is None or values is None:
            answers.add_failure(job.place, failure[:500])
        elif answers.add([job.place], self._connection.slots, pattern, [values], seconds, remedy):
            self._answer_alone(job, pattern, values, seconds, failure, remedy)
        else:
            self._counters.add("factors")

    def _answer_alone(
        self, job: Job, pattern: FactorPattern | None, values: NDArray[Any] | None, seconds: float,
        failure: str = "", remedy: str = "",
    ) -> None:  # fmt: skip
        message, connection = job.message, self._connection
        answer = Factor(
            header=connection.header(job.object, message.header.epoch, "factor"),
            step=message.step,
            warp=message.warp,
            dtype=message.factor_dtype,
            worker=connection.name,
            seconds=seconds,
            failure=failure[:500],
            remedy=remedy,
            job=message.header.sequence,
            matrix_shared=job.shared,
        )
        payload = b""
        if pattern is not None:
            answer.pattern, answer.nonzeros = pattern.id, pattern.nonzeros
        if pattern is not None and values is None:  # they are in the slot already
            answer.device_slot.CopyFrom(message.device_factor)
        elif pattern is not None and values is not None:
            if self._into_slot(message, answer, values):
                pass
            elif 0 < WHOLE_PARTS * message.part_bytes < values.nbytes:
                number, size = message.header.sequence, message.part_bytes
                answer.parts.extend(connection.offered.offer(job.object, answer.header, number, values, size))
            else:
                answer.checksum = checksum(values)
                payload = values.tobytes()
        connection.send_factor(answer, payload)
        if pattern is not None:
            self._counters.add("factors")

    def _answers_to(self, batch: Batch) -> BatchAnswer:
        """Returns the answers to jobs of a message that leave together."""
        if id(batch) not in self._answers:
            connection = self._connection
            self._answers[id(batch)] = BatchAnswer(batch, connection.header("", 0, "factors"), connection.name)
        return self._answers[id(batch)]

    def _send_answers(self) -> None:
        answers, self._answers = self._answers, {}
        for answer in answers.values():
            if not answer.message.jobs:
                continue
            try:
                self._connection.send_factors(answer.finished())
            except zenoh.ZError as error:
                self._counters.trouble("unsent", f"factors were not sent: {error}")

    def _into_slot(self, message: Any, answer: Factor, values: NDArray[Any]) -> bool:
        """Writes the values into the slot lent for them, and their checksum into the answer; returns False if there is
        no slot that is large enough."""
        if not message.HasField("factor_slot") or message.factor_slot.capacity < values.nbytes:
            return False
        slot = message.factor_slot
        target = self._connection.slots.array(slot, values.dtype, values.size)
        if not self._connection.slots.is_current(slot):
            raise Refused("the slot for the factor was lent to somebody else: this answer is late", "late")
        answer.checksum, _ = copied(values, target, own=values)
        answer.slot.CopyFrom(slot)
        return True
