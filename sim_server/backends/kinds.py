# SPDX-License-Identifier: MIT
"""Numbers of kernels/kinds.h, kernels/error_estimate.cuh and kernels/energy_balance.cuh by name."""

from enum import IntEnum, auto

from sim_server.backends.declarations import Declarations

KINDS = Declarations("kernels/kinds.h")
_estimate = Declarations("kernels/error_estimate.cuh")
WARPED_TRUST: float = _estimate.constant("WARPED_TRUST")
FACTOR_TRUST: float = _estimate.constant("FACTOR_TRUST")
_balance = Declarations("kernels/energy_balance.cuh")
ON_RUNAWAY = _balance.enumeration("OnRunaway")
SLACK_OF_ENERGY: float = _balance.constant("SLACK_OF_ENERGY")


class Kind(IntEnum):
    """Preconditioners that the loop can apply. The numbers are those of kernels/kinds.h."""

    @staticmethod
    def _generate_next_value_(name: str, start: int, count: int, last_values: list[int]) -> int:
        return KINDS.enumeration("Kind")[name]

    NONE = auto()
    JACOBI = auto()
    BLOCK_JACOBI = auto()
    CHOLESKY = auto()  # and any other factor
    SSOR = auto()  # by sweeps over the present matrix
