# SPDX-License-Identifier: MIT
"""Sends jobs to workers: alone or in batches, with slots of shared memory for what fits."""

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

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
from sim_server.network.batch_message import MOST_TOGETHER, Entry, batch_message, entries_of, fill, group
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.device_slots import DeviceSlot, DeviceSlots
from sim_server.network.factor_decoder import AnnouncedObject
from sim_server.network.job_message import add_values, matrix_message
from sim_server.network.leases import InFlightJob
from sim_server.network.send_queue import SendQueue
from sim_server.network.worker_choice import WorkerChoice
from sim_server.updates.factor_source import Job

FAST_SEND = 0.05  # s in which a fast link takes a job as bytes; zenoh drops what is not taken within 0.25 s
BEHIND = 10.0  # s of a lease, at most, for what waits at a worker behind a first job, which has a longer one
LEAST_ON_DEVICE = 1 << 20
"""Bytes of a factor; what has no more crosses the host in less time than the device needs to answer."""
MAX_SENT = 4096  # times of jobs that are remembered
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
        self._sent: dict[int, float] = {}  # when the network took a job, by its number
        self._filling: deque[Filling] = deque()  # oldest first
        self._fast_links: set[str] = set()  # workers without shared memory whose link takes a job at once

    def sent_at(self, job: InFlightJob) -> float:
        """Time at which the network took a job [s, monotonic]; inf: it has not yet."""
        return self._sent.get(job.number, float("inf"))

    def forget_link(self, worker: str) -> None:
        """Takes the link to a worker for slow until it shows that it is fast."""
        self._fast_links.discard(worker)

    def forget_sent(self) -> None:
        """Forgets when jobs were sent that are over, once they are many."""
        if len(self._sent) > MAX_SENT:
            flying = {job.number for job in self._book.leases.jobs}
            for number in list(self._sent):  # a copy: the thread of the queue adds to it meanwhile
                if number not in flying:
                    del self._sent[number]

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

    def submit_many(self, jobs: Sequence[Job]) -> list[bool]:
        """Sends jobs of different objects, the most urgent first, those of small objects to one worker in one message.

        False as of `submit`.
        """
        taken = [False] * len(jobs)
        batches: dict[tuple[str, tuple[str, Method]], list[int]] = {}  # places of jobs by worker and what they share
        rooms = self._choice.rooms() if len(jobs) > 1 else {}
        able = {name for name in rooms if self._choice.takes_batches(name)}
        idle = [name for name, room in rooms.items() if room > 0]
        failing = bool(self._book.reliability.failing_objects)
        simple = len(idle) == 1 and idle[0] in able and not failing and len(jobs) <= rooms[idle[0]]
        if simple and (alike := self.alike(jobs)) is not None:
            return self._send_batches(idle[0], alike)
        sized: list[tuple[Job, AnnouncedObject, int]] = []  # by place
        last: tuple[str, str, Method] | None = None  # worker, dtype and method of the job before, by identity
        sizes: dict[tuple[int, str], int] = {}
        for place, job in enumerate(jobs):
            known = self._check(job)
            worker = self._worker_for(job, idle, rooms, failing) if idle else None
            values = self._batched_values(job, known, sizes) if worker in able else 0
            sized.append((job, known, values))
            if worker is None or not values:
                taken[place] = self.submit(job)
                rooms = self._choice.rooms()
                for (name, _), places in batches.items():
                    rooms[name] = rooms.get(name, 0) - len(places)
                idle = [name for name, room in rooms.items() if room > 0]
                continue
            rooms[worker] -= 1
            if not rooms[worker]:
                idle.remove(worker)
            if last is None or last[0] != worker or last[1] != job.dtype or last[2] is not job.method:
                last, own = (worker, job.dtype, job.method), batches.setdefault((worker, group(job)), [])
            own.append(place)
        for (worker, _), places in batches.items():
            sent = self._send_batches(worker, [sized[place] for place in places])
            for place, well in zip(places, sent, strict=True):
                taken[place] = well
        return taken

    def alike(self, jobs: Sequence[Job]) -> list[tuple[Job, AnnouncedObject, int]] | None:
        """Returns what is known of the objects of jobs, and how many values their factors have, if all of them may
        share batches, as those of many small bodies do, for which it takes less time than what `submit_many` does else.
        None: they may not."""
        objects, flying, first = self._book.decoder.objects, self._book.leases.by_object, jobs[0]
        dtype, method, sizes = first.dtype, first.method, dict[tuple[int, str], int]()
        found: list[tuple[Job, AnnouncedObject, int]] = []
        for job in jobs:
            known = objects.get(job.object)
            same = job.dtype == dtype and (job.method is method or job.method == method)
            if known is None or not same or known.epoch != job.epoch or job.object in flying:
                return None
            values, matrix = self._batched_values(job, known, sizes), job.values
            if not values or matrix.shape != (known.blocks, 3, 3) or matrix.dtype != np.float64:
                return None
            found.append((job, known, values))
        return found if len({job.object for job in jobs}) == len(jobs) else None

    def _send_batches(self, worker: str, sized: Sequence[tuple[Job, AnnouncedObject, int]]) -> list[bool]:
        sent: list[bool] = []
        for k in range(0, len(sized), MOST_TOGETHER):
            sent += self._send_batch(worker, sized[k : k + MOST_TOGETHER])
        return sent

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

    def _batched_values(self, job: Job, known: AnnouncedObject, sizes: dict[tuple[int, str], int]) -> int:
        """Returns for how many values of its factor there is room in a batch; 0 for a job that must go alone, as the
        size of its factor is not known: that of an incomplete one may grow. sizes: of what objects of a topology share,
        as far as it is known"""
        method = job.method.name
        if job.values.ndim != 3 or method == "incomplete_cholesky":
            return 0
        if method != COMPLETE or not known.complete.sizes:
            return known.most_values(method)
        key = id(known.complete), method
        if (values := sizes.get(key)) is None:
            values = sizes[key] = known.most_values(method)
        return values

    # ---- a batch ---------------------------------------------------------------------------------------------

    def _send_batch(self, worker: str, sized: Sequence[tuple[Job, AnnouncedObject, int]]) -> list[bool]:
        """Sends jobs to a worker in one message, or one by one if there are no slots for them together. sized: as of
        `entries_of`"""
        slots, leases, jobs = None, self._book.leases, [job for job, _, _ in sized]
        if len(jobs) > 1:
            entries = entries_of(sized)
            slots = self._allocate_batch(entries)
        if slots is None:
            return [self._send_alone(worker, job) for job in jobs]
        objects = [(job.object, known.blocks) for job, known, _ in sized]
        seconds, exclusive = leases.terms(objects, worker, jobs[0].method.name)
        rooms = [(entry.first, entry.room) for entry in entries]
        in_flight = self._begin(jobs, worker, seconds, slots, slots[1], rooms, exclusive=exclusive)
        message = batch_message(entries, in_flight, seconds, self._incarnation, *slots)
        filling, matrices = Filling(slots), [job.values for job in jobs]
        if self._queue.post(partial(self._fill_and_put, message, matrices, in_flight, filling)):
            self._filling.append(filling)
            self._on_sent(worker, jobs)
            return [True] * len(jobs)
        for job in in_flight:
            leases.cancel(job)
        self._give_back(slots)
        return [False] * len(jobs)

    def _fill_and_put(
        self, message: MatrixBatch, matrices: Sequence[Float64], jobs: Sequence[InFlightJob], filling: Filling
    ) -> None:  # fmt: skip
        """Copies matrices and sends them, in the thread of the queue. The slots are not lent again meanwhile."""
        slot, name = filling.slots[0], key("matrices", self._server, worker=message.worker)
        try:
            fill(message, matrices, slot)
            self._put(jobs, name, slot.payload, message.SerializeToString(), True)
        finally:
            filling.over = True

    def _allocate_batch(self, entries: Sequence[Entry]) -> tuple[Slot, Slot] | None:
        """Allocates a slot for matrices and one for factors; None if there is not enough shared memory."""
        assert self._pool is not None
        users = len(entries) + 1  # and the thread that sends them
        matrices = self._pool.lend(sum(entry.job.values.nbytes for entry in entries), users)
        factors = self._pool.lend(entries[-1].first + entries[-1].room, users)
        if matrices is not None and factors is not None:
            return matrices, factors
        for slot in filter(None, (matrices, factors)):
            for _ in range(users):
                self._pool.give_back(slot)
        return None

    # ---- a job alone -----------------------------------------------------------------------------------------

    def _send_alone(self, worker: str, job: Job) -> bool:
        if (on_device := self._lend_on_device(worker, job)) is not None:
            return self._send_on_device(worker, job, *on_device)
        matrix_slot, factor_slot = self._allocate(worker, job)
        known = self._book.decoder.objects[job.object]
        lease = self._book.leases.lease(job.object, worker, job.method.name, job.positions, known.blocks)
        slots = tuple(slot for slot in (matrix_slot, factor_slot) if slot is not None)
        payload_bytes = 0 if matrix_slot else job.values.nbytes
        (in_flight,) = self._begin([job], worker, [lease], slots, factor_slot, [(0, 0)], payload_bytes)
        message = matrix_message(in_flight, known, self._incarnation, lease, job.method)
        payload = add_values(message, job.values, matrix_slot)
        name, attachment = key("matrix", self._server, worker=worker, object=job.object), message.SerializeToString()
        if self._queue.post(lambda: self._put([in_flight], name, payload, attachment, matrix_slot is not None)):
            self._on_sent(worker, [job])
            return True
        self._book.leases.cancel(in_flight)
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
        lease = leases.lease(job.object, worker, job.method.name, blocks=known.blocks)
        (in_flight,) = self._begin([job], worker, [lease], (matrix, factor), None, [(0, 0)], device_slot=factor)
        message = matrix_message(in_flight, known, self._incarnation, lease, job.method)
        message.device_matrix.CopyFrom(matrix.message())
        if self._queue.post(partial(self._put_on_device, in_flight, job, message, matrix)):
            self._on_sent(worker, [job])
            return True
        leases.cancel(in_flight)
        return False

    def _put_on_device(self, in_flight: InFlightJob, job: Job, message: Matrix, matrix: DeviceSlot) -> None:
        """Copies a matrix within the device and sends its job, in the thread of the queue."""
        device, factor = self.device, in_flight.device_slot
        assert device is not None and factor is not None
        for slot, told in ((matrix, message.device_matrix), (factor, message.device_factor)):
            device.mark(slot, told.generation)
        device.memory.put(matrix.address, [PlacedMatrix(job.values, job.on_device)])
        name = key("matrix", self._server, worker=in_flight.worker, object=in_flight.object)
        self._put([in_flight], name, zenoh.ZBytes(b""), message.SerializeToString(), True)

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

    def _begin(
        self, jobs: Sequence[Job], worker: str, seconds: Sequence[float], slots: tuple[Slot | DeviceSlot, ...],
        factor_slot: Slot | None, rooms: Sequence[tuple[int, int]], payload_bytes: int = 0,
        device_slot: DeviceSlot | None = None, exclusive: Sequence[float] = (),
    ) -> list[InFlightJob]:  # fmt: skip
        """Begins the leases of jobs that are being sent together.

        seconds: that the worker has for each. rooms: first byte and bytes of each in the slot of the factors
        exclusive: their exclusive periods [s]; none: to be asked for
        """
        now, leases, objects = self._book.clock(), self._book.leases, self._book.decoder.objects
        latest, generation = leases.deadlines().get(worker, 0.0), factor_slot.generation if factor_slot else 0
        begun: list[InFlightJob] = []
        device_generation = device_slot.generation if device_slot else 0
        periods = exclusive or [leases.exclusive_period(job.object, objects[job.object].blocks) for job in jobs]
        for job, lease, (first, room), period in zip(jobs, seconds, rooms, periods, strict=True):
            deadline = now + max(lease, min(latest - now, BEHIND))
            latest = max(latest, deadline)
            begun.append(
                InFlightJob(
                    leases.next_number(), job.object, job.epoch, job.step, job.warp, _dtype_name(job.dtype), worker,
                    deadline, factor_slot, generation, slots, first, room, now, now + period, job.method.name,
                    payload_bytes, job.values.ndim == 2, PART_BYTES, device_slot, device_generation,
                )
            )  # fmt: skip
        leases.start_all(begun)
        return begun

    def _on_sent(self, worker: str, jobs: Sequence[Job]) -> None:
        self._book.last_worker.update((job.object, worker) for job in jobs)
        self._book.reliability.on_sent(worker, self._book.clock())
        self._counters.add("jobs", len(jobs))
        self._counters.add("bytes_out", sum(job.values.nbytes for job in jobs))

    def _put(
        self, jobs: Sequence[InFlightJob], name: str, payload: zenoh.ZBytes, attachment: bytes, shared: bool
    ) -> None:  # fmt: skip
        """Sends a job or a batch of them, in the thread of the send queue. If a link is full, zenoh drops it or blocks.

        A dropped job ends its lease. zenoh blocks only for bytes over a link that is not known to be fast, since a
        slow link takes longer than zenoh would keep them. While it blocks for one receiver all others wait too, even
        for a receiver that subscribed to everything and stopped reading. The priority is one of its own, since a
        blocked message locks the queue of its priority.
        """
        worker = jobs[0].worker
        drop = shared or worker in self._fast_links
        control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
        begin = time.perf_counter()
        self._session.put(
            name, payload, attachment=attachment, congestion_control=control, priority=zenoh.Priority.BACKGROUND
        )
        if not drop and time.perf_counter() - begin < FAST_SEND:
            self._fast_links.add(worker)
        now = self._book.clock()
        for job in jobs:
            self._sent[job.number] = now


@cache
def _dtype_name(dtype: str) -> str:
    return np.dtype(dtype).name
