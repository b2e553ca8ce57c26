# SPDX-License-Identifier: MIT
"""Runs a hard case step by step and measures what must hold."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.kinds import Kind
from sim_server.effects.touch import Touch
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.case import GRAVITY, Case, Hold
from tests.state import put

Reals = NDArray[np.float64]
STATUS = ("converged", "max_iterations", "budget", "breakdown_matrix", "breakdown_preconditioner", "not_finite",
          "max_linearizations", "runaway", "contact")  # fmt: skip


def quiet(sim: Simulation) -> None:
    """Watches nothing."""


CURVE = 100
INVERTED = "an element is inverted at the end"
NOISE, ROUNDING = 0.01, 1e-10  # of the velocities of other seeds, over the length [1/s], and of their positions


@dataclass
class Outcome:
    """Measured. Lengths are parts of the bar's length, energies parts of what was dissipated; None: never."""

    finite: bool
    energy: float  # rise / dissipated
    rise: float  # largest, of energy - work over its lowest earlier value [J]
    dissipated: float  # from start to end [J]
    status: Counter[str]
    fallbacks: int  # solves that left their factor
    iterations: Reals
    with_factor: float  # mean iterations of the steps that used one; nan without
    distance: float  # at the end; Case.rests = "same": the largest of the run
    farthest: float  # the largest of the run
    recovered: int | None  # step from which the distance stays below Case.within
    lowest: float  # smallest det F of the run
    upright: int | None  # step from which every det F > 0
    named: int = 0  # elements that were refused
    volume: tuple[float, float] = (1.0, 1.0)  # least and largest V / V0 of the run
    residual: float = 0.0  # largest true one of a step that says converged, and not at rest
    curve: tuple[float, ...] = ()  # the distance at steps spread over the run, CURVE of them
    home: float = math.nan  # distance at the end from where the scene begins
    cost: tuple[float, float] | None = None  # time and iterations of its steps over those of the case made easy

    @property
    def worst(self) -> str:
        """The status other than converged, with how often, or converged."""
        bad = {s: n for s, n in self.status.items() if s != "converged"}
        return ", ".join(f"{n} × {s}" for s, n in bad.items()) or "converged"


class Load:
    """Holds the bar while it lasts and adds up the work done on it."""

    def __init__(self, sim: Simulation, hold: Hold | None):
        self.sim, self.hold, self.work = sim, hold, 0.0
        self.held: Any = None
        if hold is not None:
            self._take(hold)

    def _take(self, hold: Hold) -> None:
        touch = self.sim.effects["touch"]
        assert isinstance(touch, Touch)
        self.touch = touch
        if hold.target is None:
            self.held = self.touch.push("test", "bar", hold.point, hold.radius, hold.force, math.inf)
        else:
            self.held = self.touch.grab(
                "test", "bar", hold.point, hold.radius, hold.target, hold.stiffness, hold.limit, math.inf
            )

    def before(self, step: int) -> None:
        """Lets go when it is time."""
        if self.held is not None and self.hold is not None and step >= self.hold.until:
            self.touch.release("test", self.held.id)
            self.held = None

    def after(self, x: Reals) -> None:
        """Adds force times displacement of the step that began at x."""
        if self.held is None:
            return
        h, share = self.held, 1 / len(self.held.nodes)
        moved = self.sim.world.x[h.nodes] - x[h.nodes]
        force = np.broadcast_to(share * np.array(h.force), moved.shape)
        if h.stiffness:
            goal = np.array(h.target) + h.offset
            pull = share * h.stiffness * (goal - x[h.nodes])
            size = np.linalg.norm(pull, axis=1, keepdims=True)
            implicit = share * h.stiffness * (goal - self.sim.world.x[h.nodes])
            force = np.where(size > share * h.limit, share * h.limit * pull / np.maximum(size, 1e-300), implicit)
        self.work += float((force * moved).sum())


