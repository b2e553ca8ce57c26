# SPDX-License-Identifier: MIT
"""How long workers have for jobs, by how long their last ones took. Without network or clock; times in s."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from sim_server.arrays import Float64
from sim_server.network.jobs_in_flight import InFlightJob, JobsInFlight

MIN_LEASE = 2.0  # s
MAX_LEASE = 120.0  # s; also for the first job of an object at a worker, which may compile, import and analyse for it
LEASE_BLOCKS = 500_000  # of a matrix, above which the longest lease grows as the operations of a factor, blocks^2
MAX_DOUBLINGS = 8  # of a lease
LEASE_FACTOR = 20  # a lease is this multiple of the duration of the last factorization
EXCLUSIVE_PER_BLOCK = 1e-4  # s per block of the matrix: exclusive period of an object without any factor yet
MIN_EXCLUSIVE = 0.5  # s; least exclusive period of an object with a factor
DELIVERY = 1.0  # s in which a job that was sent reaches its worker, without the time for bytes
BUFFERED = 1 << 22  # bytes that may still be under way when a job was sent
MIN_BANDWIDTH = 1e6  # bytes/s of the slowest link


class LeaseTerms:
    """Durations of factorizations by worker and object, and the leases that follow from them."""

    def __init__(self) -> None:
        self._seconds: dict[str, dict[str, float]] = {}  # of the last factorization, by worker and object
        self._answered: dict[str, dict[tuple[str, bool], set[str]]] = {}
        """Objects by worker, and by method and whether it assembled the matrix."""
        self._doublings: dict[tuple[str, str], int] = {}  # of the lease, after expired jobs, by object and worker

    def lease(
        self, object: str, worker: str, method: str = "cholesky", positions: bool = False, blocks: int = 0
    ) -> float:
        """Time [s] that the worker has for its answer; doubled after each job that expired.

        The longest there is, MAX_LEASE and more for large matrices, for the first job of an object by a method, and the
        first that it assembles itself: it may import and compile for that.
        """
        longest = MAX_LEASE * max(1.0, (blocks / LEASE_BLOCKS) ** 2)
        if object not in self._answered.get(worker, {}).get((method, positions), ()):
            return longest
        doublings = self._doublings.get((object, worker), 0)
        return float(min(longest, max(MIN_LEASE, LEASE_FACTOR * self._seconds[worker][object]) * 2**doublings))

    def exclusive_period(self, object: str, blocks: int) -> float:
        """Time [s] in which no other worker is asked for the object, by the duration at its fastest known worker."""
        known = min((seconds[object] for seconds in self._seconds.values() if object in seconds), default=None)
        if known is None:
            return max(MIN_LEASE, EXCLUSIVE_PER_BLOCK * blocks)
        return max(MIN_EXCLUSIVE, LEASE_FACTOR * known)

    def of_all(
        self, objects: Sequence[str], blocks: Sequence[int], worker: str, method: str
    ) -> tuple[Float64, Float64]:  # fmt: skip
        """Returns `lease` and `exclusive_period` of each of some objects, whose matrices, of so many blocks each, are
        sent. The longest lease is MAX_LEASE."""
        answered = self._answered.get(worker, {}).get((method, False), set())
        if len(self._seconds) == 1 and not self._doublings and answered.issuperset(objects):  # as nearly always
            usual = LEASE_FACTOR * np.array(list(map(self._seconds[worker].__getitem__, objects)))
            return np.minimum(np.maximum(usual, MIN_LEASE), MAX_LEASE), np.maximum(usual, MIN_EXCLUSIVE)
        leases = [self.lease(object, worker, method) for object in objects]
        periods = [self.exclusive_period(*each) for each in zip(objects, blocks, strict=True)]
        return np.array(leases), np.array(periods)

    def delivery_time(self, job: InFlightJob) -> float:
        """Time [s] that a job may need to reach its worker; doubled after each job that expired."""
        doublings = self._doublings.get((job.object, job.worker), 0)
        return float((DELIVERY + min(job.payload_bytes, BUFFERED) / MIN_BANDWIDTH) * 2**doublings)

    def on_factors(self, batch: JobsInFlight, objects: Sequence[str], seconds: Sequence[float]) -> None:
        """Takes note of how long factorizations of some objects of a batch took."""
        worker, answer = batch.worker, (batch.method, batch.positions)
        self._seconds.setdefault(worker, {}).update(zip(objects, seconds, strict=True))
        self._answered.setdefault(worker, defaultdict(set))[answer].update(objects)
        if self._doublings:
            for object in objects:
                self._doublings.pop((object, worker), None)

    def on_expired(self, job: InFlightJob) -> None:
        """Takes note that a lease is over."""
        pair = job.object, job.worker
        self._doublings[pair] = min(MAX_DOUBLINGS, self._doublings.get(pair, 0) + 1)

    def forget_object(self, object: str) -> None:
        """Drops what is known of an object that has a new epoch."""
        for seconds in self._seconds.values():
            seconds.pop(object, None)
        for answered in self._answered.values():
            for objects in answered.values():
                objects.discard(object)
        self._doublings = {pair: count for pair, count in self._doublings.items() if pair[0] != object}

    def forget_worker(self, worker: str) -> None:
        """Drops what is known of a worker that left."""
        self._seconds.pop(worker, None)
        self._answered.pop(worker, None)
        self._doublings = {pair: count for pair, count in self._doublings.items() if pair[1] != worker}
