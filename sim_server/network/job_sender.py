# SPDX-License-Identifier: MIT
"""Sends jobs to workers: alone or in batches, with slots of shared memory for what fits."""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from operator import attrgetter

import numpy as np
import zenoh

from protocol.channels import PART_BYTES, WHOLE_PARTS, key
from protocol.counters import Counters
from protocol.factor import FactorPattern
from protocol.messages_pb2 import Matrix, MatrixBatch
from protocol.method import COMPLETE, Method
from protocol.shared_memory.limits import SLOT_SHARE
from protocol.shared_memory.pool import Slot, SlotPool
from sim_server.arrays import Float64
from sim_server.backends.shared_memory import PlacedMatrix
from sim_server.network.batch_message import MOST_TOGETHER, BatchLayout, batch_message, fill, most_values
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.device_slots import DeviceSlot, DeviceSlots
from sim_server.network.factor_decoder import AnnouncedObject
from sim_server.network.job_message import add_values, matrix_message
from sim_server.network.jobs_in_flight import JobsInFlight
from sim_server.network.send_queue import SendQueue
from sim_server.network.worker_choice import WorkerChoice
from sim_server.updates.factor_source import Job
from sim_server.updates.jobs_together import JobsTogether

FAST_SEND = 0.05  # s in which a fast link takes a job as bytes; zenoh drops what is not taken within 0.25 s
BEHIND = 10.0  # s of a lease, at most, for what waits at a worker behind a first job, which has a longer one
LEAST_ON_DEVICE = 1 << 20
"""Bytes of a factor; what has no more crosses the host in less time than the device needs to answer."""
SHAPE, DTYPE, FLOAT64 = attrgetter("shape"), attrgetter("dtype"), np.dtype(np.float64)  # of matrices
SLOT_MARGIN = 8  # the slot for an incomplete factor is larger than the largest factor so far by a SLOT_MARGIN-th


@dataclass
class Filling:
    """Slots of a batch that the thread of the queue fills and sends; `over` once it has."""

    slots: tuple[Slot, Slot]
    over: bool = False