def finer(case: Case, times: int = 10, steps: int = 150) -> Case:
    """The first steps of a case with so many times smaller ones: is what happens there an error of the time step?"""
    dt = next((float(s.removeprefix("dt=")) for s in case.scene if s.startswith("dt=")), 0.02)
    scene = (*(s for s in case.scene if not s.startswith("dt=")), f"dt={dt / times}")
    hold = replace(case.hold, until=times * case.hold.until) if case.hold else None
    return replace(case, scene=scene, hold=hold, steps=times * min(steps, case.steps), rests="spin")


@dataclass(frozen=True)
class Place:
    """Where cases run. folder: for files that they write"""

    folder: Path
    device: str = "cpu"
    precision: str = "float64"


def built(case: Case, place: Place, *more: str) -> Simulation:
    """The case's scene with overrides, before its start."""
    overrides = [f"solver.precision={place.precision}", *case.scene, *more]
    if case.build:
        return case.build(overrides, place.folder, device=place.device)
    return Simulation.load(case.file, overrides, place.device)


def seeded(case: Case, seed: int) -> Case:
    """The case from another start: gravity turned about the bar, and noise (seed 0: as it stands)."""
    if not seed:
        return case
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    turned = f"effects.gravity.g=[{9.81 * np.sin(angle):.9g},{-9.81 * np.cos(angle):.9g},0]"
    return replace(case, scene=tuple(turned if each == GRAVITY else each for each in case.scene), seed=seed)


def begin(case: Case, sim: Simulation) -> None:
    """Starts a case, on the device."""
    case.start(sim)
    if case.seed:
        w = sim.world
        random, length = np.random.default_rng(case.seed), np.ptp(w.rest, axis=0).max()
        for array, size in ((w.v, NOISE), (w.x, ROUNDING)):
            array += size * length * random.uniform(-1, 1, array.shape) * (w.free > 0)[:, None]
    if sim.world.backend.name == "gpu":
        for array in (sim.world.x, sim.world.v, sim.world.mass):
            put(sim, array, array.copy())


class Beside:
    """Makes the steps of an easy scene one by one, for what another costs over it."""

    def __init__(self, sim: Simulation):
        self._clock = "whole" if sim.world.backend.name == "gpu" else "cpu"
        self._driver, self._records = Driver(sim), list[NDArray[Any]]()

    def step(self) -> None:
        self._records.append(self._driver.advance(1))

    def cost(self, records: list[NDArray[Any]]) -> tuple[float, float]:
        """Time (of the loop's processor, or of a GPU) and iterations of steps over those made here."""
        own, easy = np.concatenate(records), np.concatenate(self._records)
        sums = [(float(own[name].sum()), float(easy[name].sum())) for name in (self._clock, "iterations")]
        time, iterations = (mine / other if other else math.nan for mine, other in sums)
        return time, iterations


def _easy(case: Case, place: Place) -> Beside | None:
    if case.easy is None:
        return None
    sim = built(case.twin(), place)
    begin(case.twin(), sim)
    return Beside(sim)


