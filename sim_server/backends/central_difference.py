# SPDX-License-Identifier: MIT
"""Explicit substeps of central differences as input of an engine (method: mechanics/central_difference.py)."""

from dataclasses import dataclass

from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch

NODAL = ("remember", "keep", "displace", "open", "shift", "kick", "close")


@dataclass(frozen=True)
class CentralDifference:
    """Launches and arrays of the substeps; the forces are the launches that assemble, but for the first `held`.

    held: number of launches that assemble and run once a step, before the substeps
    remember: nodal kernel that notes the state with which the step begins
    keep, displace: nodal kernels that keep positions and forces, and displace nodes by `mode`
    open, shift, kick, close: nodal kernels of substeps (kernels/central_difference.cu)
    substep, shift_time: (1,) [s]
    mass: (n,) [kg]; free: (n,) 1, or 0 at fixed nodes
    force: (n, 3) of the last evaluation [N]; kept_x [m], kept_force [N]: (n, 3)
    mode: (n, 3) small displacement along which forces are differentiated [m]
    failed: (bodies,) 1: the step gave no state
    amplitude [m], beta [s]: (bodies,) of the estimate of the stable step (kernels/stable_step.cuh)
    """

    held: int
    remember: Launch
    keep: Launch
    displace: Launch
    open: Launch
    shift: Launch
    kick: Launch
    close: Launch
    substep: Float64
    shift_time: Float64
    mass: Float64
    free: Float64
    force: Float64
    kept_x: Float64
    kept_force: Float64
    mode: Float64
    failed: Int32
    amplitude: Float64
    beta: Float64

    @property
    def launches(self) -> list[Launch]:
        """All launches beside those that assemble."""
        return [getattr(self, name) for name in NODAL]

    def set_bodies(self, stable: NDArray) -> None:
        """Sets an array (bodies,) of struct StableStep to what is known before the first step."""
        stable["amplitude"], stable["beta"] = self.amplitude, self.beta
