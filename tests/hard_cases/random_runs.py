# SPDX-License-Identifier: MIT
"""Runs the plans of random_scenes.py and tells what must not be: errors of other kinds than those for users, numbers
that are not finite, statuses that are not true, energy from nowhere, and runs that do not repeat to the bit."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.effects._movable import MoveError
from sim_server.effects.touch import TouchError
from sim_server.errors import InputError
from sim_server.mechanics.numbers import text_of
from sim_server.mechanics.removal import KEY
from sim_server.mechanics.world import Body
from sim_server.mesh import bar
from sim_server.parameters import BadParameter, toml
from sim_server.scene.live import LiveField
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import FactorSource, Inline, Job
from tests.hard_cases import sources
from tests.support import effect_samples

Table = dict[str, Any]
CONVERGED, NOT_FINITE, RUNAWAY = 0, 5, 7
TIMED = ("assemble", "solve", "integrate", "whole", "late", "begin", "cpu")
MOST = 1e200  # beyond, squares are not finite


@dataclass
class Run:
    """What a plan came to. refused: the reason; complaints: what must not be; records, states: of all steps."""

    refused: str = ""
    complaints: list[str] = field(default_factory=list)
    records: list[NDArray[Any]] = field(default_factory=list)
    states: list[NDArray[np.float64]] = field(default_factory=list)


class Unreliable(Inline):
    """Makes factors late, loses every second one, or fails to make any."""

    def __init__(self, sim: Simulation, kind: str):
        super().__init__({b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies})
        self._kind, self._engine, self._made = kind, sim.engine, 0
        self._kept: list[tuple[int, Factor]] = []
        self._failed: list[tuple[str, str]] = []

    def submit(self, job: Job) -> bool:
        if self._kind == "failing":
            self._failed.append((job.object, "no factor today"))
            return True
        return super().submit(job)

    def failures(self) -> list[tuple[str, str]]:
        found, self._failed = self._failed, []
        return found + super().failures()

    def poll(self) -> list[Factor]:
        found = super().poll()
        if self._kind == "lost":
            self._made += len(found)
            return found if self._made % 2 else []
        late = 5 if self._kind == "late" else 0
        self._kept += [(self._engine.step + late, factor) for factor in found]
        ready = [factor for at, factor in self._kept if at <= self._engine.step]
        self._kept = [(at, factor) for at, factor in self._kept if at > self._engine.step]
        if self._kind == "earlier":
            return [replace(factor, step=max(factor.step - 1000, 0)) for factor in ready]
        return ready


def _halved(values: NDArray[Any]) -> NDArray[Any]:
    return values * np.repeat([1.0, 1e-3], [len(values) // 2, len(values) - len(values) // 2])


POISONS = {
    "negated": lambda v: -v, "noise": sources.noisy, "shuffled": sources.shuffled, "ones": sources.ones,
    "nan": sources.one_nan, "overflow": sources.overflowing, "half": _halved,
}  # fmt: skip


def source_of(name: str, sim: Simulation) -> FactorSource | None:
    """What makes factors; None: this process."""
    if name == "inline":
        return None
    if name == "nobody":
        return sources.nobody(sim)
    return sources.poisoned(POISONS[name])(sim) if name in POISONS else Unreliable(sim, name)


def made_mesh(made: Table, folder: Path, name: str) -> Table:
    """The `mesh` table of a bar whose nodes are moved at random and whose upper half is pressed flat."""
    mesh = bar(made["bar"], made["size"], made["split"])
    cell = np.array(made["size"]) / made["bar"]
    rest = mesh.rest + made["jitter"] * cell * np.random.default_rng(made["seed"]).uniform(-0.5, 0.5, mesh.rest.shape)
    top = rest[:, 1].max() - cell[1]
    above = rest[:, 1] > top
    rest[above, 1] = top + made["sliver"] * (rest[above, 1] - top)
    path = folder / f"{name}.vtu"
    meshio.Mesh(rest, [("tetra", mesh.tets)]).write(path)
    return {"file": str(path)}


def built(plan: Table, folder: Path) -> Simulation:
    """Raises InputError where the scene is refused."""
    scene = dict(plan["scene"])
    scene["object"] = [
        each | {"mesh": made_mesh(each["mesh"]["made"], folder, each["name"])} if "made" in each["mesh"] else each
        for each in scene["object"]
    ]
    path = folder / "scene.toml"
    path.write_text("\n".join(f"{key} = {effect_samples.toml(value)}" for key, value in scene.items()))
    return Simulation.load(path)


def begin(sim: Simulation, kind: str, seed: int) -> None:
    """Puts the free nodes into a state to start from; of scenes with holders and contact too."""
    w, rng = sim.world, np.random.default_rng(seed)
    free = w.free > 0
    low, high = w.x.min(axis=0), w.x.max(axis=0)
    middle, size = (low + high) / 2, float((high - low).max())
    x = w.x.copy()
    if kind == "stretched":
        x[:, 0] = low[0] + 3 * (x[:, 0] - low[0])
    elif kind == "flat":
        x[:, 1] = high[1] + 1e-6 * size * rng.normal(size=len(x))
    elif kind == "mirrored":
        x[:, 2] = low[2] + high[2] - x[:, 2]
    elif kind == "random":
        x = rng.uniform(low, high, x.shape)
    elif kind == "thrown":
        w.v[free] = [10 * size, -100 * size, 0]
    elif kind == "spun":
        w.v[free] = np.cross([0, 0, 100.0], x - middle)[free]
    w.x[free] = x[free]


def _point(sim: Simulation, name: str, node: int) -> tuple[float, float, float]:
    body = sim.world.body(name)
    x, y, z = sim.world.x[body.first + node % (body.last - body.first)].tolist()
    return x, y, z


def _times(value: Any, times: float) -> Any:
    if isinstance(value, list | tuple):
        return [_times(each, times) for each in value]
    if isinstance(value, dict):
        return {key: _times(each, times) if key != "where" else each for key, each in value.items()}
    return value * times if isinstance(value, int | float) and not isinstance(value, bool) else value


def happens(sim: Simulation, start: Start, kind: str, e: Table) -> None:
    """An event of a plan; what is refused to clients by its own error is refused."""
    try:
        if kind == "reset":
            start.reset(e["object"])
        elif kind == "set":
            fields: list[LiveField] = [p.field for p in sim.parameters if p.field.value is not None]
            if fields:
                chosen = fields[e["key"] % len(fields)]
                sim.parameters.set({chosen.key: toml(_times(_json(chosen.value), e["times"]))})
        elif kind == "cut" and "cutting" in sim.world.body(e["object"]).effects:
            count = len(sim.world.body(e["object"]).mesh.tets)
            gone = np.random.default_rng(e["seed"]).permutation(count)[: max(1, int(e["part"] * count))]
            sim.parameters.set({KEY.format(e["object"]): f'"{text_of(gone)}"'})
        elif kind == "move":
            for mover in sim.movers:
                for name in list(mover.targets)[e["which"] : e["which"] + 1]:
                    place = mover.targets[name][:3] + e["far"] * np.array(e["by"])
                    mover.move(name, tuple(place.tolist()), (0.7, 0.1, 0.0, 0.7))
        elif kind in ("push", "grab", "release", "nan") and sim.touch:
            _touch(sim, kind, e)
    except (TouchError, BadParameter, MoveError):
        pass


def _json(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_json(each) for each in value]
    return value.model_dump(exclude_none=True) if hasattr(value, "model_dump") else value


def _touch(sim: Simulation, kind: str, e: Table) -> None:
    assert sim.touch is not None
    if kind == "release":
        sim.touch.release_of()
        return
    point = _point(sim, e["object"], e["node"])
    if kind == "nan":
        nan = float("nan")
        for wrong in (lambda: sim.touch.push("c", e["object"], point, 0.0, (nan, 0, 0), 1.0),
                      lambda: sim.touch.grab("c", e["object"], point, 0.0, (nan, 0, 0), 1.0, 1.0, 1.0)):  # fmt: skip
            try:
                wrong()
            except TouchError:
                continue
            raise AssertionError("a push or grab that is no number was taken")
        return
    if kind == "push":
        x, y, z = (e["newton"] * np.array(e["force"])).tolist()
        sim.touch.push("c", e["object"], point, e["radius"], (x, y, z), e["duration"])
        return
    x, y, z = (np.array(point) + e["far"] * np.array(e["by"])).tolist()
    sim.touch.grab("c", e["object"], point, e["radius"], (x, y, z), e["stiffness"], e["newton"], e["duration"])


def one_run(plan: Table, folder: Path) -> Run:
    """Makes the steps of a plan."""
    run = Run()
    try:
        sim = built(plan, folder)
    except InputError as error:
        return Run(refused=str(error))
    with np.errstate(all="ignore"):
        start = Start(sim)
        begin(sim, *plan["start"])
        driver = Driver(sim, source_of(plan["source"], sim), counted=True)
        away: set[int] = set()
        for step in range(plan["steps"]):
            for at, kind, values in plan["events"]:
                if at == step:
                    happens(sim, start, kind, values)
            records = driver.advance(1)
            run.records.append(records)
            run.states.append(np.stack([sim.world.x, sim.world.v]))
            run.complaints += [f"step {step}: {c}" for c in untrue(sim, records, away)]
            if run.complaints:
                break
    return run


def untrue(sim: Simulation, records: NDArray[Any], away: set[int]) -> list[str]:
    """What must not be after a step. away: bodies that were told to run away, and go on"""
    found, w, scene = [], sim.world, sim.scene
    if len(records) != len(w.bodies):
        return [f"{len(records)} records of {len(w.bodies)} objects"]
    for body, record in zip(w.bodies, records, strict=True):
        status, part = int(record["status"]), slice(body.first, body.last)
        if status == RUNAWAY and scene.solver.on_runaway == "go_on":
            away.add(body.index)
        finite = np.isfinite(w.x[part]).all() and np.isfinite(w.v[part]).all()
        if not finite and body.index not in away:
            found.append(f"object {body.name}: not finite, status {status}")
            continue
        if not finite:
            continue
        if w.inertia and status not in (RUNAWAY, NOT_FINITE):  # these tell of the state that was given up
            found += [f"object {body.name}: {c}" for c in _energy_of(sim, body, record)]
        if status == CONVERGED:
            found += [f"object {body.name}: {c}" for c in unsolved(sim, body.index, record)]
        one = scene.integrator.linearizations == 1  # else the residual is that of the last of them
        if one and status == CONVERGED and record["contacts"] and not record["contact_residual"] <= _tolerance(sim):
            found.append(f"object {body.name}: contact residual {record['contact_residual']:g}, told converged")
    return found


def _energy_of(sim: Simulation, body: Body, record: Any) -> list[str]:
    """What is wrong with the kinetic energy of a step that is not told to run away (kernels/energy_balance.cuh)."""
    w, part = sim.world, body.nodes
    kinetic, told = 0.5 * float(w.mass[part] @ (w.v[part] ** 2).sum(axis=1)), float(record["kinetic"])
    if kinetic > MOST:
        return []
    found = []
    if abs(kinetic - told) > 1e-9 * kinetic + 1e-300:
        found.append(f"kinetic energy {kinetic:g} J, told {told:g}")
    size = 10 * float(np.linalg.norm(np.ptp(w.rest[part], axis=0)))
    floor = 0.5 * float(w.mass[part].sum()) * (1e-3 * size / w.dt) ** 2
    bounded = not w.loading and not w.explicit and np.isfinite(record["budget"])
    if bounded and not told <= 2 * max(float(record["budget"]), 0.0) * (1 + 1e-9) + floor:
        found.append(
            f"kinetic energy {told:g} J, more than twice what it was given, {record['budget']:g} J, and not told"
        )
    return found


def _tolerance(sim: Simulation) -> float:
    contact: Any = sim.scene.effects.get("contact")
    return float(contact.tolerance) * (1 + 1e-9) if contact else float("inf")


def _has_one_system(sim: Simulation, index: int) -> bool:
    """Whether a step of an object solves A dv = b once, with the A and b that are there after it."""
    scene, effects = sim.scene, sim.world.bodies[index].effects
    if scene.integrator.linearizations > 1 or scene.integrator.scheme in ("ros2", "central_difference"):
        return False
    return not (
        scene.accuracy or "contact" in scene.effects or scene.attachments or scene.holders or "cavity" in effects
    )


def unsolved(sim: Simulation, index: int, record: Any) -> list[str]:
    """What is left of the linear system of a step that says converged, where there is one system."""
    w, s = sim.world, sim.system
    body = w.bodies[index]
    if not _has_one_system(sim, index) or (record["iterations"] == 0 and record["residual"] == 0):
        return []
    if record["halvings"]:  # the residual is that of the worst of many systems
        return []
    part = slice(body.first, body.last)
    b, y = s.b_material[part].ravel(), s.y[part].ravel()
    matrix = sim.matrix(index)
    product, norm = matrix @ y, float(np.linalg.norm(b))
    left = float(np.linalg.norm(b - product)) / norm if norm > 0 else 0.0
    terms = float(np.linalg.norm(abs(matrix) @ np.abs(y)))
    rounding = 1e-14 * (terms + norm) / norm if norm > 0 else 0.0
    found = []
    if abs(left - record["residual"]) > 1e-6 * left + rounding:
        found.append(f"residual {left:g}, told {record['residual']:g}")
    if record["iterations"] > 0 and not left <= sim.scene.solver.tolerance * (1 + 1e-6) + rounding:
        found.append(f"residual {left:g}, above the tolerance {sim.scene.solver.tolerance:g}, told converged")
    return found


def check(plan: Table, folder: Path, twice: bool = True) -> Run:
    """Runs a plan twice; what does not repeat is a complaint, too."""
    run = one_run(plan, folder)
    if run.refused or run.complaints or not twice:
        return run
    again = one_run(plan, folder)
    for step, (a, b) in enumerate(zip(run.records, again.records, strict=True)):
        names = [
            n
            for n in a.dtype.names
            if n not in TIMED and not np.array_equal(a[n], b[n], equal_nan=a[n].dtype.kind == "f")
        ]
        if names:
            run.complaints.append(f"step {step}: {', '.join(names)} not repeated")
            break
        if not np.array_equal(run.states[step], again.states[step], equal_nan=True):
            run.complaints.append(f"step {step}: positions not repeated")
            break
    return run
