# SPDX-License-Identifier: MIT
"""Jobs in flight for tests of what becomes of them."""

from typing import Any

import numpy as np

from sim_server.network.jobs_in_flight import InFlightJob, JobsInFlight


def batch_in_flight(
    numbers: range, objects: list[str], epoch: int, step: int, dtype: str, worker: str, deadline: float, **others: Any
) -> JobsInFlight:
    """Jobs of one message, whose exclusive periods are over at 0. others: attributes of JobsInFlight."""
    count = len(objects)
    made = JobsInFlight(
        worker, dtype, others.pop("method", "cholesky"), numbers, objects, [epoch] * count, [step] * count,
        [True] * count, np.full(count, deadline), np.zeros(count),
    )  # fmt: skip
    made.first = made.rooms = np.zeros(count, np.int64)
    for name, value in others.items():
        setattr(made, name, value)
    return made


def in_flight(
    number: int, object: str, epoch: int, step: int, dtype: str, worker: str, deadline: float, **others: Any
) -> InFlightJob:
    """A job alone."""
    made = batch_in_flight(range(number, number + 1), [object], epoch, step, dtype, worker, deadline, **others)
    return made.jobs[0]
