# SPDX-License-Identifier: MIT
"""What an engine needs to know for several linearizations a step (kernels/newton_line_search.cuh)."""

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from sim_server.arrays import Int32
from sim_server.scene.integrator_options import IntegratorOptions


class Newton:
    """Input of the search for the state at the end of a step.

    options: of the scene
    reach: derivative dx / dv [s] of positions by velocities at the end of the step
    parts: (bodies + 1,) first item of each body in each assembling launch; None if a launch does not tell bodies apart
    arrays: rotation (n, 3, 3), mass (n,), beta (n,), ahead, drift, carried (n, 3)
    """

    def __init__(
        self, options: IntegratorOptions, reach: float, parts: Sequence[Int32 | None], **arrays: NDArray[Any]
    ):  # fmt: skip
        self.options, self.reach, self.parts, self.arrays = options, reach, parts, arrays
