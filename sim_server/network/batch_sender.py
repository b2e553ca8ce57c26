# SPDX-License-Identifier: MIT
"""Sends jobs of several small objects to a worker in one message, by columns."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from protocol.channels import key
from protocol.messages_pb2 import MatrixBatch
from protocol.method import COMPLETE
from protocol.shared_memory.pool import Slot, SlotPool
from sim_server.network.batch_message import MOST_TOGETHER, BatchLayout, batch_message, fill
from sim_server.network.jobs_in_flight import JobsInFlight
from sim_server.network.sending import Sending
from sim_server.updates.factor_source import Job
from sim_server.updates.jobs_together import JobsTogether


@dataclass
class Filling:
    """Slots of a batch that the thread of the queue fills and sends; `over` once it has."""

    slots: tuple[Slot, Slot]
    over: bool = False


class BatchSender:
    """Sends batches, with slots of shared memory for all matrices and all factors of each.

    pool: shared memory; None: there is none, and no batches
    send_alone: sends a job to a worker, as of JobSender
    """

    def __init__(self, sending: Sending, pool: SlotPool | None, send_alone: Callable[[str, Job], bool]):
        self._sending, self._pool, self._send_alone = sending, pool, send_alone
        self._filling: deque[Filling] = deque()  # oldest first

    def give_back_sent(self) -> None:
        """Gives back slots that the thread of the queue needs no more: they are free once their jobs are over, too."""
        while self._filling and self._filling[0].over:
            self._give_back(self._filling.popleft().slots)

    def _give_back(self, slots: Sequence[Slot]) -> None:
        if self._pool is not None:
            for slot in slots:
                self._pool.give_back(slot)

    def layout_of(self, jobs: JobsTogether) -> BatchLayout | None:
        """Returns the layout of jobs if all of them may share batches, as those of many small bodies do; None: they may
        not."""
        objects, flying = self._sending.book.decoder.objects, self._sending.book.leases.by_object
        if not flying.keys().isdisjoint(jobs.objects) or len(set(jobs.objects)) < len(jobs):
            return None
        first, method = objects.get(jobs.objects[0]), jobs.method.name
        alike = first is not None and method == COMPLETE and bool(first.complete.sizes)
        if first is not None and alike and list(map(first.complete.epochs.get, jobs.objects)) == jobs.epochs:
            told = BatchLayout.of_alike(first, len(jobs), jobs.dtype)
        else:
            known = [each for each in map(objects.get, jobs.objects) if each is not None]
            if [each.epoch for each in known] != jobs.epochs:
                return None
            told = BatchLayout.of(known, method, jobs.dtype)
        return told if told.blocks == jobs.blocks and told.rooms.all() else None

    def send(self, worker: str, jobs: JobsTogether, told: BatchLayout) -> list[bool]:
        """Sends jobs to a worker in as few messages as they fit into, each of about as many."""
        if (messages := -(-len(jobs) // MOST_TOGETHER)) == 1:
            return self._send(worker, jobs, told)
        each = -(-len(jobs) // messages)
        parts = [slice(k, k + each) for k in range(0, len(jobs), each)]
        return [sent for part in parts for sent in self._send(worker, jobs[part], told.part(part))]

    def _send(self, worker: str, jobs: JobsTogether, told: BatchLayout) -> list[bool]:
        """Sends jobs to a worker in one message, or one by one if there are no slots for them together."""
        sending, terms = self._sending, self._sending.book.leases.terms
        slots = self._allocate(told) if len(jobs) > 1 else None
        if slots is None:
            return [self._send_alone(worker, job) for job in jobs]
        seconds, periods = terms.of_all(jobs.objects, told.blocks, worker, jobs.method.name)
        batch = sending.begin(worker, jobs, seconds, periods)
        batch.first, batch.rooms, batch.bodies = told.first, told.rooms, jobs.bodies
        batch.matrices, batch.matrices_at = jobs.values, jobs.at
        batch.slots, batch.factor_slot, batch.factor_generation = slots, slots[1], slots[1].generation
        message = partial(batch_message, batch, told, seconds.tolist(), jobs.method, sending.incarnation, *slots)
        send = partial(self._fill_and_put, message, batch, filling := Filling(slots))
        if sending.post(batch, 72 * sum(told.blocks), send):
            self._filling.append(filling)
            return [True] * len(jobs)
        self._give_back(slots)
        return [False] * len(jobs)

    def _fill_and_put(self, message: Callable[[], MatrixBatch], batch: JobsInFlight, filling: Filling) -> None:
        """Makes the message of a batch, copies its matrices and sends them, in the thread of the queue. The slots are
        not lent again meanwhile."""
        slot, name = filling.slots[0], key("matrices", self._sending.server, worker=batch.worker)
        try:
            fill(made := message(), batch.matrices_at, slot)
            self._sending.put(batch, name, slot.payload, made.SerializeToString(), True)
        finally:
            filling.over = True

    def _allocate(self, told: BatchLayout) -> tuple[Slot, Slot] | None:
        """Allocates a slot for matrices and one for factors; None if there is not enough shared memory."""
        if self._pool is None:
            return None
        users = len(told.blocks) + 1  # and the thread that sends them
        matrices = self._pool.lend(72 * sum(told.blocks), users)
        factors = self._pool.lend(told.bytes, users)
        if matrices is not None and factors is not None:
            return matrices, factors
        for slot in filter(None, (matrices, factors)):
            self._pool.give_back(slot, users)
        return None
