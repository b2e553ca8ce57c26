# SPDX-License-Identifier: MIT
"""Solves with the inverse of a factor rounded as a GPU stores it."""

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.backends.gpu.inverse.plan import plan
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.reference.partitioned import Application, stored
from tests.reference.pcg import pcg
from tests.scenes import factor_of


def iterations_by_digits(sim: Simulation, steps: int, most: int) -> tuple[list[int], FactorPattern, NDArray]:
    """Iterations of CG for the step after `steps`, at most `most`, with the factor of its own matrix in 11 and in 22
    binary digits; and this factor: pattern and values."""
    Driver(sim).advance(steps)
    sim.engine.assemble()
    (pattern, values), b = factor_of(sim, dtype=np.float32), sim.system.b_material.ravel()
    found = []
    for planes in (1, 2):
        p = plan(pattern, 16, planes=planes)
        apply = Application(p, *stored(pattern, values, p, np.float16))
        found.append(len(pcg(sim.matrix(), b, apply, 1e-6, most)) - 1)
    return found, pattern, values
