# SPDX-License-Identifier: MIT
"""Sends jobs to the workers that are chosen: in batches (batch_sender.py), or alone, with slots for what fits."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import zenoh

from protocol.channels import PART_BYTES, WHOLE_PARTS, key
from protocol.counters import Counters
from protocol.factor import FactorPattern
from protocol.messages_pb2 import Matrix
from protocol.method import COMPLETE, Method
from protocol.shared_memory.limits import SLOT_SHARE
from protocol.shared_memory.pool import Slot, SlotPool
from sim_server.backends.shared_memory import PlacedMatrix
from sim_server.network.batch_message import BatchLayout, most_values
from sim_server.network.batch_sender import BatchSender
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.device_slots import DeviceSlot, DeviceSlots
from sim_server.network.factor_decoder import AnnouncedObject
from sim_server.network.job_message import add_values, matrix_message
from sim_server.network.jobs_in_flight import JobsInFlight
from sim_server.network.send_queue import SendQueue
from sim_server.network.sending import Sending
from sim_server.network.worker_choice import WorkerChoice
from sim_server.updates.factor_source import Job
from sim_server.updates.jobs_together import JobsTogether

LEAST_ON_DEVICE = 1 << 20
"""Bytes of a factor; what has no more crosses the host in less time than the device needs to answer."""
SLOT_MARGIN = 8  # the slot for an incomplete factor is larger than the largest factor so far by a SLOT_MARGIN-th


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
        self._sending = Sending(session, server, incarnation, queue, counters, book)
        self._pool, self._counters, self._book, self._choice = pool, counters, book, choice
        self._batches = BatchSender(self._sending, pool, self._send_alone)
        self.forget_link, self.give_back_sent = self._sending.forget_link, self._batches.give_back_sent

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
        failing = self._book.reliability.failing_objects
        if isinstance(jobs, JobsTogether) and len(rooms) == len(able) == 1 and failing.isdisjoint(jobs.objects):
            ((worker, room),) = rooms.items()
            fitting = jobs if len(jobs) <= room else jobs[:room]
            if (told := self._batches.layout_of(fitting)) is not None:
                return self._batches.send(worker, fitting, told) + [False] * (len(jobs) - len(fitting))
        return self.submit_sorted(jobs, rooms, able, bool(failing))

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
            sent = self._batches.send(worker, together, told)
            for place, well in zip(places, sent, strict=True):
                taken[place] = well
        return taken

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
        message = matrix_message(batch.jobs[0], known, self._sending.incarnation, lease, job.method)
        payload = add_values(message, job.values, matrix_slot)
        name = key("matrix", self._sending.server, worker=worker, object=job.object)
        attachment, shared = message.SerializeToString(), matrix_slot is not None
        send = partial(self._sending.put, batch, name, payload, attachment, shared)
        return self._sending.post(batch, job.values.nbytes, send)

    def _lend_on_device(self, worker: str, job: Job) -> list[DeviceSlot] | None:
        """Lends slots of device memory for a matrix and its factor, whose size must be known; None: they travel through
        the host."""
        size = self._book.decoder.objects[job.object].most_values(job.method.name) * np.dtype(job.dtype).itemsize
        able = self.device is not None and self._choice.shares_device(worker)
        if not able or self.device is None or job.positions or job.method.name != COMPLETE or size <= LEAST_ON_DEVICE:
            return None
        return self.device.lend([job.values.nbytes, size])

    def _send_on_device(self, worker: str, job: Job, matrix: DeviceSlot, factor: DeviceSlot) -> bool:
        known = self._book.decoder.objects[job.object]
        batch, lease = self._begin_alone(worker, job, known)
        batch.slots, batch.device_slot, batch.device_generation = (matrix, factor), factor, factor.generation
        message = matrix_message(batch.jobs[0], known, self._sending.incarnation, lease, job.method)
        message.device_matrix.CopyFrom(matrix.message())
        send = partial(self._put_on_device, batch, job, message, matrix)
        return self._sending.post(batch, job.values.nbytes, send)

    def _put_on_device(self, batch: JobsInFlight, job: Job, message: Matrix, matrix: DeviceSlot) -> None:
        """Copies a matrix within the device and sends its job, in the thread of the queue."""
        device, factor = self.device, batch.device_slot
        assert device is not None and factor is not None
        for slot, told in ((matrix, message.device_matrix), (factor, message.device_factor)):
            device.mark(slot, told.generation)
        device.memory.put(matrix.address, [PlacedMatrix(job.values, job.on_device)])
        name = key("matrix", self._sending.server, worker=batch.worker, object=job.object)
        self._sending.put(batch, name, zenoh.ZBytes(b""), message.SerializeToString(), True)

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

    def _begin_alone(self, worker: str, job: Job, known: AnnouncedObject) -> tuple[JobsInFlight, float]:
        """Makes the batch of a job alone, with the time [s] that its worker has."""
        terms = self._book.leases.terms
        lease = terms.lease(job.object, worker, job.method.name, job.positions, known.blocks)
        period = terms.exclusive_period(job.object, known.blocks)
        batch = self._sending.begin(worker, JobsTogether.of([job]), np.array([lease]), np.array([period]))
        batch.positions, batch.part_bytes = job.positions, PART_BYTES
        return batch, lease
