# SPDX-License-Identifier: MIT
"""Steps of bodies that ran away, made again by short ones, as input of an engine (backends/cpu/native/halving.h)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch


@dataclass(frozen=True)
class Halving:
    """Input of short steps of backward Euler, of dt / 2, dt / 4 and so on.

    assemble: launches that assemble a short step, for each halving; all lists have the same length
    advance: nodal kernel of the end of one, for each halving
    end: nodal kernel that begins the next step of the scheme; None: in backward Euler there is nothing to begin
    parts: (bodies + 1,) first item of each body, by id of a launch; None if a launch does not tell bodies apart
    coefficients: (2,) as of EulerForm
    before: (n, 3) x at the start of the last step [m]
    rotation: (n, 3, 3) frames of nodes
    scheme: (n, 3) predictor, damping_velocity and inertial_increment [m/s]; empty in backward Euler
    left: arrays (n, 3) and (n,) that a step leaves, x and v the first of them
    touched: (1,) gets the index of the body whose step is made, else it is -1
    """

    assemble: Sequence[Sequence[Launch]]
    advance: Sequence[Launch]
    end: Launch | None
    parts: Mapping[int, Int32 | None]
    coefficients: Float64
    before: Float64
    rotation: Float64
    scheme: Sequence[Float64]
    left: Sequence[Float64]
    touched: Int32

    @property
    def launches(self) -> list[Launch]:
        """All launches beside those of the scheme itself."""
        end = [] if self.end is None else [self.end]
        return [*(launch for listed in self.assemble for launch in listed), *self.advance, *end]
