# SPDX-License-Identifier: MIT
"""Jobs of different bodies that are handed over together, by columns."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from protocol.method import Method
from protocol.shared_memory.located import addresses
from sim_server.arrays import Float64, Int64
from sim_server.updates.factor_source import Job


@dataclass(eq=False, slots=True)
class JobsTogether(Sequence[Job]):
    """Jobs of different objects whose factors are to be of one type and method: a column for each attribute of Job, in
    place of an object for each, which is made for who asks for it.

    bodies: numbers by which the sender knows the objects; None: it tells none
    values: contiguous, (blocks, 3, 3) each, at the addresses `at`
    """

    bodies: Int64 | None
    objects: list[str]
    epochs: list[int]
    steps: list[int]
    warps: list[bool]
    values: list[Float64]
    blocks: list[int]
    at: Int64
    dtype: str
    method: Method
    on_device: list[int]

    @classmethod
    def of(cls, jobs: Sequence[Job]) -> "JobsTogether":
        """Returns jobs of one type and method."""
        rows = [(job.object, job.epoch, job.step, job.warp, job.on_device) for job in jobs]
        objects, epochs, steps, warps, on_device = map(list, zip(*rows, strict=True))
        values = [np.ascontiguousarray(job.values, np.float64) for job in jobs]
        blocks = [each.nbytes // 72 for each in values]
        at, dtype, method = addresses(values).astype(np.int64), jobs[0].dtype, jobs[0].method
        return cls(None, objects, epochs, steps, warps, values, blocks, at, dtype, method, on_device)

    def __len__(self) -> int:
        return len(self.objects)

    @overload
    def __getitem__(self, k: int) -> Job: ...
    @overload
    def __getitem__(self, k: slice) -> "JobsTogether": ...
    def __getitem__(self, k: int | slice) -> "Job | JobsTogether":
        if isinstance(k, slice):
            return JobsTogether(
                None if self.bodies is None else self.bodies[k], self.objects[k], self.epochs[k], self.steps[k],
                self.warps[k], self.values[k], self.blocks[k], self.at[k], self.dtype, self.method, self.on_device[k],
            )  # fmt: skip
        return Job(
            self.objects[k], self.epochs[k], self.steps[k], self.warps[k], self.values[k], self.dtype, self.method,
            self.on_device[k],
        )  # fmt: skip

    def __iter__(self) -> Iterator[Job]:
        return (self[k] for k in range(len(self)))
