# SPDX-License-Identifier: MIT
"""When matrices are factorized and factors used: the policies of Courtecuisse et al. 2010, sections 4 and 5.

never       one factor, made in this process from the first matrix (PCG-0)
every-N     a new one in this process each N-th step, which waits for it (PCG-1, PCG-30)
async       matrices to workers, one of an object at a time; a factor is used as it comes; nothing waits
adaptive    async, but a matrix is sent only once the excess iterations have cost as much as a factorization
lockstep-D  async, but a factor made from step t is used from step t + D on exactly: the deterministic twin
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim_server.updates.policies.base import UpdatePolicy
from sim_server.updates.policies.free_running import Adaptive, Async
from sim_server.updates.policies.in_step import Every, Never
from sim_server.updates.policies.lockstep import Lockstep

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver

POLICIES: dict[str, type[UpdatePolicy]] = {
    "never": Never,
    "every": Every,
    "async": Async,
    "adaptive": Adaptive,
    "lockstep": Lockstep,
}


def make_policy(driver: Driver) -> UpdatePolicy:
    """Returns the policy that the scene of a driver names."""
    kind, n = driver.solver.update
    return POLICIES[kind](driver, n)
