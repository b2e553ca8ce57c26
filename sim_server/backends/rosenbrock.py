# SPDX-License-Identifier: MIT
"""The Rosenbrock-W step as input of an engine (method: mechanics/rosenbrock.py)."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.declarations import Declarations

FORMS = Declarations("kernels/step_form.h").enumeration("StepForm")
"""Forms of a step by name; the numbers stand in the column `form` of the step record."""


NODAL = ("second", "finish", "prepare", "remember", "restore")


@dataclass(frozen=True)
class Rosenbrock:
    """Input of the Rosenbrock-W step; steps of backward Euler have their own (euler_form.py).

    first: launches that evaluate the forces of the first stage and the frames of the nodes, without A
    again: launches that evaluate the forces of the second stage
    end: launches after `finish`, of the forces on holders
    held_moves: (bodies,) 1 where a holder moves in the step, which the first launches set: such a body iterates
    second, finish: nodal kernels after the first and after the second solve
    prepare: nodal kernel that makes what the next step is assembled from, from v
    remember: nodal kernel that keeps the nodes' own blocks of A of a step that iterates, for steps without A
    restore: nodal kernel of an attempt that is made again
    parts: (bodies + 1,) first item of each body, by id of a launch; None if a launch does not tell bodies apart
    factor_alone: whether the factor may take the place of A
    estimate: (n,) of the last attempt [m]
    mass [kg], share, weight, diagonal [kg]: (n,) of the check of the first stage (kernels/step_form.h)
    start_x [m], start_v [m/s], b [N s], inertial_increment [m/s]: (n, 3); unheld: (bodies,) 1 where no node is fixed:
        of the momenta of free bodies (kernels/rigid_motion.h)
    bound: (bodies,) largest estimate of a step that is not made again [m]
    """

    first: Sequence[Launch]
    again: Sequence[Launch]
    end: Sequence[Launch]
    held_moves: Int32
    second: Launch
    finish: Launch
    prepare: Launch
    remember: Launch
    restore: Launch
    parts: dict[int, Int32 | None]
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

    @property
    def launches(self) -> list[Launch]:
        """All launches beside those of `assemble`."""
        nodal = [getattr(self, name) for name in NODAL]
        return [*self.first, *self.again, *self.end, *nodal]
