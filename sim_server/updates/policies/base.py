# SPDX-License-Identifier: MIT
"""What the driver asks of an update policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

from protocol.factor import Factor
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.factor_source import Job
from sim_server.updates.scheduler import Flags, UpdateRequests

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver


class UpdatePolicy(ABC):
    """Decides which matrix is factorized when, and when its factor is used.

    driver: runs the simulation
    n: number of steps in the name of the policy; 0: it has none
    """

    free = False  # True: no step waits for a factor, so that the loop may run on its own with `pump` beside it
    renews = True  # a factor is followed by another one, so that a useless one may be dropped

    def __init__(self, driver: Driver, n: int = 0):
        self.driver, self.n = driver, n

    @abstractmethod
    def step(self) -> None:
        """Makes one step, with the exchange of factors before and after it; none if the loop was stopped."""

    @abstractmethod
    def wants(self, requests: UpdateRequests, step: int) -> Flags:
        """True where the matrix of a body at a step is to be factorized."""

    @abstractmethod
    def max_age(self) -> int:
        """Returns the age [steps] that no factor exceeds while all goes well; -1: no bound is known."""

    def on_factors(self, factors: Sequence[Factor]) -> None:
        """Takes factors that have arrived: uses them or keeps them for later."""
        self.driver.adopt(factors)

    def on_job_end(self) -> None:
        """Takes note that an object may be sent again, as its job has brought a factor or failed."""
        return

    def take_back(self, jobs: Sequence[Job]) -> None:
        """Takes the jobs that were in flight when the run was saved."""
        return

    def pump(self) -> None:
        """Takes up factors and sends matrices beside a loop that runs on its own."""
        return

    def expected_latency(self, state: BodyUpdateState) -> float:
        """Returns the steps after which the factor of a matrix is expected."""
        return state.factors.latency.value or 0.0

    def waiting_cost(self, factorization: float) -> float:
        """Returns what falls to each solve of the cost of a factorization, where steps wait for it."""
        return 0.0
