# SPDX-License-Identifier: MIT
"""What a step does before the effects and after the solve, by the scheme of the scene.

Symbols: docs/notation.md. All schemes are, with f the forces, M the lumped masses and h the time step,

    x' = X + c v',    M (v' - V) = i f(x', v')         (a prime: at the end of the step)

    scheme          c = reach    i = impulse   V                        X
    backward_euler  h            h             v                        x
    newmark         beta h / g   g h           v + h (1 - g) a          x + h v + h^2 (1/2 - beta) a - c V
    bdf2            2 h / 3      2 h / 3       v + (v - v_before) / 3   x + (x - x_before) / 3
    quasi_static    h            h             0 = f(x'), v' = (x' - x) / h

with g Newmark's gamma and a = (v' - V) / (g h) of the step before. Linearized at (x, v), with K = -df/dx, C = alpha M +
beta K, and the solution dv = v' - v,

    (M + i alpha M + i (c + beta) K) dv = i f(x, v) - i (c + beta) K drift + M carried
    carried = V - v,    ahead = (X + c v - x) / c,    drift = (c ahead + beta v) / (c + beta)

where f has all forces but beta K v, which is in drift; then v += dv, x += c (ahead + dv). So a scheme is a few numbers:
what it makes of dv for the next ahead and carried (kernels/time_integration.cu). In backward Euler ahead and drift are
v, nothing is carried, and the launches are those of kernels/nodes.cu. Newton-Raphson (kernels/newton_line_search.cuh)
linearizes again at what came out: there ahead = 0.

Order: 1, 2 (gamma = 1/2), 2. One linearization keeps it only where K is the exact slope of the forces; the usual
tangent of corotational elements is not, by as much as they are strained.

Stability with one linearization: a mode of stiffness k with k' in its place in the matrix is stable in Newmark's scheme
and BDF2 at every h if k' >= k, and grows if k' < k (backward Euler: if k' < k / 2). The usual tangent has k' < k under
tension; the exact one leaves out what compression takes from k, as springs do, and projections add to it, so k' >= k.

Sources: Newmark 1959; Hughes, The Finite Element Method, section 9.1; Hairer and Wanner, Solving Ordinary Differential
Equations II, section V.1 (BDF2); Baraff and Witkin 1998 (one linearization).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sim_server.arrays import Int32
from sim_server.backends.base import Launch
from sim_server.effects._base import Effect
from sim_server.mechanics.newton import Newton
from sim_server.mechanics.system import System
from sim_server.scene import Scene

TEXT = "kernels/time_integration.cu"


@dataclass(frozen=True)
class Parts:
    """Of what a step left, in the next ahead: of v, of ahead + dv, of dv - carried; and in the next carried."""

    keeps_v: float = 1.0
    of_v: float = 0.0
    of_way: float = 0.0
    of_gain: float = 0.0
    carries_gain: float = 0.0
    carries_dv: float = 0.0


@dataclass(frozen=True)
class First:
    """Likewise before the first step, of v and of the acceleration [s]."""

    of_v: float
    of_a: float
    carries_a: float


class Integrator:
    """The launches of a scheme. carried (n, 3) [m/s]: see above; beta (n,): damping of the stiffness at nodes [s];
    before (n, 3) [m]: x when the last step began, to which a body goes back whose forces are no numbers."""

    def __init__(self, scene: Scene, system: System):
        self.options, self.system, self.world = scene.integrator, system, system.world
        w = self.world
        self.carried = np.zeros((0 if w.plain else w.nodes, 3))
        self.beta = np.repeat(w.beta, [b.last - b.first for b in w.bodies]) if not w.plain else np.zeros(0)
        self.before = w.x.copy()
        w.backend.keep(self.carried, self.beta, self.before)
        self._parts, self._first = _coefficients(scene)

    @property
    def still(self) -> list[np.ndarray]:
        """Arrays (n, 3) beside v that are 0 where nothing moves."""
        return [] if self.world.plain else [self.world.ahead, self.world.drift, self.carried]

    def start(self) -> Launch:
        """b and A with the masses alone."""
        s, w = self.system, self.world
        if w.plain:
            return s.start(w.mass)
        if not w.inertia:
            return s.start(np.zeros(w.nodes))
        return self._bind(
            "inertia", mass=w.mass, carried=self.carried, diagonal=s.diagonal, b=s.b, block=s.block, mean=s.mean
        )

    def advance(self) -> Launch:
        """From the solution to the next state."""
        s, w = self.system, self.world
        if w.plain:
            return s.advance(self.before)
        return self._bind(
            "advance", rotation=s.rotation, y=s.y, beta=self.beta, reach=w.reach, carried=self.carried, ahead=w.ahead,
            drift=w.drift, dv=s.dv, v=w.v, x=w.x, before=self.before, **asdict(self._parts),
        )  # fmt: skip

    def begin(self, assemble: Sequence[Launch]) -> list[Launch]:
        """What makes ahead, drift and carried from x and v before the first step; assemble: the launches of a step."""
        w = self.world
        if w.plain or not w.inertia:
            return []
        state: dict[str, Any] = {"ahead": w.ahead, "drift": w.drift, "carried": self.carried}
        state |= {"v": w.v, "beta": self.beta, "reach": w.reach}
        if self._first is None:
            return [self._bind("prepare", of_v=self._parts.of_v, **state)]
        begin = self._bind(
            "begin", b=self.system.b, mass=w.mass, free=w.free, impulse=w.impulse, **asdict(self._first), **state
        )
        return [self._bind("prepare", of_v=0.0, **state), *assemble, begin]

    def newton(self, assemble: Sequence[Launch], effects: list[Effect]) -> Newton | None:
        """What several linearizations a step need; None for one. assemble: the launches of each of them."""
        w, s = self.world, self.system
        if self.options.linearizations == 1:
            return None
        mass = w.mass if w.inertia else np.zeros(w.nodes)
        w.backend.keep(mass)
        starts = np.array([*(b.first for b in w.bodies), w.nodes], dtype=np.int32)
        rows = [e.elements[:, 0] for e in effects if e.elements is not None]
        parts = [_parts(launch, starts, s.row, rows) for launch in assemble]
        return Newton(
            self.options, w.reach, parts, rotation=s.rotation, mass=mass, beta=self.beta, ahead=w.ahead, drift=w.drift,
            carried=self.carried,
        )  # fmt: skip

    def _bind(self, kernel: str, **arguments: Any) -> Launch:
        launch: Launch = self.world.backend.module(TEXT).bind(kernel, self.world.nodes, **arguments)
        return launch


def _parts(launch: Launch, starts: Int32, row: Int32, firsts: list[Int32]) -> Int32 | None:
    """(bodies + 1,) where the items of each body begin; None for a launch that does not tell them apart.

    row: of the blocks; firsts: one corner of each element, per effect.
    """
    if launch.domain == "nodes" and launch.items == starts[-1]:
        return starts
    candidates = {"elements": firsts, "blocks": [row]}.get(launch.domain, [])
    found = [c for c in candidates if len(c) == launch.items]
    parts = [np.searchsorted(np.searchsorted(starts, c, "right"), np.arange(1, len(starts) + 1)) for c in found]
    same = bool(parts) and all(np.array_equal(p, parts[0]) for p in parts)
    ascending = all((np.diff(np.searchsorted(starts, c, "right")) >= 0).all() for c in found)
    return parts[0].astype(np.int32) if same and ascending else None


def _coefficients(scene: Scene) -> tuple[Parts, First | None]:
    options, h = scene.integrator, scene.dt
    if options.scheme == "newmark":
        beta, gamma = options.newmark
        parts = Parts(of_v=gamma / beta, of_gain=0.5 / beta - 1 / gamma, carries_gain=1 / gamma - 1)
        return parts, First(gamma / beta, h * (0.5 * gamma / beta - 1), h * (1 - gamma))
    if options.scheme == "bdf2":  # as if the step before had the acceleration of the beginning
        return Parts(of_v=1.0, of_way=1 / 3, carries_dv=1 / 3), First(1.5, -h / 4, h / 3)
    if options.scheme == "quasi_static":
        return Parts(keeps_v=0.0), None
    return Parts(of_v=1.0), None
