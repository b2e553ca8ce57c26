# SPDX-License-Identifier: MIT
"""Chooses workers: how many jobs each can take, and which of them gets the job of an object."""

from collections.abc import Callable, Mapping

from sim_server.network.batch_message import MOST_TOGETHER
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.network.leases import MAX_EXPIRED

SMALL_BLOCKS = 20_000  # of the largest matrix, if several jobs may wait at a worker
MOST_ALONE = 32  # jobs in flight at a worker while they go alone, each with slots of its own, which are slow to make
LEAST_BATCHES = 2  # full batches in flight at a worker: one is made while the next is made ready
MOST_BATCHES = 3  # the same of a fast one: another is on its way there or back, more would only grow old
QUEUE_SECONDS = 0.02  # s of factorizations that wait at a worker at most


class WorkerChoice:
    """Chooses among the workers that are available.

    shared: there is a pool of shared memory for arrays
    fetched: returns the number of jobs that a worker has done, and whose factors are being taken in
    """

    def __init__(self, book: Bookkeeping, shared: bool, fetched: Callable[[str], int]):
        self._book, self._shared, self._fetched = book, shared, fetched

    def open(self) -> list[str]:
        """Available workers with room for a job."""
        return list(self.rooms())

    def room(self, worker: str) -> int:
        """Number of jobs that a worker can take beside those it has.

        Several wait at a worker only where all objects are small and arrays are in shared memory, as many as it does
        within QUEUE_SECONDS: it then need not wait for the network after each, and may factorize them together. What it
        does together is not divided: fewer would take it as long.
        """
        return max(0, self.most_waiting(worker) - self._waiting(worker))

    def most_waiting(self, worker: str) -> int:
        """Number of jobs that may be in flight at a worker."""
        info, seconds = self._book.registry.info(worker), self._book.timing.mean_factorization(worker)
        most = 1
        small = self._book.decoder.most_blocks <= SMALL_BLOCKS and self._shared
        if info is not None and info.shared_memory and seconds is not None and small:
            most = MOST_BATCHES * MOST_TOGETHER if info.batches and self._book.decoder.most_are_sized else MOST_ALONE
            in_time, together = int(QUEUE_SECONDS / max(seconds, 1e-6)), min(info.together, MOST_TOGETHER)
            in_time = max(in_time, LEAST_BATCHES * together if together > 1 else 1)
            most = max(1, min(info.most_jobs, most, in_time))
        return most

    def rooms(self) -> dict[str, int]:
        """Room of each open worker."""
        available, now = self._book.available(), self._book.clock()
        free = {name: room for name in available if (room := self.room(name)) > 0}
        may_get_job = self._book.reliability.may_get_job
        return {name: room for name, room in free.items() if may_get_job(name, available, now)}

    def _waiting(self, worker: str) -> int:
        """Number of jobs that a worker has not done yet; those whose factors are being taken in are done."""
        return max(0, self._book.leases.count(worker) - self._fetched(worker))

    def candidates(self, idle: list[str], object: str) -> list[str]:
        """Idle workers that are not suspended for the object; all idle ones if all available workers are."""
        now, reliability = self._book.clock(), self._book.reliability
        good = {name for name in self._book.available() if not reliability.is_suspended(name, object, now)}
        return [name for name in idle if name in good] if good else idle

    def may_move(self, job: InFlightJob) -> bool:
        """True if another worker could take the object of a job in flight."""
        others = [name for name in self.open() if name != job.worker]
        return bool(self.candidates(others, job.object)) if others else False

    def assembles(self, worker: str) -> bool:
        """True if a worker can assemble matrices from positions."""
        info = self._book.registry.info(worker)
        return info is not None and info.builds

    def has_slots(self, worker: str) -> bool:
        """True if arrays may travel to and from a worker in slots of shared memory."""
        info = self._book.registry.info(worker)
        expired = self._book.leases.expired_count(worker)
        return self._shared and info is not None and info.shared_memory and expired < MAX_EXPIRED

    def shares_device(self, worker: str) -> bool:
        """True if a worker opens device memory of this server: only one on this host, of the same user, is asked to."""
        info = self._book.registry.info(worker)
        return info is not None and info.device_memory and self.has_slots(worker)

    def takes_batches(self, worker: str) -> bool:
        """True if several jobs of a worker that has room for them may share a message: it has only where all objects
        are small."""
        info = self._book.registry.info(worker)
        return info is not None and info.batches and self.has_slots(worker)

    def choose(self, idle: list[str], object: str, rooms: Mapping[str, int] | None = None) -> str:
        """Chooses the worker with the fewest expired jobs; then the one that would be done first, the one with the
        fewest jobs in flight, the last of the object, the least used.

        rooms: jobs that workers can take besides those that are about to be sent; None: none is
        """
        if len(idle) == 1:
            return idle[0]
        book = self._book

        def rank(name: str) -> tuple[int, float, int, bool, int]:
            info, waiting = book.registry.info(name), self._waiting(name)
            waiting += 0 if rooms is None else self.room(name) - rooms[name]
            expired, expected = book.leases.expired_count(name), book.timing.expected(name, object)
            other = book.last_worker.get(object) != name
            return expired, (1 + waiting) * expected, waiting, other, info.jobs if info else 0

        return min(idle, key=rank)

    def faster_busy_workers(self) -> int:
        """Number of busy workers that would finish one more job before the fastest idle one could."""
        now, book = self._book.clock(), self._book
        idle = [(name, now - book.free_since.get(name, 0.0)) for name in self.open()]
        if not idle or len(idle) == len(book.available()):
            return 0
        full = {name for name in book.leases.by_worker if not self.room(name)}
        busy = [(j.worker, j.object, now - j.sent_at) for j in book.leases.jobs if j.worker in full]
        return book.timing.faster_busy_workers(idle, busy)

    def reserved(self) -> set[str]:
        """Objects that are better left for a busy worker, since factors by the idle ones failed."""
        failing = self._book.reliability.failing_objects
        idle = self.open() if failing else []
        return {object for object in failing if idle and not self.candidates(idle, object)}

    def consecutive_failures(self) -> dict[str, int]:
        """Jobs in a row that failed at the best worker of each object."""
        failing = self._book.reliability.failing_objects
        available = self._book.available() if failing else []
        return {object: self._book.reliability.consecutive_failures(available, object) for object in failing}
