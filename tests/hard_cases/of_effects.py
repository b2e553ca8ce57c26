# SPDX-License-Identifier: MIT
"""Runs hard cases of effects: each of several seeds, with one figure that must stay small."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.running import STATUS, Beside, quiet, solved

Table = dict[str, Any]
Reals = NDArray[np.float64]
Random = np.random.Generator
SEEDS = 4
TOLD = {status: 10_000 for status in STATUS}


@dataclass
class Trace:
    """start, positions (nodes, 3) before the first step and after each, and all records."""

    start: Reals
    positions: list[Reals]
    records: NDArray[Any]

    @property
    def last(self) -> Reals:
        return self.positions[-1]

    @property
    def speed(self) -> float:
        """Largest change of a position in the last step [m]."""
        return float(np.abs(self.positions[-1] - self.positions[-2]).max())


@dataclass(frozen=True)
class EffectCase:
    """A line of the table. done, must: in words, must with `most`.

    scene: made from random numbers; begin: changes the state before the first step; act: before each one
    judge: what must be at most `most`; unconverged: how many steps may end so, by status, of all objects
    fails: known not to hold all of this, for the reason of the note
    easy: its scene made easy, for what the case costs; None: the scene itself, without `begin` and `act`, if it has any
    """

    name: str
    done: str
    must: str
    scene: Callable[[Random], Table]
    judge: Callable[[Simulation, Trace], float]
    most: float
    steps: int = 150
    act: Callable[[Simulation, int], None] = lambda sim, step: None
    begin: Callable[[Simulation, Random], None] = lambda sim, random: None
    unconverged: dict[str, int] = field(default_factory=dict)
    fails: bool = False
    note: str = ""
    easy: Callable[[Random], Table] | None = None


@dataclass(frozen=True)
class EffectOutcome:
    """Of one seed. wrong: what had to hold and did not; volume: least and largest V / V0 of an object; lowest: smallest
    det F; residual: the largest true one of a step that says converged; cost: as of running.Outcome"""

    wrong: tuple[str, ...]
    value: float
    status: Counter[str]
    iterations: Reals
    volume: tuple[float, float] = (1.0, 1.0)
    lowest: float = 1.0
    residual: float = 0.0
    cost: tuple[float, float] | None = None


def run_effect_case(
    case: EffectCase, seed: int, device: str = "cpu", precision: str = "float64",
    watch: Callable[[Simulation], None] = quiet, compare: bool = False,
) -> EffectOutcome:  # fmt: skip
    """watch: called before the first step and after each; compare: with the scene made easy, step by step beside it."""
    random = np.random.default_rng(seed)
    sim = _built(case.scene(random), device, precision)
    easy = _easy(case, seed, device, precision) if compare else None
    case.begin(sim, random)
    driver, start, positions, records = Driver(sim), sim.fetch().x.copy(), [], []
    watch(sim)
    for step in range(case.steps):
        case.act(sim, step)
        records.append(driver.advance(1))
        if easy:
            easy.step()
        positions.append(sim.fetch().x.copy())
        watch(sim)
    trace = Trace(start, positions, np.concatenate(records))
    status = Counter(STATUS[s] if s < len(STATUS) else "contact" for s in trace.records["status"].tolist())
    value = case.judge(sim, trace)
    wrong = [] if np.isfinite(trace.last).all() and np.isfinite(sim.world.v).all() else ["not finite"]
    wrong += [
        f"{count} steps ended with {name}" for name, count in status.items()
        if name != "converged" and count > case.unconverged.get(name, 0)
    ]  # fmt: skip
    if not value <= case.most:
        wrong.append(f"{value:.3g}, more than {case.most:g}")
    residuals = trace.records["residual"][solved(trace.records)]
    return EffectOutcome(
        tuple(wrong), value, status, trace.records["iterations"].astype(float), *_shape(sim, trace),
        float(residuals.max(initial=0.0)), easy.cost(records) if easy else None,
    )  # fmt: skip


def _built(table: Table, device: str, precision: str) -> Simulation:
    table = {"name": "case", "dt": 0.01, **table}
    usual = {"preconditioner": "cholesky", "update": "lockstep-5", "precision": precision}
    table["solver"] = usual | table.get("solver", {})
    return Simulation(Scene.model_validate(table, context={"folder": "."}), device)


def _easy(case: EffectCase, seed: int, device: str, precision: str) -> Beside | None:
    done = any(getattr(case, name) is not EffectCase.__dataclass_fields__[name].default for name in ("act", "begin"))
    scene = case.easy or (case.scene if done else None)
    return Beside(_built(scene(np.random.default_rng(seed)), device, precision)) if scene else None


def _shape(sim: Simulation, trace: Trace) -> tuple[tuple[float, float], float]:
    """Least and largest V / V0 of an object, and the smallest det F, at every tenth step and the last one."""
    volumes, lowest = [], np.inf
    for body in sim.world.bodies:
        tets = body.mesh.tets + body.first
        rest = _volumes(sim.world.rest, tets)
        for x in [*trace.positions[::10], trace.last]:
            now = _volumes(x, tets)
            volumes.append(float(now.sum() / rest.sum()))
            lowest = min(lowest, float((now / rest).min()))
    return (min(volumes), max(volumes)), float(lowest)


def _volumes(x: Reals, tets: NDArray[Any]) -> Reals:
    """Six times that of each tetrahedron [m3]."""
    corners = x[tets]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))


def below_floor(sim: Simulation, trace: Trace) -> float:
    """Deepest place of a node below y = 0 in the run [m]."""
    return float(-min(x[:, 1].min() for x in trace.positions))


def still(sim: Simulation, trace: Trace) -> float:
    """Largest speed at the end [m/s]; of what is below the floor none."""
    return speed(sim, trace) if below_floor(sim, trace) < 1e-4 else float("inf")


def speed(sim: Simulation, trace: Trace) -> float:
    """Largest speed in the last step [m/s]."""
    return trace.speed / sim.world.dt


def tells(sim: Simulation, trace: Trace) -> float:
    """Nothing more than what holds of all."""
    return 0.0


def back_to_rest(sim: Simulation, trace: Trace) -> float:
    """Largest distance from where it began, over the length."""
    return float(np.abs(trace.last - trace.start).max() / np.ptp(trace.start, axis=0).max())


def of_order(sim: Simulation, trace: Trace) -> float:
    """Largest amount by which the last object is below the first one in the run [m]."""
    first, last = (sim.world.bodies[k].nodes for k in (0, -1))
    return float(max(x[first, 1].mean() - x[last, 1].mean() for x in trace.positions))


def passed(sim: Simulation, trace: Trace) -> float:
    """Largest amount by which the middle of the last object is below the lowest node of the first one [m]."""
    first, last = (sim.world.bodies[k].nodes for k in (0, -1))
    return float(max(x[first, 1].min() - x[last, 1].mean() for x in trace.positions))


def energy_rise(sim: Simulation, trace: Trace) -> float:
    """Largest kinetic energy over what the run allows: that at its start and the work of gravity and loads."""
    found = trace.records
    known = (found["status"] != STATUS.index("runaway")) & np.isfinite(found["kinetic"])
    least = 1e-9 * float(np.nanmax(np.abs(found["budget"]))) + 1e-300
    return float((found["kinetic"][known] / np.maximum(found["budget"][known], least)).max(initial=0.0))


def free_fall(sim: Simulation, trace: Trace) -> float:
    """How far the node that moves most falls other than it should by backward Euler, as a part of that."""
    n, h = len(trace.positions), sim.world.dt
    way = 9.81 * h * h * n * (n + 1) / 2
    return abs(float((trace.start - trace.last)[:, 1].max()) - way) / way
