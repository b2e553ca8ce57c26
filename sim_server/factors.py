# SPDX-License-Identifier: MIT
"""Where factors come from: one interface, for workers elsewhere (link.py) and for this process (here)."""

import logging
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from protocol.method import Method

log = logging.getLogger(__name__)

EXACT = Method()


@dataclass(frozen=True)
class Job:
    """A matrix to factorize. values (blocks, 3, 3) float64, or positions (nodes, 3) [m] of which whoever takes the job
    assembles it; read during `submit` only. dtype, method: of the factor wanted."""

    object: str
    epoch: int
    step: int
    warp: bool
    values: NDArray[np.float64]
    dtype: str = "float32"
    method: Method = EXACT

    @property
    def positions(self) -> bool:
        """Without the matrix."""
        return self.values.ndim == 2


class FactorSource(Protocol):
    """Takes matrices, gives factors; nothing here waits."""

    def ready(self) -> int:
        """How many idle ones could take a job now."""
        ...

    def submit(self, job: Job) -> bool:
        """Hands a job over; False if it could not be taken."""
        ...

    def poll(self) -> list[Factor]:
        """Factors that came since the last call."""
        ...

    def failures(self) -> list[tuple[str, str]]:
        """Objects whose job came to nothing since the last call, and why."""
        ...


@runtime_checkable
class Pool(FactorSource, Protocol):
    """A source with several workers that are told apart."""

    def taken_back(self) -> list[str]:
        """Objects whose worker takes its time while another one is idle: they may be sent again at once."""
        ...

    def no_use(self, worker: str, object: str) -> None:
        """A factor of a worker was refused, or solves had to leave it."""
        ...

    def of_use(self, worker: str, object: str) -> None:
        """A solve was made with a factor of a worker."""
        ...

    def setbacks(self) -> dict[str, int]:
        """By object, jobs in a row that came to nothing with the best of its workers."""
        ...

    def reserved(self) -> set[str]:
        """Objects that are better left for a busy worker, since factors of the idle ones came to nothing."""
        ...


class Inline:
    """Factorizes in this process, during submit.

    patterns: block pattern (row_start, columns) of each object. library: as in precond_worker.factorize.Analysis.
    """

    WORKER = "in process"

    def __init__(self, patterns: dict[str, tuple[NDArray[np.int32], NDArray[np.int32]]], library: str = "auto"):
        self._patterns, self._library = patterns, library
        self._analyses: dict[tuple[str, Method], Any] = {}
        self._latest: dict[str, Method] = {}
        self._warned = False
        self._done: list[Factor] = []
        self._failed: list[tuple[str, str]] = []

    def ready(self) -> int:
        """One job at a time, always."""
        return 1

    def submit(self, job: Job) -> bool:
        """Factorizes now; the result waits for `poll`."""
        from time import perf_counter

        from precond_worker.factorize import NotPositiveDefinite  # lazily: only in-process updates need a library

        if job.positions:
            self._failed.append((job.object, "positions without a worker that could build the matrix"))
            return True
        start = perf_counter()
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
        """Library and version that makes factors of an object by a method; None: exact ones if it has had any."""
        exact = (name, EXACT) in self._analyses
        chosen = method or (EXACT if exact else self._latest.get(name, EXACT))
        return str(self._analysis(name, chosen).library)

    def _analysis(self, name: str, method: Method) -> Any:
        from precond_worker.factorize import default_library
        from precond_worker.methods import prepared

        self._latest[name] = method
        if (name, method) not in self._analyses:
            if method == EXACT and not self._warned and (message := default_library()[1]):
                self._warned = True
                log.warning("%s", message)
            self._analyses[name, method] = prepared(*self._patterns[name], method, self._library)
        return self._analyses[name, method]

    def poll(self) -> list[Factor]:
        """Factors made since the last call."""
        done, self._done = self._done, []
        return done

    def failures(self) -> list[tuple[str, str]]:
        """Matrices that were not positive definite."""
        failed, self._failed = self._failed, []
        return failed
