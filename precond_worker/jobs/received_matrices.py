# SPDX-License-Identifier: MIT
"""The matrices of jobs that are factorized together, copied or summed up in one native call for each message."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int64
from precond_worker.jobs.batch import ENTRY, Batch
from precond_worker.jobs.job import Job
from precond_worker.network.native_copies import native_copies
from protocol.refused import Refused
from protocol.shared_memory.copies import Parts
from protocol.shared_memory.view import SlotMap


class ReceivedMatrices:
    """Matrices of jobs of one pattern (many.Matrices), each `Job.is_plain`."""

    def __init__(self, jobs: Sequence[Job], slots: SlotMap):
        self.blocks = jobs[0].blocks
        self._jobs, self._slots, self._size = jobs, slots, 8 * ENTRY * self.blocks
        self._held: list[NDArray[Any]] = []

    def __len__(self) -> int:
        return len(self._jobs)

    def addresses(self) -> NDArray[np.uintp]:
        """Returns where each lies, (k,), in place if in shared memory. Raises Refused if a checksum differs."""
        found = []
        for batch, jobs in self._messages():
            parts, size, expected = self._parts(batch, jobs)
            _compare(native_copies().sum_parts(parts, size), expected)
            self._held.append(parts.array)
            found.append(parts.addresses(size))
        return np.concatenate(found)

    def copy_to(self, target: Float64) -> None:
        """Copies all to rows of `target`, (k, 9 blocks), memory of this process: the checksums are those of the copies.
        Raises Refused unless these are as told."""
        row = 0
        for batch, jobs in self._messages():
            parts, size, expected = self._parts(batch, jobs)
            rows = Parts(target, self._size * np.arange(row, row + len(jobs)))
            _compare(native_copies().copy_parts(parts, rows, size), expected)
            row += len(jobs)

    def _messages(self) -> Iterator[tuple[Batch | None, list[Job]]]:
        for batch, jobs in groupby(self._jobs, lambda job: job.batch):
            if batch is None:
                yield from ((None, [job]) for job in jobs)
            else:
                yield batch, list(jobs)

    def _parts(self, batch: Batch | None, jobs: Sequence[Job]) -> tuple[Parts, Int64, list[int]]:
        """Returns where the matrices of a message lie, the bytes of each, and their checksums as told."""
        if batch is None:
            (job,) = jobs
            return Parts(job.unchecked(self._slots), np.array([0])), np.array([self._size]), [job.message.checksum]
        places = [job.place for job in jobs]
        told, begin = batch.message.checksums, 8 * batch.starts[places]
        return Parts(batch.values(self._slots), begin), np.full(len(places), self._size), [told[p] for p in places]


def _compare(sums: Sequence[int], expected: Sequence[int]) -> None:
    if sums != expected:
        raise Refused("Matrix.checksum does not match the values: lost or overwritten", "checksum")
