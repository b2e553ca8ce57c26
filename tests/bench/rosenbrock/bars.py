# SPDX-License-Identifier: MIT
"""The bars of the benchmark, the methods that are compared, and a run of one of them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.state import put

CELLS = {  # by number of tetrahedra
    162: (3, 3, 3), 540: (3, 3, 10), 3000: (5, 5, 20), 24_000: (10, 10, 40), 98_304: (16, 16, 64),
}  # fmt: skip
SIZE = (1.0, 1.0, 4.0)  # m
LENGTH = SIZE[2]
BANDS = (("Z < 1.3334", 5.0), ("Z < 2.6667", 0.25), (None, 0.05))  # of E: 1000:50:10 from the held end
FRAME = 0.04  # s between two frames that are compared
NOT_FINITE, RUNAWAY = 5, 7  # statuses of a solve

Row = dict[str, Any]
Reals = NDArray[np.float64]
Start = Callable[[Simulation], None]


@dataclass(frozen=True)
class Bar:
    """1 x 1 x 4 m along z, 1000 kg/m3. damping: of the mass [1/s]; beta: of the stiffness [s]; held: at z = 0."""

    tets: int = 540
    young: float = 1e6
    poisson: float = 0.45
    bands: bool = False
    model: str = "corotational"
    damping: float = 0.1
    beta: float = 0.0
    gravity: bool = True
    held: bool = True
    tangent: str = "default"  # of corotational

    @property
    def material(self) -> str:
        """In tables."""
        return "bands" if self.bands else "one E"

    def table(self, dt: float, method: "Method") -> dict[str, Any]:
        """The scene."""
        mesh = {"bar": list(CELLS[self.tets]), "size": list(SIZE), "split": "mirrored"}
        effects: dict[str, Any] = {self.model: self._law()}
        if self.damping or self.beta:
            effects["rayleigh"] = {"mass": self.damping, "stiffness": self.beta}
        if self.held:
            effects["fixed"] = {"where": "Z < 0.01"}
        solver = {"preconditioner": "cholesky", "update": f"lockstep-{method.latency}", "max_iterations": 5000}
        return {
            "name": "rosenbrock", "dt": dt, "effects": {"gravity": {}} if self.gravity else {},
            "integrator": method.integrator, "solver": solver | method.solver,
            "object": [{"name": "bar", "mesh": mesh, "elements": "linear", "effects": effects}],
        }  # fmt: skip

    def _law(self) -> dict[str, Any]:
        young: Any = self.young
        if self.bands:
            young = [{"young": share * self.young} | ({"where": where} if where else {}) for where, share in BANDS]
        tangent = {} if self.tangent == "default" else {"tangent": self.tangent}
        return {"young": young, **tangent} | ({} if self.model == "mass_spring" else {"poisson": self.poisson})


@dataclass(frozen=True)
class Method:
    """An integrator with its solver. latency: steps from a matrix to its factor (D of lockstep-D)."""

    name: str
    integrator: dict[str, Any] = field(default_factory=dict, hash=False)
    solver: dict[str, Any] = field(default_factory=dict, hash=False)
    latency: int = 10

    def aged(self, latency: int) -> "Method":
        """With factors of another age, which its name tells."""
        return Method(f"{self.name} {ages(latency)} old", self.integrator, self.solver, latency)


def ages(latency: int) -> str:
    """Ages of the factors of lockstep-D [steps]."""
    return "1" if latency == 1 else f"{latency} to {2 * latency - 1}"


def _other(scheme: str, linearizations: int, digits: int) -> Method:
    """A scheme that iterates. digits: k of the tolerance 1e-k of its linear solves."""
    name = "backward Euler" if scheme == "backward_euler" else scheme
    several = f", {linearizations} linearizations" if linearizations > 1 else ""
    integrator = {"scheme": scheme} | ({"linearizations": linearizations} if several else {})
    return Method(f"{name}{several}, 1e-{digits}", integrator, {"tolerance": 10.0**-digits})


ITERATE = {"scheme": "ros2", "solve": "iterate"}
EULER = _other("backward_euler", 1, 6)
NEWMARK = _other("newmark", 1, 6)
BDF2 = _other("bdf2", 1, 6)
ROS2_ITERATE = Method("ros2, iterate, 1e-6", ITERATE)
ROS2_FACTOR = Method("ros2, factor", {"scheme": "ros2", "solve": "factor"})
NEWTON = {"scheme": "newmark", "linearizations": 30, "tolerance": 1e-10}
OTHERS = (
    EULER, _other("backward_euler", 1, 3), NEWMARK, _other("newmark", 1, 3), _other("newmark", 2, 2),
    _other("newmark", 3, 2), _other("bdf2", 1, 3), _other("bdf2", 2, 2), _other("generalized_alpha", 1, 3),
    _other("generalized_alpha", 2, 2), ROS2_ITERATE,
    Method("ros2, iterate, 1e-3", ITERATE, {"tolerance": 1e-3}),
)  # fmt: skip
REFERENCE = Method("newmark, Newton to 1e-10", NEWTON, {"tolerance": 1e-8})
SECOND_REFERENCE = Method("ros2, iterate to 1e-8", ITERATE, {"tolerance": 1e-8})
REFERENCE_STEP = 1.25e-3  # s


@dataclass
class Run:
    """frames (k, nodes, 3): positions each FRAME [m], none where none were asked for; records: of every step."""

    sim: Simulation
    dt: float
    frames: Reals
    records: NDArray[Any]

    @property
    def well(self) -> bool:
        """Finite, and did not run away."""
        bad = np.isin(self.records["status"], (NOT_FINITE, RUNAWAY)).any()
        return bool(not bad and np.isfinite(self.sim.world.x).all())

    def error(self, other: "Run") -> float:
        """Root mean square of the distances of all nodes in all frames / L; nan if either did not stay well."""
        if not (self.well and other.well):
            return float("nan")
        return float(np.sqrt(((self.frames - other.frames) ** 2).sum(axis=2).mean())) / LENGTH

    def cost(self) -> float:
        """Milliseconds a simulated second."""
        return float(self.step_times().mean()) / self.dt

    def step_times(self) -> Reals:
        """Of each step but the first [ms]: of the loop's thread by its own clock, on a GPU of the device."""
        column = "cpu" if self.sim.world.backend.name == "cpu" else "whole"
        return 1e3 * np.asarray(self.records[column][1:], dtype=float)

    def share(self, form: str) -> float:
        """Of the steps that were made in a form of a Rosenbrock-W step."""
        return float((self.records["form"] == FORMS[form]).mean())

    @property
    def iterations(self) -> float:
        return float(self.records["iterations"].mean())


