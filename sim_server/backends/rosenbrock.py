# SPDX-License-Identifier: MIT
"""The Rosenbrock-W step as input of an engine (method: mechanics/rosenbrock.py)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.declarations import Declarations

FORMS = Declarations("kernels/step_form.h").enumeration("StepForm")
"""Forms of a step by name; the numbers stand in the column `form` of the step record."""


NODAL = ("second", "finish", "prepare", "remember", "restore", "restore_for_euler", "advance_euler")


@dataclass(frozen=True)
class Rosenbrock:
    """Input of the Rosenbrock-W step.

    first: launches that evaluate the forces of the first stage and the frames of the nodes, without A
    again: launches that evaluate the forces of the second stage
    euler: launches that assemble backward Euler
    second, finish: nodal kernels after the first and after the second solve
    prepare: nodal kernel that makes what the next step is assembled from, from v
    remember: nodal kernel that keeps the nodes' own blocks of A of a step that iterates, for steps without A
    restore, restore_for_euler, advance_euler: nodal kernels of an attempt that is made again
    parts: (bodies + 1,) first item of each body, by id of a launch; None if a launch does not tell bodies apart
    factor_alone: whether the factor may take the place of A
    estimate: (n,) of the last attempt [m]
    mass [kg], share, weight, diagonal [kg]: (n,) of the check of the first stage (kernels/step_form.h)
    start_x [m], start_v [m/s], b [N s], inertial_increment [m/s]: (n, 3); unheld: (bodies,) 1 where no node is fixed:
        of the momenta of free bodies (kernels/rigid_motion.h)
    bound: (bodies,) largest estimate of a step that is not made again [m]
    coefficients: (2,) force_coefficient and dx_dv [s], read by launches whose arguments change while steps run
    euler_coefficients: the same of backward Euler
    """

    first: Sequence[Launch]
    again: Sequence[Launch]
    euler: Sequence[Launch]
    second: Launch
    finish: Launch
    prepare: Launch
    remember: Launch
    restore: Launch
    restore_for_euler: Launch
    advance_euler: Launch
    parts: Mapping[int, Int32 | None]
    factor_alone: bool
    estimate: Float64
    mass: Float64
    share: Float64
    weight: Float64
    diagonal: Float64
    start_x: Float64
    start_v: Float64
    b: Float64
    inertial_increment: Float64
    unheld: Int32
    bound: Float64
    coefficients: Float64
    euler_coefficients: tuple[float, float]

    @property
    def launches(self) -> list[Launch]:
        """All launches beside those of `assemble`."""
        nodal = [getattr(self, name) for name in NODAL]
        return [*self.first, *self.again, *self.euler, *nodal]