class JobSender:
    """Sends jobs through a queue, so that nobody waits for the network.

    pool: shared memory for arrays; None: they travel as bytes
    device: device memory for matrices and factors of workers beside it; None: there is none
    """

    device: DeviceSlots | None = None

    def __init__(
        self, session: zenoh.Session, server: str, incarnation: int, pool: SlotPool | None, queue: SendQueue,
        counters: Counters, book: Bookkeeping, choice: WorkerChoice,
    ):  # fmt: skip
        self._session, self._server, self._incarnation = session, server, incarnation
        self._pool, self._queue, self._counters = pool, queue, counters
        self._book, self._choice = book, choice
        self._filling: deque[Filling] = deque()  # oldest first
        self._fast_links: set[str] = set()  # workers without shared memory whose link takes a job at once

    def forget_link(self, worker: str) -> None:
        """Takes the link to a worker for slow until it shows that it is fast."""
        self._fast_links.discard(worker)

    def give_back_sent(self) -> None:
        """Gives back slots that the thread of the queue needs no more: they are free once their jobs are over, too."""
        while self._filling and self._filling[0].over:
            self._give_back(self._filling.popleft().slots)

    def _give_back(self, slots: Sequence[Slot]) -> None:
        if self._pool is not None:
            for slot in slots:
                self._pool.give_back(slot)

    def submit(self, job: Job) -> bool:
        """Sends a job alone; False if no worker has room or the object has a job in flight."""
        self._check(job)
        idle = [name for name in self._choice.open() if not job.positions or self._choice.assembles(name)]
        idle = self._choice.candidates(idle, job.object)
        if job.object in self._book.leases.by_object or not idle:
            return False
        return self._send_alone(self._choice.choose(idle, job.object), job)

    def submit_many(self, jobs: Sequence[Job], rooms: dict[str, int]) -> list[bool]:
        """Sends jobs of different objects, the most urgent first, those of small objects to one worker in one message.
        rooms: as of WorkerChoice

        False as of `submit`.
        """
        rooms = dict(rooms) if len(jobs) > 1 else {}
        able = {name for name, room in rooms.items() if room > 1 and self._choice.takes_batches(name)}
        failing = bool(self._book.reliability.failing_objects)
        if isinstance(jobs, JobsTogether) and len(rooms) == len(able) == 1 and not failing:
            (worker,) = able
            if (told := self._layout_of(fitting := jobs[: rooms[worker]])) is not None:
                return self._send_batches(worker, fitting, told) + [False] * (len(jobs) - len(fitting))
        return self.submit_sorted(jobs, rooms, able, failing)

    def submit_sorted(
        self, jobs: Sequence[Job], rooms: dict[str, int], able: set[str], failing: bool
    ) -> list[bool]:  # fmt: skip
        """Sends jobs, a worker chosen for each. rooms, able: of workers with room, and those that take batches"""
        taken = [False] * len(jobs)
        batches: dict[tuple[str, tuple[str, Method]], list[int]] = {}  # places of jobs by worker and what they share
        idle, known = [name for name, room in rooms.items() if room > 0], [self._check(job) for job in jobs]
        for place, job in enumerate(jobs):
            worker = self._worker_for(job, idle, rooms, failing) if idle else None
            alone = worker not in able or job.positions or not most_values(known[place], job.method.name)
            if worker is None or alone:
                taken[place] = self.submit(job)
                rooms = self._choice.rooms()
                for (name, _), places in batches.items():
                    rooms[name] = rooms.get(name, 0) - len(places)
                idle = [name for name, room in rooms.items() if room > 0]
                continue
            rooms[worker] -= 1
            if not rooms[worker]:
                idle.remove(worker)
            batches.setdefault((worker, (job.dtype, job.method)), []).append(place)
        for (worker, _), places in batches.items():
            together = JobsTogether.of([jobs[k] for k in places])
            told = BatchLayout.of([known[k] for k in places], together.method.name, together.dtype)
            sent = self._send_batches(worker, together, told)
            for place, well in zip(places, sent, strict=True):
                taken[place] = well
        return taken

    def _layout_of(self, jobs: JobsTogether) -> BatchLayout | None:
        """Returns the layout of jobs if all of them may share batches, as those of many small bodies do; None: they may
        not."""
        objects, flying = self._book.decoder.objects, self._book.leases.by_object
        if not flying.keys().isdisjoint(jobs.objects) or len(set(jobs.objects)) < len(jobs):
            return None
        first, method = objects.get(jobs.objects[0]), jobs.method.name
        if (
            first is not None
            and list(map(first.complete.epochs.get, jobs.objects)) == jobs.epochs
            and method == COMPLETE
        ):
            told = BatchLayout.of_alike(first, len(jobs), jobs.dtype)
        else:
            known = [each for each in map(objects.get, jobs.objects) if each is not None]
            if [each.epoch for each in known] != jobs.epochs:
                return None
            told = BatchLayout.of(known, method, jobs.dtype)
        shapes = [(blocks, 3, 3) for blocks in told.blocks]
        fit = shapes == list(map(SHAPE, jobs.values)) and set(map(DTYPE, jobs.values)) == {FLOAT64}
        return told if fit and told.rooms.all() else None

    def _send_batches(self, worker: str, jobs: JobsTogether, told: BatchLayout) -> list[bool]:
        """Sends jobs to a worker in as few messages as they fit into."""
        parts = [slice(k, k + MOST_TOGETHER) for k in range(0, len(jobs), MOST_TOGETHER)]
        return [sent for part in parts for sent in self._send_batch(worker, jobs[part], told.part(part))]

    def _check(self, job: Job) -> AnnouncedObject:
        """Returns what is known of the object of a job. Raises ValueError for one that is not of its epoch or shape."""
        known, values = self._book.decoder.objects.get(job.object), job.values
        if known is None or known.epoch != job.epoch:
            raise ValueError(f"job for {job.object} epoch {job.epoch}, which was not announced")
        shape = (known.size // 3, 3) if values.ndim == 2 else (known.blocks, 3, 3)
        if values.shape != shape or values.dtype != np.float64:
            raise ValueError(f"job for {job.object}: values {values.shape}, allowed: float64 {shape}")
        return known

    def _worker_for(self, job: Job, idle: list[str], rooms: Mapping[str, int], failing: bool) -> str | None:
        """Chooses a worker of those with room; None if there is none or the object has a job in flight. failing: of
        any object jobs failed"""
        if job.object in self._book.leases.by_object:
            return None
        able = [name for name in idle if self._choice.assembles(name)] if job.positions else idle
        if failing:
            able = self._choice.candidates(able, job.object)
        return self._choice.choose(able, job.object, rooms) if able else None

    # ---- a batch ---------------------------------------------------------------------------------------------

    def _send_batch(self, worker: str, jobs: JobsTogether, told: BatchLayout) -> list[bool]:
        """Sends jobs to a worker in one message, or one by one if there are no slots for them together."""
        leases, slots = self._book.leases, self._allocate_batch(told) if len(jobs) > 1 else None
        if slots is None:
            return [self._send_alone(worker, job) for job in jobs]
        seconds, periods = leases.terms.of_all(jobs.objects, told.blocks, worker, jobs.method.name)
        batch = self._begin(worker, jobs, seconds, periods)
        batch.first, batch.rooms, batch.matrices, batch.bodies = told.first, told.rooms, jobs.values, jobs.bodies
        batch.slots, batch.factor_slot, batch.factor_generation = slots, slots[1], slots[1].generation
        leases.start(batch)
        message = partial(batch_message, batch, told, seconds.tolist(), jobs.method, self._incarnation, *slots)
        if self._queue.post(partial(self._fill_and_put, message, batch, filling := Filling(slots))):
            self._filling.append(filling)
            self._on_sent(batch, 72 * sum(told.blocks))
            return [True] * len(jobs)
        leases.cancel(batch.jobs)
        self._give_back(slots)
        return [False] * len(jobs)

    def _fill_and_put(self, message: Callable[[], MatrixBatch], batch: JobsInFlight, filling: Filling) -> None:
        """Makes the message of a batch, copies its matrices and sends them, in the thread of the queue. The slots are
        not lent again meanwhile."""
        slot, name = filling.slots[0], key("matrices", self._server, worker=batch.worker)
        try:
            fill(made := message(), batch.matrices, slot)
            self._put(batch, name, slot.payload, made.SerializeToString(), True)
        finally:
            filling.over = True

    def _allocate_batch(self, told: BatchLayout) -> tuple[Slot, Slot] | None:
        """Allocates a slot for matrices and one for factors; None if there is not enough shared memory."""
        assert self._pool is not None
        users = len(told.blocks) + 1  # and the thread that sends them
        matrices = self._pool.lend(72 * sum(told.blocks), users)
        factors = self._pool.lend(told.bytes, users)
        if matrices is not None and factors is not None:
            return matrices, factors
        for slot in filter(None, (matrices, factors)):
            self._pool.give_back(slot, users)
        return None

    # ---- a job alone -----------------------------------------------------------------------------------------

    def _send_alone(self, worker: str, job: Job) -> bool:
        if (on_device := self._lend_on_device(worker, job)) is not None:
            return self._send_on_device(worker, job, *on_device)
        matrix_slot, factor_slot = self._allocate(worker, job)
        known = self._book.decoder.objects[job.object]
        batch, lease = self._begin_alone(worker, job, known)
        batch.slots = tuple(slot for slot in (matrix_slot, factor_slot) if slot is not None)
        batch.factor_slot, batch.factor_generation = factor_slot, factor_slot.generation if factor_slot else 0
        batch.payload_bytes = 0 if matrix_slot else job.values.nbytes
        self._book.leases.start(batch)
        message = matrix_message(batch.jobs[0], known, self._incarnation, lease, job.method)
        payload = add_values(message, job.values, matrix_slot)
        name, attachment = key("matrix", self._server, worker=worker, object=job.object), message.SerializeToString()
        if self._queue.post(lambda: self._put(batch, name, payload, attachment, matrix_slot is not None)):
            self._on_sent(batch, job.values.nbytes)
            return True
        self._book.leases.cancel(batch.jobs)
        return False

    def _lend_on_device(self, worker: str, job: Job) -> list[DeviceSlot] | None:
        """Lends slots of device memory for a matrix and its factor, whose size must be known; None: they travel through
        the host."""
        size = self._book.decoder.objects[job.object].most_values(job.method.name) * np.dtype(job.dtype).itemsize
        able = self.device is not None and self._choice.shares_device(worker)
        if not able or self.device is None or job.positions or job.method.name != COMPLETE or size <= LEAST_ON_DEVICE:
            return None
        return self.device.lend([job.values.nbytes, size])

    def _send_on_device(self, worker: str, job: Job, matrix: DeviceSlot, factor: DeviceSlot) -> bool:
        known, leases = self._book.decoder.objects[job.object], self._book.leases
        batch, lease = self._begin_alone(worker, job, known)
        batch.slots, batch.device_slot, batch.device_generation = (matrix, factor), factor, factor.generation
        leases.start(batch)
        message = matrix_message(batch.jobs[0], known, self._incarnation, lease, job.method)
        message.device_matrix.CopyFrom(matrix.message())
        if self._queue.post(partial(self._put_on_device, batch, job, message, matrix)):
            self._on_sent(batch, job.values.nbytes)
            return True
        leases.cancel(batch.jobs)
        return False

    def _put_on_device(self, batch: JobsInFlight, job: Job, message: Matrix, matrix: DeviceSlot) -> None:
        """Copies a matrix within the device and sends its job, in the thread of the queue."""
        device, factor = self.device, batch.device_slot
        assert device is not None and factor is not None
        for slot, told in ((matrix, message.device_matrix), (factor, message.device_factor)):
            device.mark(slot, told.generation)
        device.memory.put(matrix.address, [PlacedMatrix(job.values, job.on_device)])
        name = key("matrix", self._server, worker=batch.worker, object=job.object)
        self._put(batch, name, zenoh.ZBytes(b""), message.SerializeToString(), True)

    def _allocate(self, worker: str, job: Job) -> tuple[Slot | None, Slot | None]:
        """Allocates slots for the matrix and its factor; None for an array that must travel as bytes, as the first
        large one does while its slot is being made: the caller would wait for that as long as many rounds take."""
        if self._pool is None or not self._choice.has_slots(worker):
            return None, None
        nonzeros = self._book.decoder.objects[job.object].most_values(job.method.name)
        if job.method.name == "incomplete_cholesky":
            nonzeros += nonzeros // SLOT_MARGIN  # the next factor may keep more blocks
        size = nonzeros * np.dtype(job.dtype).itemsize
        if not self._fits_slot(size):
            size = 0  # it comes in parts
        pool, sizes = self._pool, [job.values.nbytes, *([size] if size else [])]
        slots = [pool.lend(each, beside=True) for each in sizes]
        if any(slot is None and not pool.is_making(each) for slot, each in zip(slots, sizes, strict=True)):
            self._counters.trouble("slots_exhausted", "no slot of shared memory is left, an array travels as bytes")
        matrix, factor = [*slots, None][:2]
        return matrix, factor

    def _fits_slot(self, size: int) -> bool:
        """True if a factor of so many bytes may come in a slot."""
        return self._pool is not None and size <= max(WHOLE_PARTS * PART_BYTES, self._pool.limit // SLOT_SHARE)

    def prepare_for(self, object: str, pattern: FactorPattern, worker: str) -> None:
        """Has the slot for a large factor, or for its parts, made beside the caller before its first job. Where the
        worker that sent its pattern opens device memory, so are slots there for it and its matrix: they are kept for
        good."""
        size = 4 * pattern.nonzeros
        if self._pool is not None:
            self._pool.prepare(size if self._fits_slot(size) else PART_BYTES)
        if self.device is not None and size > LEAST_ON_DEVICE and self._choice.shares_device(worker):
            self.device.prepare([72 * self._book.decoder.objects[object].blocks, size])

    # ---- both ------------------------------------------------------------------------------------------------

    def _begin_alone(self, worker: str, job: Job, known: AnnouncedObject) -> tuple[JobsInFlight, float]:
        """Makes the batch of a job alone, with the time [s] that its worker has."""
        terms = self._book.leases.terms
        lease = terms.lease(job.object, worker, job.method.name, job.positions, known.blocks)
        period = terms.exclusive_period(job.object, known.blocks)
        batch = self._begin(worker, JobsTogether.of([job]), np.array([lease]), np.array([period]))
        batch.positions, batch.part_bytes = job.positions, PART_BYTES
        return batch, lease

    def _begin(self, worker: str, jobs: JobsTogether, seconds: Float64, periods: Float64) -> JobsInFlight:
        """Makes the batch of jobs that are being sent together, still without slots.

        seconds: that the worker has for each, longer behind jobs that have longer. periods: exclusive ones [s]
        """
        now, leases = self._book.clock(), self._book.leases
        behind = np.maximum(leases.deadlines().get(worker, 0.0) - now, np.maximum.accumulate(seconds))
        deadlines = now + np.maximum(seconds, np.minimum(behind, BEHIND))
        return JobsInFlight(
            worker, _dtype_name(jobs.dtype), jobs.method.name, leases.next_numbers(len(jobs)), jobs.objects,
            jobs.epochs, jobs.steps, jobs.warps, deadlines, now + periods, now,
        )  # fmt: skip

    def _on_sent(self, batch: JobsInFlight, size: int) -> None:
        """Takes note of a batch whose matrices have so many bytes."""
        self._book.last_worker.update(dict.fromkeys(batch.objects, batch.worker))
        self._book.reliability.on_sent(batch.worker, self._book.clock())
        self._counters.add("jobs", len(batch))
        self._counters.add("bytes_out", size)

    def _put(self, batch: JobsInFlight, name: str, payload: zenoh.ZBytes, attachment: bytes, shared: bool) -> None:
        """Sends a job or a batch of them, in the thread of the send queue. If a link is full, zenoh drops it or blocks.

        A dropped job ends its lease. zenoh blocks only for bytes over a link that is not known to be fast, since a
        slow link takes longer than zenoh would keep them. While it blocks for one receiver all others wait too, even
        for a receiver that subscribed to everything and stopped reading. The priority is one of its own, since a
        blocked message locks the queue of its priority.
        """
        worker = batch.worker
        drop = shared or worker in self._fast_links
        control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
        begin = time.perf_counter()
        self._session.put(
            name, payload, attachment=attachment, congestion_control=control, priority=zenoh.Priority.BACKGROUND
        )
        if not drop and time.perf_counter() - begin < FAST_SEND:
            self._fast_links.add(worker)
        batch.put_at = self._book.clock()


@cache
def _dtype_name(dtype: str) -> str:
    return np.dtype(dtype).name
