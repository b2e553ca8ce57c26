# SPDX-License-Identifier: MIT
"""Explicit steps: central differences with lumped masses, in substeps of the time step.

With x, v, the lumped masses M, the forces f without damping of the mass, and a substep h::

    x_1/2 = x + h v / 2
    v'    = ((1 - c) v + h M^-1 f(x_1/2, v)) / (1 + c),   c = h alpha / 2
    x'    = x_1/2 + h v' / 2

The drifts of neighbouring substeps are one, so this is the leapfrog, x and v half a substep apart, with both at one
time where a step starts and ends: the position form of the Verlet scheme, equal to central differences of x. There is
one evaluation of the forces a substep, and no matrix, no solve and no factor. Order 2, symplectic without damping; a
free body keeps its linear and angular momentum, since the forces of an element have neither sum nor torque. The energy
of a mode of angular frequency w is kept up to a part of (h w)^2 / 4, with which its kinetic energy oscillates.

Damping of the mass (Rayleigh's alpha) is the trapezoidal rule in v: it has no limit of stability, and a body falls with
g / alpha in the end, exactly. That of the stiffness (beta) takes v of half a substep before: it is of order 1 in h, and
shortens the stable step.

Stable step. The scheme is stable for h w < 2, with w^2 the largest eigenvalue of M^-1 K, K = -df/dx, and with
z = beta w / 2 for ::

    h < (2 / w) (sqrt(1 + z^2) - z)

w comes from differences of the forces (kernels/stable_step.cuh): a power iteration at length before the first step,
and one evaluation each ESTIMATE_EVERY substeps and after new grabs, since what is deformed becomes stiffer or softer.
So it knows grabs, fibres, slivers and fixed nodes as the substeps do, where a bound by single elements is too high, or
has to know every law. All bodies of a scene have the same substeps: a step has the fewest that are shorter than SAFETY
times the least stable step, and the rest of a step has shorter ones where an estimate within it says so. What no
estimate foresaw shows as energy out of nothing: a step in which a body runs away by the criterion of the energy balance
(kernels/energy_balance.cuh) is made again with half the substep, RETRIES times, before it counts as run away.

Fixed nodes keep their place; those of holders move evenly through a step.

Sources: Belytschko, Liu, Moran and Elkhodary, Nonlinear Finite Elements for Continua and Structures, section 6.2;
Hughes, The Finite Element Method, section 9.1; Hairer, Lubich and Wanner, Geometric Numerical Integration, section I.1;
power iteration from a random start: Kuczynski and Wozniakowski, SIAM J. Matrix Anal. Appl. 13, 1992.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_server.backends.base import Launch
from sim_server.backends.central_difference import CentralDifference
from sim_server.mechanics.integrator import Integrator
from sim_server.mechanics.system import System
from sim_server.mechanics.world import Body
from sim_server.scene import Scene

TEXT = "kernels/central_difference.cu"
STRAIN = 1e-6  # of the shortest edge, of the displacements along which forces are differentiated
COARSE_STRAIN = 2e-3  # the same where elements have float32


class CentralDifferenceIntegrator(Integrator):
    """The launches of explicit substeps.

    substep (1,) [s]; start_v (n, 3): v when the step begins [m/s]; alpha (n,): damping of the mass [1/s];
    mode (n, 3): displacement of the power iteration [m]; kept_x [m], kept_force [N] (n, 3); failed (bodies,)
    """

    def __init__(self, scene: Scene, system: System):
        super().__init__(scene, system)
        w = self.world
        self.strain = STRAIN if scene.solver.precision == "float64" else COARSE_STRAIN
        self.substep, self.failed = np.full(1, w.dt), np.zeros(len(w.bodies), np.int32)
        self.shift_time = np.zeros(1)
        self.start_v, self.mode, self.kept_x, self.kept_force = (np.zeros_like(w.v) for _ in range(4))
        self.alpha = w.alpha_of_nodes()
        w.backend.keep(self.substep, self.shift_time, self.failed, self.alpha)
        w.backend.keep(self.start_v, self.mode, self.kept_x, self.kept_force)

    @property
    def still(self) -> list[np.ndarray]:
        return [self.world.predictor, self.inertial_increment]

    @property
    def carried(self) -> list[np.ndarray]:
        return [self.before, self.inertial_increment, self.mode]

    def start(self) -> Launch:
        """Begins the forces."""
        s = self.system
        return self._nodal(
            "begin", mass=self.world.mass, inertial_increment=self.inertial_increment, diagonal=s.diagonal, b=s.b,
            block=s.block,
        )  # fmt: skip

    def advance(self) -> list[Launch]:
        """Returns nothing: the substeps advance the state."""
        return []

    def begin(self, assemble: Sequence[Launch]) -> list[Launch]:
        """Returns nothing: x and v are all that a step begins with."""
        return []

    def substeps(self, held: int) -> CentralDifference:
        """Input of the substeps. held: number of launches that move holders."""
        w, s = self.world, self.system
        state: dict[str, Any] = {"x": w.x, "v": w.v}
        moved: dict[str, Any] = {"substep": self.substep, "free": w.free, "predictor": w.predictor}
        return CentralDifference(
            held=held,
            remember=self._nodal("remember", before=self.before, start_v=self.start_v, **state),
            keep=self._nodal("keep", x=w.x, b=s.b, kept_x=self.kept_x, kept_force=self.kept_force),
            displace=self._nodal("displace", kept_x=self.kept_x, mode=self.mode, x=w.x),
            open=self._nodal("open", before=self.before, start_v=self.start_v, **moved, **state),
            shift=self._nodal("shift", shift=self.shift_time, free=w.free, predictor=w.predictor, **state),
            kick=self._nodal("kick", mass=w.mass, alpha=self.alpha, b=s.b, **moved, **state),
            close=self._nodal("close", body=s.body, failed=self.failed, before=self.before, **moved, **state),
            substep=self.substep, shift_time=self.shift_time, mass=w.mass, free=w.free, force=s.b, kept_x=self.kept_x,
            kept_force=self.kept_force, mode=self.mode, failed=self.failed,
            amplitude=np.array([self.strain * _shortest_edge(b) for b in w.bodies]),
            beta=w.beta.copy(),
        )  # fmt: skip

    def _nodal(self, kernel: str, **arguments: Any) -> Launch:
        launch: Launch = self.world.backend.module(TEXT).bind(kernel, self.world.nodes, **arguments)
        return launch


def _shortest_edge(body: Body) -> float:
    """Returns the length of the shortest edge at rest [m]; without elements the body's size."""
    corners = body.mesh.rest[body.mesh.tets]
    edges = corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]]
    return float(np.sqrt((edges**2).sum(axis=2).min())) if len(edges) else float(np.ptp(body.mesh.rest, axis=0).max())