def load(bar: Bar, method: Method, dt: float, device: str) -> Simulation:
    """Ready to run."""
    scene = Scene.model_validate(bar.table(dt, method), context={"folder": Path.cwd()})
    return Simulation(scene, device)


def run(
    bar: Bar, method: Method, dt: float, seconds: float, device: str = "cpu", start: Start | None = None,
    frames: bool = True,
) -> Run:  # fmt: skip
    """A run whose first factor is that of the first matrix. start: changes the state before it."""
    sim = load(bar, method, dt, device)
    if start is not None:
        start(sim)
    driver, steps = Driver(sim), round(seconds / dt)
    records, kept = [driver.step_with_fresh_factors()], []
    if not frames:
        records.append(driver.advance(steps - 1))
        sim.fetch()
        return Run(sim, dt, np.empty((0, sim.world.nodes, 3)), np.concatenate(records))
    each = max(1, round(FRAME / dt))
    for end in range(each, steps + 1, each):
        records.append(driver.advance(end - sim.engine.step))
        kept.append(sim.fetch().x.copy())
    return Run(sim, dt, np.array(kept), np.concatenate(records))


def momenta(sim: Simulation) -> tuple[Reals, Reals]:
    """Linear [kg m/s] and angular momentum about the origin [kg m2/s]."""
    w = sim.fetch()
    return w.mass @ w.v, w.mass @ np.cross(w.x, w.v)


def energy(sim: Simulation) -> float:
    """Kinetic and potential [J]."""
    return sim.potential_energy() + sim.kinetic_energy()


def inverted(sim: Simulation) -> int:
    """Elements with J < 0 or no number."""
    w = sim.world
    tets = w.bodies[0].tets
    now, rest = (a[tets] for a in (w.x, w.rest))
    det = np.linalg.det(now[:, 1:] - now[:, :1]) / np.linalg.det(rest[:, 1:] - rest[:, :1])
    return int((~(det > 0)).sum())


def placed(change: Callable[[Reals], Reals]) -> Start:
    """Other positions of the free nodes."""

    def start(sim: Simulation) -> None:
        w = sim.world
        put(sim, w.x, np.where((w.free > 0)[:, None], change(w.rest), w.x))

    return start


def thrown(velocity: Callable[[Reals], Reals]) -> Start:
    """Velocities of the free nodes by their places at rest."""

    def start(sim: Simulation) -> None:
        w = sim.world
        put(sim, w.v, np.where((w.free > 0)[:, None], velocity(w.rest), 0.0))

    return start


def _random(rest: Reals) -> Reals:
    return np.random.default_rng(0).uniform(rest.min(axis=0), rest.max(axis=0), rest.shape)


STARTS: dict[str, tuple[str, Start | None]] = {
    "let go": ("from horizontal, under gravity", None),
    "stretched": ("to three times its length", placed(lambda x: x * [1, 1, 3])),
    "pressed": ("to a fifth of its length", placed(lambda x: x * [1, 1, 0.2])),
    "inside out": ("mirrored at its held face, every element inverted", placed(lambda x: x * [1, 1, -1])),
    "random": ("every free node anywhere in the bounding box", placed(_random)),
    "spun": ("at 20 rad/s about its axis, but for the held face",
             thrown(lambda x: np.cross([0, 0, 20.0], x - [0.5, 0.5, 0]))),
}  # fmt: skip
