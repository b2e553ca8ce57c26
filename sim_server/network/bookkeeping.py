# SPDX-License-Identifier: MIT
"""What is known of workers, of jobs in flight and of objects. Without network."""

from collections.abc import Callable
from dataclasses import dataclass, field

from protocol.messages_pb2 import Topology
from sim_server.network.factor_decoder import FactorDecoder
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.network.leases import Leases
from sim_server.network.worker_registry import WorkerRegistry
from sim_server.network.worker_reliability import WorkerReliability
from sim_server.network.worker_timing import WorkerTiming


@dataclass
class Bookkeeping:
    """Workers, jobs and objects together, so that what is over is forgotten everywhere.

    clock: monotonic time [s]
    last_worker: by object: the worker that knows its pattern already
    free_since: by worker: time of its last answer [s, monotonic]
    answered_at: likewise, of its last answer with a factor
    failures: (object, reason) of jobs that came to nothing, until they are told
    """

    registry: WorkerRegistry
    leases: Leases
    timing: WorkerTiming
    reliability: WorkerReliability
    decoder: FactorDecoder
    clock: Callable[[], float]
    last_worker: dict[str, str] = field(default_factory=dict)
    free_since: dict[str, float] = field(default_factory=dict)
    answered_at: dict[str, float] = field(default_factory=dict)
    failures: list[tuple[str, str]] = field(default_factory=list)

    def available(self) -> list[str]:
        """Workers that may be given jobs."""
        return self.registry.available(self.clock(), self.leases.deadlines())

    def fail(self, job: InFlightJob, why: str) -> None:
        """Notes that a job came to nothing."""
        self.failures.append((job.object, f"factorization of {job.object} at step {job.step} {why}"))

    def announce(self, topology: Topology) -> None:
        """Begins a new epoch of an object: forgets what was known of the last one."""
        name = topology.header.object
        if (job := self.leases.by_object.get(name)) is not None:
            self.fail(job, "was of a mesh that was split since")
        self.decoder.announce(topology)
        self.leases.forget_object(name)
        self.timing.forget_object(name)
        self.reliability.forget_object(name)

    def remove_worker(self, name: str) -> int:
        """Forgets a worker that left, or whose name another process has now; returns the number of its jobs, which
        are lost."""
        lost = self.leases.remove_worker(name)
        self.timing.forget_worker(name)
        self.reliability.forget_worker(name)
        self.free_since.pop(name, None)
        self.answered_at.pop(name, None)
        for job in lost:
            self.fail(job, f"was lost with worker {name}")
        return len(lost)