def run_case(
    case: Case, folder: Path, device: str = "cpu", precision: str = "float64",
    watch: Callable[[Simulation], None] = quiet, compare: bool = False,
) -> Outcome:  # fmt: skip
    """folder: for files that the case writes; watch: called before the first step and after each; compare: with the
    case made easy, step by step beside it."""
    place = Place(folder, device, precision)
    sim = built(case, place)
    pose, goal = sim.world.x.copy(), _goal(case, sim, place)
    easy = _easy(case, place) if compare else None
    length = float(np.ptp(sim.world.rest, axis=0).max())
    begin(case, sim)
    if case.refused:
        return _refused(case, sim, goal)
    rest_volumes = _rest_volumes(sim)
    driver, load = Driver(sim, case.source(sim) if case.source else None), Load(sim, case.hold)
    energy, distance, det, records, passed, volume = [_energy(sim)], [], [], [], [], []
    watch(sim)
    for step in range(case.steps):
        load.before(step)
        x = sim.world.x.copy()
        records.append(driver.advance(1))
        if easy:
            easy.step()
        sim.fetch()
        load.after(x)
        energy.append(_energy(sim) - load.work)
        watch(sim)
        each = determinants(sim)
        det.append(float(each.min()))
        volume.append(float(each @ rest_volumes))
        distance.append(float(np.abs(sim.world.x - (goal[step] if case.rests == "same" else goal)).max()) / length)
        passed.append(sim.world.x.copy() if case.rests == "still" else None)
        if not np.isfinite(sim.world.x).all():
            break
    if case.rests == "still":
        distance = [float(np.abs(x - passed[-1]).max()) / length for x in passed]
    found = _outcome(case, sim, np.concatenate(records), np.array(energy), np.array(distance), np.array(det))
    shown = np.linspace(0, len(distance) - 1, min(CURVE, len(distance))).astype(int)
    curve = tuple(float(f"{distance[k]:.3g}") for k in shown)
    home, cost = float(np.abs(sim.world.x - pose).max()) / length, easy.cost(records) if easy else None
    return replace(found, volume=(min(volume), max(volume)), curve=curve, home=home, cost=cost)


def _refused(case: Case, sim: Simulation, rest: Reals) -> Outcome:
    """Steps in a state that the model does not define, then as many from rest."""
    driver, x, det = Driver(sim), sim.world.x.copy(), determinants(sim)
    records = driver.advance(case.steps)
    moved = float(np.abs(sim.fetch().x - x).max())
    put(sim, sim.world.x, rest)
    put(sim, sim.world.v, 0)
    named = {r.element for r in sim.refusals()}
    after = driver.advance(case.steps)
    distance = float(np.abs(sim.fetch().x - rest).max() / np.ptp(rest))
    return Outcome(
        finite=bool(np.isfinite(sim.world.x).all()), energy=0.0, rise=0.0, dissipated=0.0,
        status=Counter(STATUS[s] for s in records["status"].tolist()), fallbacks=0,
        iterations=records["iterations"].astype(float), with_factor=math.nan, distance=distance, farthest=moved,
        recovered=case.steps if (after["status"] == 0).all() else None, lowest=float(det.min()), upright=case.steps,
        named=len(named),
    )  # fmt: skip


def _energy(sim: Simulation) -> float:
    return sim.potential_energy() + sim.kinetic_energy()


def determinants(sim: Simulation) -> Reals:
    """det F of each element."""
    tets = sim.world.bodies[0].tets
    now, rest = (a[tets] for a in (sim.world.x, sim.world.rest))
    return np.linalg.det(now[:, 1:] - now[:, :1]) / np.linalg.det(rest[:, 1:] - rest[:, :1])


def _rest_volumes(sim: Simulation) -> Reals:
    """Of each element, as a part of the body's volume."""
    corners = sim.world.rest[sim.world.bodies[0].tets]
    found = np.linalg.det(corners[:, 1:] - corners[:, :1])
    return np.asarray(found / found.sum())


def _goal(case: Case, sim: Simulation, place: Place) -> Reals:
    """Where the body has to come, of a run in float64 on a CPU: (nodes, 3), or (steps, nodes, 3) where every step is
    compared."""
    exact = Place(place.folder)
    if case.rests == "static":
        damped = ("dt=0.1", "object.bar.effects.rayleigh.mass=5", "integrator.scheme=backward_euler")
        still = built(case, exact, *damped, "solver.update=every-1")
        begin(case, still)
        Driver(still).advance(250)
        assert np.abs(still.world.v).max() < 1e-6, "the reference run did not come to rest"
        return still.world.x.copy()
    if case.rests == "same":
        alone = ("solver.preconditioner=none", "solver.tolerance=1e-10", "solver.max_iterations=10000")
        other = built(case, exact, *alone)
        begin(case, other)
        driver, x = Driver(other), []
        for _ in range(case.steps):
            assert (driver.advance(1)["status"] == 0).all(), "the reference run did not converge"
            x.append(other.world.x.copy())
        return np.array(x)
    return sim.world.x.copy()


