# SPDX-License-Identifier: MIT
"""Jobs whose matrices of one pattern are factorized together."""

import time
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import zenoh

from precond_worker.errors import DeviceUnusable
from precond_worker.jobs.analyses import Analyses
from precond_worker.jobs.answers import Answers
from precond_worker.jobs.job import Job
from precond_worker.jobs.one_by_one import OneByOne, count_taken
from precond_worker.jobs.received_matrices import ReceivedMatrices
from precond_worker.many import Begun, Made
from precond_worker.network.server_connection import ServerConnection
from protocol.factor import FactorPattern
from protocol.refused import Refused


class JobsTogether(NamedTuple):
    """Jobs whose matrices are being factorized together, since `begun` [s]."""

    jobs: Sequence[Job]
    pattern: FactorPattern
    made: Begun
    begun: float


class Together:
    """Begins such jobs, and answers them. Those that get no factor so are done one by one."""

    def __init__(
        self, connection: ServerConnection, analyses: Analyses, answers: Answers, one_by_one: OneByOne,
        on_factorization: Callable[[float], None],
    ):  # fmt: skip
        self._connection, self._counters = connection, connection.counters
        self._analyses, self._answers, self._one_by_one = analyses, answers, one_by_one
        self._on_factorization = on_factorization
        self._last_end = 0.0  # when such jobs were done last [s]

    def begin(self, jobs: Sequence[Job]) -> JobsTogether | None:
        """Begins to factorize; None if the matrices must be factorized one by one. Raises DeviceUnusable.

        jobs: of one known pattern, with its number of blocks
        """
        known = self._analyses.known(jobs[0])
        assert known is not None
        analysis: Any = known.factorization
        begun = time.perf_counter()
        try:
            made = analysis.begin_many(ReceivedMatrices(jobs, self._connection.slots), np.dtype(jobs[0].dtype))
        except (Refused, ValueError, MemoryError):
            return None
        if made is None:
            self._analyses.changed()
            return None
        return JobsTogether(jobs, analysis.pattern, made, begun)

    def answer(self, together: JobsTogether, made: Made) -> None:
        """Answers with the factors that were made. Raises what `OneByOne.do` raises."""
        jobs = together.jobs
        now = time.perf_counter()
        seconds = (now - max(together.begun, self._last_end)) / len(jobs)  # not what was made before these
        self._last_end = now
        good = np.flatnonzero(made.good).tolist()
        for _, group in groupby(good, lambda row: jobs[row].batch or jobs[row]):
            self._answer([*group], together, made, seconds)
        if len(good) < len(jobs):
            for job, is_good in zip(jobs, made.good.tolist(), strict=True):
                if not is_good:
                    self._one_by_one.do(job)

    def _answer(self, rows: Sequence[int], together: JobsTogether, made: Made, seconds: float) -> None:
        """Answers jobs of one message, or one that came alone. rows: of them and their factors"""
        jobs = [together.jobs[row] for row in rows]
        count_taken(self._connection, jobs)
        for _ in jobs:
            self._on_factorization(seconds)
        try:
            self._answers.add_all(jobs, together.pattern, made.values, rows, seconds)
        except Refused as refusal:  # their slot was lent to somebody else
            self._counters.refuse(refusal)
        except zenoh.ZError as error:
            self._counters.trouble("unsent", f"a factor was not sent: {error}")

    def give_up(self, jobs: Sequence[Job], error: DeviceUnusable) -> None:
        """Answers jobs of a device that cannot be used any more."""
        for job in jobs:
            self._answers.add_failure(job, str(error))
