# SPDX-License-Identifier: MIT
"""A second-order step by a Rosenbrock-W method: two linear solves with one matrix, which may be an older one.

With y = (x, v), M v' = f(x, v), time step h, g = 1 - 1 / sqrt 2 and *any* matrix J, the stages

    (I - g h J) k_1 = F(y),    (I - g h J) k_2 = F(y + h k_1) - 2 k_1,    y += h (3 k_1 + k_2) / 2

are of order 2 (ROS2: Verwer, Spee, Blom and Hundsdorfer 1999), and |h (k_1 + k_2) / 2| estimates the error of the step.
With J made of a stiffness K = -df/dx and damping -alpha M - beta K, and u_j = g h times the velocity part of k_j,

    A = M (1 + g h alpha) + g h (g h + beta) K                  that of backward Euler with a time step of g h
    A u_j = g h f(x_j, v_j) + M r_j - (g h)^2 K s_j             s_1 = v,   r_1 = 0
    x_2 = x + h (v + u_1),   v_2 = v + u_1 / g                  s_2 = (1 / g - 2) u_1 - v,   r_2 = -2 u_1
    x += h (3 (v + u_1) + s_2 + u_2) / 2,   v += (3 u_1 + u_2) / (2 g),   estimate = h |v + u_1 + s_2 + u_2| / 2

The products with K vanish, since (g h)^2 K s = theta (A - (1 + g h alpha) M) s with theta = g h / (g h + beta):

    A y_j = g h f(x_j, v_j) + M (r_j + w s_j),    u_j = y_j - theta s_j,    w = theta (1 + g h alpha)

so that a solve needs A alone, or instead of it the factor of an older A, warped: whatever P is applied, it *is* the A
of the step, which keeps its order, without assembly or iterations. The spring k of a grab (effects/touch.py), which has
no damping, is in A with (g h)^2 k: of it (1 - theta) (g h)^2 k s_j remains on the right (world.predictor). Forms of a
step, of each body (kernels/step_form.h):

    FACTOR    y_j = P^-1 b_j with the warped factor. The forces of both stages tell, in every step, whether P is the A
              that it should be (step_form.h)
    ITERATE   A is assembled at x, and solved with conjugate gradients from theta s, to a residual relative to that of
              this start, which is the right-hand side of u_j
    EULER     where the estimate of ITERATE exceeds the bound of the body, or the body touches something
              (docs/contact.md): backward Euler from the start of the step

A step by FACTOR whose factor is inconsistent, or whose estimate exceeds the bound, is made again by ITERATE, and
PATIENCE steps after it, too.

After a step by stages a body without fixed nodes or springs of grabs gets the momenta that its forces make
(kernels/rigid_motion.h): the stages alone lose angular momentum of stiff bodies that turn.

A node of a holder (effects/_holders.py) has a known motion; in k_1 it has its mean velocity and acceleration of the
step, in k_2 both with the other sign, so that it ends where the holder is, and J counts how the forces change with it.

Stability: A-stable with J the slope of F, L-stable (R(infinity) = 0). With an older, warped J in place of it see
docs/bench/rosenbrock.md; without the warp it flies apart.

Sources: Verwer, Spee, Blom and Hundsdorfer, SIAM J. Sci. Comput. 20, 1999; Steihaug and Wolfbrandt, Math. Comp. 33,
1979 (W-methods); Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.7.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.backends.rosenbrock import Rosenbrock
from sim_server.mechanics.central_difference import CentralDifferenceIntegrator
from sim_server.mechanics.generalized_alpha import GeneralizedAlphaIntegrator
from sim_server.mechanics.integrator import CouplesNodes, Integrator
from sim_server.mechanics.system import System
from sim_server.mechanics.world import Body
from sim_server.scene import Scene

TEXT = "kernels/rosenbrock.cu"
BOUND = 0.1  # of the shortest edge, for the error of a step


class RosenbrockIntegrator(Integrator):
    """The launches of the stages.

    share (n,): theta; weight (n,): w; first (n, 3): u_1 [m/s]; estimate (n,) [m]; known (n, 6): the nodes' own blocks
    of the last step that iterated [kg]
    """

    has_stages = True

    def __init__(self, scene: Scene, system: System):
        super().__init__(scene, system)
        w = self.world
        counts = [b.last - b.first for b in w.bodies]

        def share(scene: Scene) -> Float64:
            return np.asarray(w.dx_dv / (w.dx_dv + np.repeat(w.damping(scene)[1], counts)))

        def weight(scene: Scene) -> Float64:
            return np.asarray(share(scene) * (1 + w.dx_dv * np.repeat(w.damping(scene)[0], counts)))

        self.share, self.weight = w.follow("rayleigh", compute=share), w.follow("rayleigh", compute=weight)
        self.first, self.estimate, self.known = np.zeros_like(w.v), np.zeros(w.nodes), np.zeros((w.nodes, 6))
        self.bound = np.array([self._bound(b) for b in w.bodies])
        limited = np.zeros(w.nodes, np.int32) if w.rollers is None else w.rollers.limited
        whole = [(w.free[b.nodes] > limited[b.nodes]).all() and "cutting" not in b.effects for b in w.bodies]
        self.unheld = np.array(whole, np.int32)  # one that may come apart has no momenta of one rigid body
        self.factor_alone = scene.uses_factor_alone
        w.backend.keep(self.share, self.weight, self.first, self.estimate, self.known)

    def _bound(self, body: Body) -> float:
        if self.options.error_bound is not None:
            return self.options.error_bound
        corners = body.mesh.rest[body.mesh.tets]
        edges = corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]]
        return BOUND * float(np.sqrt((edges**2).sum(axis=2).min())) if len(edges) else np.inf

    @property
    def error_bounds(self) -> list[float]:
        return [float(bound) for bound in self.bound]

    @property
    def still(self) -> list[Float64]:
        return [self.world.predictor, self.world.damping_velocity, self.inertial_increment]

    def begin(self, assemble: Sequence[Launch]) -> list[Launch]:
        prepare = self._stage("prepare", v=self.world.v, **self._prepared())
        return [prepare, *assemble] if self.touches else [prepare]  # detection needs the nodes' own blocks

    def advance(self) -> list[Launch]:
        return []

    def start_forces(self) -> Launch:
        """Sets b and the diagonal of A to the terms of inertia."""
        s, w = self.system, self.world
        return self._stage(
            "start", mass=w.mass, inertial_increment=self.inertial_increment, diagonal=s.diagonal, b=s.b, mean=s.mean,
            known=self.known, block=s.block,
        )  # fmt: skip

    def rotate_force(self) -> list[Launch]:
        """Takes b of the second stage into the material frame."""
        s, free = self.system, self.world.free
        rotate = self._stage(
            "rotate_force", free=free, rotation=s.rotation, b=s.b, dv=s.dv, b_material=s.b_material, y=s.y
        )
        return [*s.keep_directions(frames=False), rotate]

    def stages(
        self, assemble: Sequence[Launch], lists: Sequence[Sequence[Launch]], effects: Sequence[CouplesNodes]
    ) -> Rosenbrock:
        """Input of the step. lists: launches of the forces of both stages, and after the second."""
        w, s = self.world, self.system
        state: dict[str, Any] = {"x": w.x, "v": w.v}
        started: dict[str, Any] = {"start_x": self.start_x, "start_v": self.start_v}
        solved: dict[str, Any] = {"rotation": s.rotation, "y": s.y, "h": w.dt}
        history: dict[str, Any] = {"before": self.before, "earlier": self.earlier}
        first, again, end = lists
        found = Rosenbrock(
            first=first, again=again, end=end, held_moves=w.held_moves,
            second=self._stage("second", first=self.first, **solved, **state, **started, **self._prepared()),
            finish=self._stage(
                "finish", body=s.body, moving=s.moving, first=self.first, estimate=self.estimate,
                **history, **solved, **state, **started, **self._prepared(),
            ),
            prepare=self._stage("prepare", v=w.v, **self._prepared()),
            remember=self._stage("remember", block=s.block, known=self.known),
            restore=self._stage("restore", **state, **started, **history, **self._prepared()),
            parts={}, factor_alone=self.factor_alone, estimate=self.estimate, mass=w.mass, share=self.share,
            weight=self.weight, diagonal=s.diagonal, start_x=self.start_x, start_v=self.start_v, b=s.b,
            inertial_increment=self.inertial_increment, unheld=self.unheld, bound=self.bound,
        )  # fmt: skip
        found.parts.update(self.parts_of((*assemble, *found.launches), effects))
        return found

    def advance_euler(self) -> Launch:
        w, s = self.world, self.system
        return self._stage(
            "euler", before=self.before, rotation=s.rotation, y=s.y, h=w.dt, x=w.x, v=w.v, **self._prepared()
        )

    def _prepared(self) -> dict[str, Any]:
        return {
            "share": self.share, "weight": self.weight, "predictor": self.world.predictor,
            "damping_velocity": self.world.damping_velocity, "inertial_increment": self.inertial_increment,
            "dv": self.system.dv,
        }  # fmt: skip

    def _stage(self, kernel: str, **arguments: Any) -> Launch:
        launch: Launch = self.world.backend.module(TEXT).bind(kernel, self.world.nodes, **arguments)
        return launch


def make_integrator(scene: Scene, system: System) -> Integrator:
    """Returns the launches of the scheme that the scene names."""
    others: dict[str, type[Integrator]] = {
        "ros2": RosenbrockIntegrator, "central_difference": CentralDifferenceIntegrator,
        "generalized_alpha": GeneralizedAlphaIntegrator,
    }  # fmt: skip
    return others.get(scene.integrator.scheme, Integrator)(scene, system)
