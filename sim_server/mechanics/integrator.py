# SPDX-License-Identifier: MIT
"""Time integration: the launches of a step before the effects and after the solve, by the scheme of the scene.

Symbols and names: docs/notation.md. All schemes are, with f the forces, M the lumped masses and h the time step,

    x' = X + c v',    M (v' - V) = i f(x', v')         (a prime: at the end of the step)

    scheme          c = dx_dv    i = force_coefficient   V                        X
    backward_euler  h            h                       v                        x
    newmark         beta h / g   g h                     v + h (1 - g) a          x + h v + h^2 (1/2 - beta) a - c V
    bdf2            2 h / 3      2 h / 3                 v + (v - v_before) / 3   x + (x - x_before) / 3
    generalized_alpha            the same within the step, and on from there to its end (generalized_alpha.py)
    quasi_static    h            h                       0 = f(x'), v' = (x' - x) / h

with g Newmark's gamma and a = (v' - V) / (g h) of the step before. Linearized at (x, v), with K = -df/dx, C = alpha M +
beta K, and the solution dv = v' - v,

    (M + i alpha M + i (c + beta) K) dv = i f(x, v) - i (c + beta) K d + M r

    p = (X + c v - x) / c             predictor: the displacement for dv = 0, over c
    r = V - v                         inertial_increment: dv without forces
    d = (c p + beta v) / (c + beta)   damping_velocity

where f has all forces but beta K v, which is in d; then v += dv, x += c (p + dv). A scheme is given by c, i and the
weights with which it makes p and r of the next step (PredictorWeights, kernels/time_integration.cu). In backward Euler
p = d = v, r = 0, and the launches are those of kernels/nodes.cu. Newton-Raphson (kernels/newton_line_search.cuh)
linearizes again at the state reached; there p = 0.

Order: 1, 2 (gamma = 1/2), 2, 2. One linearization keeps it only where K is the exact slope of the forces; the usual
tangent of corotational elements is not, by as much as they are strained. The scheme ros2 keeps it with any tangent: it
has two stages of its own (rosenbrock.py).

Where a body touches something its step is one of backward Euler, whatever the scheme (docs/contact.md); the history of
the next step is then that of this one, (x' - x) / c = h v' / c and V = v' + (1 - g) dv, as if dv / h had been a.

Stability with one linearization: a mode of stiffness k with k' in its place in the matrix is stable in the schemes of
order 2 at every h if k' >= k, and grows if k' < k (backward Euler: if k' < k / 2). The usual tangent has k' < k under
tension; the exact one leaves out what compression takes from k, as springs do, and projections add to it, so k' >= k.

Sources: Newmark 1959; Hughes, The Finite Element Method, section 9.1; Hairer and Wanner, Solving Ordinary Differential
Equations II, section V.1 (BDF2); Baraff and Witkin 1998 (one linearization).
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from math import inf
from typing import Any, Protocol

import numpy as np

from sim_server.arrays import Int32
from sim_server.backends.base import Launch
from sim_server.backends.central_difference import CentralDifference
from sim_server.backends.euler_form import EulerForm
from sim_server.backends.newton import Newton
from sim_server.backends.rosenbrock import Rosenbrock
from sim_server.mechanics.system import System
from sim_server.scene import Scene

TEXT = "kernels/time_integration.cu"


@dataclass(frozen=True)
class PredictorWeights:
    """Weights with which a step makes predictor p and inertial increment r of the next one (primed).

    v' = keeps_velocity v + dv,   p' = from_velocity v' + from_step (p + dv) + from_force (dv - r)
    r' = inertia_from_force (dv - r) + inertia_from_dv dv
    """

    keeps_velocity: float = 1.0
    from_velocity: float = 0.0
    from_step: float = 0.0
    from_force: float = 0.0
    inertia_from_force: float = 0.0
    inertia_from_dv: float = 0.0


@dataclass(frozen=True)
class InitialWeights:
    """Weights that make p and r of the first step from velocity v and acceleration a at the beginning.

    p = from_velocity v + from_acceleration a,   r = inertia_from_acceleration a; the latter two weights in s.
    """

    from_velocity: float
    from_acceleration: float
    inertia_from_acceleration: float


class CouplesNodes(Protocol):
    """An effect, as far as it couples nodes."""

    @property
    def element_nodes(self) -> list[Int32]:
        """One node of each item of its launches over elements, cells and patches."""


class Integrator:
    """The launches of a scheme.

    inertial_increment (n, 3) [m/s]: r, above; none in backward Euler. beta (n,): damping of the stiffness at nodes [s].
    before (n, 3) [m]: x at the start of the last step, to which a body goes back whose forces are NaN.
    touches: whether the scene has contact, and another scheme than backward Euler.
    takes_euler: whether single bodies may take steps of backward Euler in place of those of the scheme. For these
    start_x [m], start_v [m/s] (n, 3): state at the start of the step; earlier (n, 3): `before` there.
    """

    def __init__(self, scene: Scene, system: System):
        self.options, self.system, self.world = scene.integrator, system, system.world
        w = self.world
        self.inertial_increment = np.zeros((0 if w.plain else w.nodes, 3))
        self.beta = w.beta_of_nodes() if not w.plain else np.zeros(0)
        self.before = w.x.copy()
        w.backend.keep(self.inertial_increment, self.beta, self.before)
        self.touches = "contact" in scene.effects and self.options.scheme != "backward_euler"
        self.takes_euler = self.touches or self.has_stages
        n = w.nodes if self.takes_euler else 0
        self.start_x, self.start_v, self.earlier = w.x[:n].copy(), np.zeros((n, 3)), w.x[:n].copy()
        w.backend.keep(self.start_x, self.start_v, self.earlier)
        self._weights, self._initial = _weights_of(scene)

    @property
    def still(self) -> list[np.ndarray]:
        """Arrays (n, 3) other than v that are 0 in a body at rest."""
        return [] if self.world.plain else [self.world.predictor, self.world.damping_velocity, self.inertial_increment]

    @property
    def carried(self) -> list[np.ndarray]:
        """Arrays (n, 3) that a step leaves to the next beside those of the world and dv."""
        return [self.before] if self.world.plain else [self.before, self.inertial_increment]

    def start(self) -> Launch:
        """Sets b and A to the terms of inertia."""
        s, w = self.system, self.world
        if w.plain:
            return s.start(w.mass)
        if not w.inertia:
            return s.start(np.zeros(w.nodes))
        return self._bind(
            "inertia", mass=w.mass, inertial_increment=self.inertial_increment, diagonal=s.diagonal, b=s.b,
            block=s.block, mean=s.mean,
        )  # fmt: skip

    def advance(self) -> list[Launch]:
        """Advances the state by the solution."""
        s, w = self.system, self.world
        if w.plain:
            return [s.advance(self.before)]
        advance = self._bind(
            "advance", rotation=s.rotation, y=s.y, beta=self.beta, dx_dv=w.dx_dv, v=w.v, x=w.x, dv=s.dv,
            inertial_increment=self.inertial_increment, predictor=w.predictor, damping_velocity=w.damping_velocity,
            before=self.before, **asdict(self._weights),
        )  # fmt: skip
        return [advance]

    def begin(self, assemble: Sequence[Launch]) -> list[Launch]:
        """Launches that make p, d and r from x and v before the first step. assemble: the launches of a step."""
        w = self.world
        if w.plain or not w.inertia:
            return []
        state: dict[str, Any] = {"v": w.v, "beta": self.beta, "dx_dv": w.dx_dv, "predictor": w.predictor}
        state |= {"damping_velocity": w.damping_velocity, "inertial_increment": self.inertial_increment}
        if self._initial is None:
            return [self._bind("prepare", from_velocity=self._weights.from_velocity, **state)]
        begin = self._bind(
            "begin", b=self.system.b, mass=w.mass, free=w.free, force_coefficient=w.force_coefficient,
            **asdict(self._initial), **state,
        )  # fmt: skip
        return [self._bind("prepare", from_velocity=0.0, **state), *assemble, begin]

    def newton(
        self, assemble: Sequence[Launch], detect: slice, effects: Sequence[CouplesNodes]
    ) -> Newton | None:  # fmt: skip
        """Input of Newton-Raphson; None with one linearization a step.

        assemble: the launches of each linearization; detect: numbers of those among them that detect contacts
        """
        w, s = self.world, self.system
        if self.options.linearizations == 1:
            return None
        mass = w.mass if w.inertia else np.zeros(w.nodes)
        w.backend.keep(mass)
        parts = list(self.parts_of(assemble, effects).values())
        return Newton(
            self.options, w.dx_dv, parts, detect, rotation=s.rotation, mass=mass, beta=self.beta, predictor=w.predictor,
            damping_velocity=w.damping_velocity, inertial_increment=self.inertial_increment,
        )  # fmt: skip

    def euler_form(
        self, step: Sequence[Launch], detect: Sequence[Launch], euler: Sequence[Launch], settle: Sequence[Launch],
        effects: Sequence[CouplesNodes],
    ) -> EulerForm | None:  # fmt: skip
        """Input of steps of backward Euler that single bodies take; None if none do.

        step: launches of a step of the scheme; detect: those among them that detect contacts; euler: launches that
        assemble backward Euler; settle: launches after its solve that make the forces on holders
        """
        if not self.takes_euler:
            return None
        w, dv = self.world, self.system.dv
        start: dict[str, Any] = {"start_x": self.start_x, "start_v": self.start_v, "earlier": self.earlier}
        restore = self._bind(
            "restore_for_euler", x=w.x, v=w.v, before=self.before, predictor=w.predictor,
            damping_velocity=w.damping_velocity, inertial_increment=self.inertial_increment, dv=dv, **start,
        )  # fmt: skip
        advance = self.advance_euler()
        return EulerForm(
            assemble=euler, detect=detect, settle=settle, restore=restore, advance=advance, before=self.before, **start,
            parts=self.parts_of((*step, *euler, *settle, restore, advance), effects),
            diagonal=self.system.diagonal, block_scale=w.euler_block_scale(),
            coefficients=w.coefficients, euler_coefficients=(w.dt, w.dt),
        )  # fmt: skip

    def advance_euler(self) -> Launch:
        """Advances the state by the solution of a step of backward Euler, and begins the next one of the scheme."""
        s, w = self.system, self.world
        weights = {k: v for k, v in asdict(self._weights).items() if k != "keeps_velocity"}
        return self._bind(
            "advance_euler", rotation=s.rotation, y=s.y, beta=self.beta, dx_dv=w.dx_dv, h=w.dt,
            force_coefficient=w.force_coefficient, v=w.v, x=w.x, dv=s.dv, inertial_increment=self.inertial_increment,
            predictor=w.predictor, damping_velocity=w.damping_velocity, before=self.before, **weights,
        )  # fmt: skip

    def parts_of(self, launches: Iterable[Launch], effects: Sequence[CouplesNodes]) -> dict[int, Int32 | None]:
        """Returns the first item of each body, (bodies + 1,), by the id of a launch; None if it tells none apart."""
        w, rows = self.world, rows_of(effects)
        starts = np.array([*(b.first for b in w.bodies), w.nodes], dtype=np.int32)
        return {id(x): items_of_bodies(x, starts, self.system.row, rows, w.held_nodes) for x in launches}

    has_stages = False

    def substeps(self, held: int) -> CentralDifference | None:
        """Input of explicit substeps; None for an implicit scheme. held: number of launches that move holders."""
        return None

    def start_forces(self) -> Launch:
        """Begins the forces of a stage."""
        raise NotImplementedError

    def rotate_force(self) -> list[Launch]:
        """Takes the right-hand side of the second stage into the material frame."""
        raise NotImplementedError

    @property
    def error_bounds(self) -> list[float]:
        """Largest estimated error of a step of each body that is not made again [m]; infinite without an estimate."""
        return [inf] * len(self.world.bodies)

    def stages(
        self, assemble: Sequence[Launch], lists: Sequence[Sequence[Launch]], effects: Sequence[CouplesNodes]
    ) -> Rosenbrock | None:
        """Input of a Rosenbrock-W step; None for other schemes.

        lists: launches of the forces of the first and of the second stage, and after it
        """
        return None

    def _bind(self, kernel: str, **arguments: Any) -> Launch:
        launch: Launch = self.world.backend.module(TEXT).bind(kernel, self.world.nodes, **arguments)
        return launch


def rows_of(effects: Sequence[CouplesNodes]) -> list[Int32]:
    """Returns one node of each element, triangle, cell or patch, per effect that has some."""
    return [nodes for e in effects for nodes in e.element_nodes]


def items_of_bodies(launch: Launch, starts: Int32, row: Int32, firsts: list[Int32], held: Int32) -> Int32 | None:
    """First item of each body, (bodies + 1,); None for a launch whose items are not ordered by body.

    starts: first node of each body; row: of each block; firsts: one corner of each element, per effect; held: nodes of
    holders
    """
    if launch.domain == "nodes" and launch.items == starts[-1]:
        return starts
    of_elements = dict.fromkeys(("cells", "patches", "elements", "corners"), firsts)
    candidates = {**of_elements, "blocks": [row], "held": [held]}.get(launch.domain, [])
    found = [c for c in candidates if len(c) == launch.items]
    parts = [np.searchsorted(np.searchsorted(starts, c, "right"), np.arange(1, len(starts) + 1)) for c in found]
    same = bool(parts) and all(np.array_equal(p, parts[0]) for p in parts)
    ascending = all((np.diff(np.searchsorted(starts, c, "right")) >= 0).all() for c in found)
    return parts[0].astype(np.int32) if same and ascending else None


def _weights_of(scene: Scene) -> tuple[PredictorWeights, InitialWeights | None]:
    options, h = scene.integrator, scene.dt
    if options.scheme == "newmark":
        beta, gamma = options.newmark
        weights = PredictorWeights(
            from_velocity=gamma / beta, from_force=0.5 / beta - 1 / gamma, inertia_from_force=1 / gamma - 1
        )
        return weights, InitialWeights(gamma / beta, h * (0.5 * gamma / beta - 1), h * (1 - gamma))
    if options.scheme == "bdf2":  # as if the acceleration at the beginning had been that of the step before
        weights = PredictorWeights(from_velocity=1.0, from_step=1 / 3, inertia_from_dv=1 / 3)
        return weights, InitialWeights(1.5, -h / 4, h / 3)
    if options.scheme == "quasi_static":
        return PredictorWeights(keeps_velocity=0.0), None
    return PredictorWeights(from_velocity=1.0), None
