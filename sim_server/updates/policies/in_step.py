# SPDX-License-Identifier: MIT
"""Policies whose factors are made in this process, within the step that waits for them."""

import numpy as np

from sim_server.updates.policies.base import UpdatePolicy
from sim_server.updates.scheduler import Flags, UpdateRequests


class Never(UpdatePolicy):
    """One factor, of the first matrix."""

    renews = False

    def step(self) -> None:
        """Makes a step. If a matrix is wanted, it is factorized between assembly and solve."""
        engine, requests = self.driver.engine, self.driver.requests()
        if not self.wants(requests, engine.step).any():
            engine.run(1)
        elif engine.wait():
            self.driver.solve_with_fresh_factors()

    def wants(self, requests: UpdateRequests, step: int) -> Flags:
        """True at the first step."""
        return np.full(len(requests), step == 0)

    def max_age(self) -> int:
        """Returns -1: the factor is as old as the run."""
        return -1


class Every(Never):
    """A factor at each n-th step."""

    def wants(self, requests: UpdateRequests, step: int) -> Flags:
        """True at each n-th step."""
        return np.full(len(requests), step % self.n == 0)

    def max_age(self) -> int:
        """Returns n - 1."""
        return self.n - 1

    def waiting_cost(self, factorization: float) -> float:
        """Returns the cost of a factorization spread over the n steps with its factor."""
        return factorization / self.n
