# SPDX-License-Identifier: MIT
"""Newton-Raphson as input of an engine (method: kernels/newton_line_search.cuh)."""

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from sim_server.arrays import Int32
from sim_server.scene.integrator_options import IntegratorOptions


class Newton:
    """Input of Newton-Raphson: options, and arrays of the state and the system.

    options: of the scene
    dx_dv: derivative dx / dv [s] of positions by velocities at the end of the step
    parts: (bodies + 1,) first item of each body in each assembling launch; None if a launch does not tell bodies apart
    detect: numbers of the launches that detect contacts, which run once a step
    arrays: rotation (n, 3, 3), mass (n,), beta (n,), predictor, damping_velocity, inertial_increment (n, 3)
    """

    def __init__(
        self, options: IntegratorOptions, dx_dv: float, parts: Sequence[Int32 | None], detect: slice,
        **arrays: NDArray[Any],
    ):  # fmt: skip
        self.options, self.dx_dv, self.parts, self.detect, self.arrays = options, dx_dv, parts, detect, arrays
