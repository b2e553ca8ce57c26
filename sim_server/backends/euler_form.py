# SPDX-License-Identifier: MIT
"""Steps of backward Euler, which single bodies take in scenes of other schemes, as input of an engine.

A body takes such a step where it touches something (docs/contact.md), and where the stages of ros2 come to too large an
estimate (mechanics/rosenbrock.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch


@dataclass(frozen=True)
class EulerForm:
    """Input of steps of backward Euler in a scene of another scheme.

    assemble: launches that assemble such a step
    detect: launches that detect contacts, which all schemes list among those that assemble; empty without contact
    settle: launches after the solve that make the forces on holders; empty without holders
    restore: nodal kernel that goes back to the start of the step, with what backward Euler is assembled from
    advance: nodal kernel of the end of the step, with what the next step of the scheme itself is assembled from
    parts: (bodies + 1,) first item of each body, by id of a launch; None if a launch does not tell bodies apart
    start_x [m], start_v [m/s]: (n, 3) state at the start of the step, which `restore` reads
    before, earlier: (n, 3) x at the start of the last step, and of the one before [m]; `restore` reads the latter
    diagonal: (n,) what masses and springs put onto the diagonal of A [kg]
    block_scale: (bodies,) of the stiffness in A of backward Euler over that of the scheme
    coefficients: (2,) force_coefficient and dx_dv [s] of the step under way, read by launches whose arguments change
        while steps run
    euler_coefficients: the same of backward Euler
    """

    assemble: Sequence[Launch]
    detect: Sequence[Launch]
    settle: Sequence[Launch]
    restore: Launch
    advance: Launch
    parts: Mapping[int, Int32 | None]
    start_x: Float64
    start_v: Float64
    before: Float64
    earlier: Float64
    diagonal: Float64
    block_scale: Float64
    coefficients: Float64
    euler_coefficients: tuple[float, float]

    @property
    def launches(self) -> list[Launch]:
        """All launches beside those of the scheme itself."""
        return [*self.assemble, *self.settle, self.restore, self.advance]