def solved(records: Any) -> NDArray[np.bool_]:
    """Steps that were solved: that of a body at rest has the residual of rounding."""
    return np.asarray((records["status"] == STATUS.index("converged")) & (records["at_rest"] == 0))


def _from_then_on(good: NDArray[np.bool_]) -> int | None:
    """First step (counted from 1) from which it holds to the end; 0: always."""
    bad = np.flatnonzero(~good)
    if len(bad) == 0:
        return 0
    return None if bad[-1] == len(good) - 1 else int(bad[-1]) + 2


def _outcome(case: Case, sim: Simulation, records: Any, energy: Reals, distance: Reals, det: Reals) -> Outcome:
    rise = float((energy - np.minimum.accumulate(energy)).max())
    dissipated = abs(float(energy[0] - energy[-1]))
    used = records["kind"] == Kind.CHOLESKY
    return Outcome(
        finite=bool(np.isfinite(sim.world.x).all() and np.isfinite(energy).all() and len(records) == case.steps),
        energy=rise / dissipated if dissipated else math.nan,
        rise=rise,
        dissipated=dissipated,
        status=Counter(STATUS[s] for s in records["status"].tolist()),
        fallbacks=int(records["fallbacks"].sum()),
        iterations=records["iterations"].astype(float),
        with_factor=float(records["iterations"][used].mean()) if used.any() else math.nan,
        distance=float(distance.max() if case.rests == "same" else distance[-1]),
        farthest=float(distance.max()),
        recovered=_from_then_on(distance <= case.within),
        lowest=float(det.min()),
        upright=_from_then_on(det > 0),
        residual=float(records["residual"][solved(records)].max(initial=0.0)),
    )


def _not_refused(case: Case, out: Outcome) -> list[str]:
    found = []
    if out.status != Counter(not_finite=case.steps):
        found.append(f"solves ended with {dict(out.status)}, not all with not_finite")
    if not out.named:
        found.append("no element was named")
    if out.farthest:
        found.append(f"it moved by {out.farthest:.3g} m")
    if out.recovered is None or not out.distance < 1e-9:
        found.append(f"put back to rest it did not go on; {out.distance:.3g} L away")
    return found


def unexpected(case: Case, out: Outcome) -> list[str]:
    """What is not as the table states it; empty if the case passes."""
    found = broken(case, out)
    if case.several:
        return [each for each in found if each != INVERTED]
    if not case.fails:
        return found
    if not found:
        return ["stated to fail, and all of it holds"]
    return [] if out.worst != "converged" else ["it failed, and the statuses do not tell"]


def broken(case: Case, out: Outcome) -> list[str]:
    """What had to hold and did not."""
    found = [] if out.finite else ["not finite"]
    if case.refused:
        return found + _not_refused(case, out)
    if not out.energy <= case.energy:
        found.append(f"energy rose by {out.energy:.3g} of what was dissipated, more than {case.energy:g}")
    for status, count in out.status.items():
        if status != "converged" and count > case.unconverged.get(status, 0):
            found.append(f"{count} steps ended with {status}")
    if case.rests == "same" and not out.distance <= case.within:
        found.append(f"the factor changed the answer: {out.distance:.3g} L")
    if case.rests in ("pose", "static", "still") and not out.farthest > 5 * case.within:
        found.append(f"was never away: {out.farthest:.3g} L, so that coming back shows nothing")
    if case.rests in ("pose", "static", "still") and (out.recovered is None or out.recovered > case.recovered):
        found.append(f"not back by step {case.recovered}; {out.distance:.3g} L away at the end")
    if case.upright and out.upright is None:
        found.append(INVERTED)
    if case.iterations and not out.with_factor <= case.iterations:
        found.append(f"{out.with_factor:.3g} iterations with a factor, more than {case.iterations:g}")
    return found
