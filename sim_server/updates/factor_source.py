# SPDX-License-Identifier: MIT
"""The interface of everything that makes factors: remote workers (network/dispatch.py) or this process (Inline)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from protocol.method import Method
from sim_server.arrays import Float64, Int32
from sim_server.backends.factors_together import FactorsTogether
from sim_server.updates.patterns import Patterns
from sim_server.updates.take_in import BeginCheck

if TYPE_CHECKING:
    from precond_worker.factorization.registry import Factorization

EXACT = Method()
FactorMemory = Callable[[int, np.dtype[Any]], NDArray[Any]]


@dataclass(eq=False, slots=True)
class Job:
    """A matrix to factorize, which does not change: not frozen, since that takes three times as long to make.

    values: float64, blocks of the matrix (blocks, 3, 3), or positions (nodes, 3) [m] from which the worker assembles
        it; read during `submit`, or until the job is over
    warp: the matrix is in the material frame
    dtype, method: of the factor to be made
    on_device: address of the same values in memory of the device of the simulation; 0: there is none
    """

    object: str
    epoch: int
    step: int
    warp: bool
    values: Float64
    dtype: str = "float32"
    method: Method = EXACT
    on_device: int = 0

    @property
    def positions(self) -> bool:
        """True if `values` are positions and the worker assembles the matrix."""
        return self.values.ndim == 2


class FactorSource(Protocol):
    """Takes matrices and returns their factors. No method waits.

    A source derives from this class and defines the four abstract methods. The others have bodies for a source that
    is one worker in this process; a pool of workers replaces them.
    """

    def round(self) -> AbstractContextManager[None]:
        """Takes in what has arrived at the begin of a round of calls, and nothing more within it."""
        return nullcontext()

    @abstractmethod
    def ready(self) -> int:
        """Number of jobs that idle workers could take now."""

    @abstractmethod
    def submit(self, job: Job) -> bool:
        """Hands a job over; False if no worker could take it."""

    def submit_many(self, jobs: Sequence[Job]) -> list[bool]:
        """Hands jobs of different objects over, the most urgent first; False for those that no worker could take."""
        return [self.submit(job) for job in jobs]

    @abstractmethod
    def poll(self) -> list[Factor]:
        """Returns the factors that arrived since the last call."""

    def poll_together(self) -> list[FactorsTogether]:
        """Returns those of them that came in messages of several; the next `poll` returns the others."""
        return []

    @abstractmethod
    def failures(self) -> list[tuple[str, str]]:
        """Returns (object, reason) of the jobs that ended without a factor since the last call."""

    def patterns(self) -> list[tuple[str, FactorPattern]]:
        """Returns (object, pattern) of the factors that will come, as far as it is new since the last call."""
        return []

    def use_memory(self, memory: FactorMemory) -> None:
        """Has large factors that arrive put into arrays that `memory` makes, of their number of values and type."""
        return

    def check_with(self, begin: BeginCheck) -> None:
        """Has factors that are taken in beside the caller checked there."""
        return

    def worker_count(self) -> int:
        """Number of workers that may be given jobs, idle or busy."""
        return 1

    def queues_jobs(self) -> bool:
        """True if workers have several jobs at a time, so that none waits for the next one to travel."""
        return False

    def epoch(self, name: str) -> int | None:
        """Returns the epoch of an object whose jobs it takes; None: of all."""
        return None

    def assembles_matrices(self) -> bool:
        """True if there are workers and all of them can assemble matrices from positions."""
        return False

    def faster_busy_workers(self) -> int:
        """Number of busy workers that would finish one more job before the fastest idle one could: as many of the most
        urgent objects are better left for them."""
        return 0

    def reassigned(self) -> list[str]:
        """Objects whose job was taken from a slow worker since another one is idle; they may be submitted again."""
        return []

    def reserved(self) -> set[str]:
        """Objects that are better left for a busy worker, since factors by the idle ones failed."""
        return set()

    def consecutive_failures(self) -> Mapping[str, int] | None:
        """Jobs in a row that failed at the best worker of each object (0 where absent). None: the source does not tell
        workers apart, and all failures of an object count."""
        return None

    def factor_failed(self, worker: str, object: str, pattern: int | None = None) -> None:
        """Notes that a factor made by `worker` was rejected, or that solves had to abandon it. pattern: its id, if it
        was rejected"""
        return

    def factor_helped(self, worker: str, object: str) -> None:
        """Notes that a solve converged with a factor made by `worker`."""
        return


class Inline(FactorSource):
    """Factorizes in this process, during `submit`.

    patterns: block pattern (row_start, columns) of the matrix of each object, or those of all epochs
    library: as in precond_worker.factorization.factorize.Analysis
    """

    WORKER = "in process"

    def __init__(self, patterns: Patterns | Mapping[str, tuple[Int32, Int32]], library: str = "auto"):
        self._patterns = patterns if isinstance(patterns, Patterns) else Patterns(patterns)
        self._library = library
        self._analyses: dict[tuple[str, Method], tuple[int, Factorization]] = {}  # and their epochs
        self._epochs: dict[str, int] = {}  # of the last job
        self._latest: dict[str, Method] = {}
        self._done: list[Factor] = []
        self._failed: list[tuple[str, str]] = []

    def ready(self) -> int:
        """Returns 1: `submit` always takes a job."""
        return 1

    def submit(self, job: Job) -> bool:
        """Factorizes the matrix and keeps the factor until `poll`."""
        from time import perf_counter

        from precond_worker.factorization.factorize import (
            NotPositiveDefinite,  # lazily: only in-process updates need a library
        )

        if job.positions:
            self._failed.append((job.object, "positions without a worker that could build the matrix"))
            return True
        start = perf_counter()
        self._epochs[job.object] = job.epoch
        analysis = self._analysis(job.object, job.method)
        try:
            values = analysis.factorize(job.values, np.dtype(job.dtype))
        except (NotPositiveDefinite, ValueError) as error:
            self._failed.append((job.object, str(error)))
            return True
        seconds = perf_counter() - start
        made = (self.WORKER, seconds, analysis.remedy)
        self._done.append(Factor(job.object, job.epoch, job.step, job.warp, analysis.pattern, values, *made))
        return True

    def library(self, name: str, method: Method | None = None) -> str:
        """Name and version of the library that makes factors of an object by `method`. None: of its exact factors if it
        has had any, else of its latest ones."""
        exact = (name, EXACT) in self._analyses
        chosen = method or (EXACT if exact else self._latest.get(name, EXACT))
        return str(self._analysis(name, chosen).library)

    def _analysis(self, name: str, method: Method) -> Factorization:
        from precond_worker.factorization.registry import make_factorization

        self._latest[name] = method
        epoch = self._epochs.get(name, 1)
        if (name, method) not in self._analyses or self._analyses[name, method][0] != epoch:
            made = make_factorization(*self._patterns.at(name, epoch), method, self._library)
            self._analyses[name, method] = epoch, made
        return self._analyses[name, method][1]

    def poll(self) -> list[Factor]:
        """Returns the factors made since the last call."""
        done, self._done = self._done, []
        return done

    def failures(self) -> list[tuple[str, str]]:
        """Returns (object, reason) of matrices that could not be factorized since the last call."""
        failed, self._failed = self._failed, []
        return failed
