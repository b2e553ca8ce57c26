# SPDX-License-Identifier: MIT
"""How far solves came, which is what they must be judged by beside their cost."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.scene.solver_options import SolverOptions

LEAST = 0.01  # decades: what gained less is not told from what gained nothing


class Reached(NamedTuple):
    """lack: 0 where a solve converged, else the decades of the residual wanted by those gained, 1 or more.
    used: part of the iterations or the time allowed that it took."""

    lack: float
    used: float


CONVERGED = Reached(0.0, 0.0)


def reached(records: NDArray[Any], solver: SolverOptions) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """lack and used of solves (records of a loop, of any shape). In a step with several linear solves the largest
    residual counts, and the mean use; that its own equation is not solved is no fault of theirs."""
    solves = np.maximum(records["linearizations"], 1)
    converged = np.isin(records["status"], (pb.CONVERGED, pb.MAX_LINEARIZATIONS))
    wanted = max(-math.log10(solver.tolerance), LEAST)
    residual = np.where(records["residual"] > 0, records["residual"], 1.0)  # also of no number
    gained = np.clip(-np.log10(residual), LEAST, wanted)
    used = records["iterations"] / (solves * solver.max_iterations)
    if solver.budget:
        used = np.maximum(used, records["solve"] / (solves * solver.budget))
    return np.where(converged, 0.0, wanted / gained), used
