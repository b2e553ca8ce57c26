# SPDX-License-Identifier: MIT
"""How far a solve got before it converged or was cut off: its cost alone does not rate it."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol import messages_pb2 as pb
from sim_server.scene.solver_options import SolverOptions

MIN_DECADES = 0.01  # decades of the residual; a smaller reduction counts as this one


class Convergence(NamedTuple):
    """How far a solve got.

    shortfall: 0 if it converged, else the decades of the residual that were wanted by those gained, 1 or more
    used: part of the iterations or of the time allowed that it took
    """

    shortfall: float
    used: float


CONVERGED = Convergence(0.0, 0.0)


def convergence(
    records: NDArray[Any], solver: SolverOptions, position: ArrayLike = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns shortfall and used (Convergence) of solves (records of a loop, of any shape).

    position: largest error of a node's position that was asked for [m], of the records' shape; 0: none. Where the error
    that is left is known as well, it tells the decades that were wanted.

    In a step with several linear solves the largest residual counts, and the mean use. A step whose nonlinear equation
    is not solved (MAX_LINEARIZATIONS, CONTACT) counts as converged, since its linear solves are.
    """
    solves = np.maximum(records["linearizations"], 1)
    converged = np.isin(records["status"], (pb.CONVERGED, pb.MAX_LINEARIZATIONS, pb.CONTACT))
    decades = max(-math.log10(solver.tolerance), MIN_DECADES)
    residual = np.where(records["residual"] > 0, records["residual"], 1.0)  # NaN counts as 1
    gained = np.clip(-np.log10(residual), MIN_DECADES, decades)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.log10(
            records["solve_error"] / np.asarray(position)
        )  # decades of the error; NaN or infinite: not known
    wanted = np.where(np.isfinite(left), gained + np.maximum(left, 0.0), decades)
    used = records["iterations"] / (solves * solver.max_iterations)
    if solver.budget:
        used = np.maximum(used, records["solve"] / (solves * solver.budget))
    if solver.step_budget:
        used = np.maximum(used, records["solve"] / solver.step_budget)
    return np.where(converged, 0.0, wanted / gained), used
