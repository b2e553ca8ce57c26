# SPDX-License-Identifier: MIT
"""What all messages with jobs have in common: leases begin, the network takes them in the thread of the send queue."""

import time
from collections.abc import Callable
from functools import cache

import numpy as np
import zenoh

from protocol.counters import Counters
from sim_server.arrays import Float64
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.jobs_in_flight import JobsInFlight
from sim_server.network.send_queue import SendQueue
from sim_server.updates.jobs_together import JobsTogether

FAST_SEND = 0.05  # s in which a fast link takes a job as bytes; zenoh drops what is not taken within 0.25 s
BEHIND = 10.0  # s of a lease, at most, for what waits at a worker behind a first job, which has a longer one


class Sending:
    """Sends jobs of a server. queue: has a thread of its own, so that nobody waits for the network"""

    def __init__(
        self, session: zenoh.Session, server: str, incarnation: int, queue: SendQueue, counters: Counters,
        book: Bookkeeping,
    ):  # fmt: skip
        self._session, self.server, self.incarnation, self._queue = session, server, incarnation, queue
        self.counters, self.book = counters, book
        self._fast_links: set[str] = set()  # workers without shared memory whose link takes a job at once

    def forget_link(self, worker: str) -> None:
        """Takes the link to a worker for slow until it shows that it is fast."""
        self._fast_links.discard(worker)

    def begin(self, worker: str, jobs: JobsTogether, seconds: Float64, periods: Float64) -> JobsInFlight:
        """Makes the batch of jobs that are being sent together, still without slots.

        seconds: that the worker has for each, longer behind jobs that have longer. periods: exclusive ones [s]
        """
        now, leases = self.book.clock(), self.book.leases
        behind = np.maximum(leases.deadlines().get(worker, 0.0) - now, np.maximum.accumulate(seconds))
        deadlines = now + np.maximum(seconds, np.minimum(behind, BEHIND))
        return JobsInFlight(
            worker, _dtype_name(jobs.dtype), jobs.method.name, leases.next_numbers(len(jobs)), jobs.objects,
            jobs.epochs, jobs.steps, jobs.warps, deadlines, now + periods, now,
        )  # fmt: skip

    def post(self, batch: JobsInFlight, size: int, send: Callable[[], None]) -> bool:
        """Begins the leases of a batch and has the thread of the queue send it; False, and no lease, if that is full.

        size: bytes of its matrices. send: ends with `put`
        """
        self.book.leases.start(batch)
        if not self._queue.post(send):
            self.book.leases.cancel(batch)
            return False
        self.book.last_worker.update(dict.fromkeys(batch.objects, batch.worker))
        self.book.reliability.on_sent(batch.worker, self.book.clock())
        self.counters.add("jobs", len(batch))
        self.counters.add("bytes_out", size)
        return True

    def put(self, batch: JobsInFlight, name: str, payload: zenoh.ZBytes, attachment: bytes, shared: bool) -> None:
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
        batch.put_at = self.book.clock()


@cache
def _dtype_name(dtype: str) -> str:
    return np.dtype(dtype).name
