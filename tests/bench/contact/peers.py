# SPDX-License-Identifier: MIT
"""The same blocks over a floor here and in others' simulators: what is the same, the settings, and what is looked at.

A peer runs in a Python of its own, in which it is installed (`--peer-python`), by a script beside this file. It reads
JSON: dt, substeps [steps of a frame], frames, gravity, friction, density, young, poisson, distance [m] at which contact
begins, device, settings, tets, and bodies with x, mass (of their nodes) and v. It writes x (frames, all nodes, 3),
seconds (frames,) of processor time of the whole process, on a GPU of wall time, floor (frames,) normal force on the
floor [N], version and notes.
"""

import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import CELLS, DT, LOCKSTEP, SIZE, G, Reals, Row, times
from tests.contact.scenes import YOUNG, block, floor, over

FRICTION, POISSON, DENSITY = 0.5, 0.3, 1000.0
DISTANCE = 0.001  # at which contact begins [m]
TETS = 540
HERE = Path(__file__).parent
OURS = "ours"


@dataclass(frozen=True)
class Case:
    """What happens to the blocks. frames: of 1/60 s; looked_at: the last so many; angle: beyond the friction angle."""

    name: str
    frames: int
    looked_at: int = 60
    bodies: int = 1
    height: float = 0.0  # over the distance [m]
    speed: float = 0.0
    friction: float = FRICTION
    degrees: float | None = None

    @property
    def gravity(self) -> tuple[float, float, float]:
        angle = 0.0 if self.degrees is None else np.arctan(self.friction) + np.radians(self.degrees)
        return (float(G * np.sin(angle)), float(-G * np.cos(angle)), 0.0)


DROP = Case("drop", 90, height=0.05)
SLIDE = Case("slide", 60, 10, speed=1.0)
FREE = Case("slide without friction", 30, 15, speed=1.0, friction=0.0)
STEEP = Case("slope, 0.5 degrees below the limit", 90, 30, degrees=-0.5)
FLAT = Case("slope, 5 degrees below the limit", 90, 30, degrees=-5.0)
STACK = Case("stack of 4", 90, 30, bodies=4)
CASES = (DROP, SLIDE, FREE, STEEP, FLAT, STACK)


@dataclass(frozen=True)
class Way:
    """Somebody's settings. substeps: steps of 1/60 s; script: of a peer; module: what its Python must have."""

    who: str
    name: str
    substeps: int
    settings: dict[str, Any] = field(default_factory=dict)
    script: str = ""
    module: str = ""
    on_gpu: bool = True


MUJOCO: dict[str, Any] = {  # the contact of its own example of a soft bar on a floor, its advice against slow slip
    "integrator": "discrete", "solver": "Newton", "iterations": 100, "tolerance": 1e-10, "impratio": 100,
    "solref": "0.01 1", "solimp": "0.95 0.99 0.0001 0.5 2",
}  # fmt: skip
NEWTON: dict[str, Any] = {"ke": 1e5, "kd": 0.0, "friction_epsilon": 0.01, "gap": 0.01}  # as in its soft examples
WAYS = (
    Way(OURS, "default", 1),
    Way(OURS, "8 steps a frame", 8),
    Way("MuJoCo", "1 step a frame", 1, MUJOCO, "peer_mujoco.py", "mujoco", on_gpu=False),
    Way("MuJoCo", "8 steps a frame", 8, MUJOCO, "peer_mujoco.py", "mujoco", on_gpu=False),
    Way("Newton VBD", "10 steps a frame, 10 iterations", 10, NEWTON | {"iterations": 10},
        "peer_newton.py", "newton"),
    Way("Newton VBD", "10 steps a frame, 50 iterations, sharper friction", 10,
        NEWTON | {"iterations": 50, "friction_epsilon": 1e-3}, "peer_newton.py", "newton"),
)  # fmt: skip


@dataclass
class Motion:
    """x: (frames + 1, bodies, nodes, 3) [m]; seconds: (frames,); floor: (frames,) [N]; mass, rest: of a body's nodes.

    loop: (frames,) seconds of the loop alone, without what makes factors; of ours
    """

    x: Reals
    seconds: Reals
    floor: Reals
    mass: Reals
    rest: Reals
    version: str
    notes: str = ""
    loop: Reals | None = None

    @property
    def middle(self) -> Reals:
        """Centres of mass, (frames + 1, bodies, 3)."""
        return np.asarray(np.einsum("n,fbni->fbi", self.mass / self.mass.sum(), self.x))


def missing(python: str | None, module: str) -> str:
    """Why a peer cannot run, '' if it can."""
    if python is None:
        return "no --peer-python"
    try:
        found = subprocess.run([python, "-c", f"import {module}"], capture_output=True, text=True)
    except OSError as error:
        return str(error)
    return "" if found.returncode == 0 else f"no {module} there"


def simulation(case: Case, way: Way, device: str) -> Simulation:
    """Ours; a peer gets its nodes, tetrahedra and masses from it."""
    blocks = [
        block(case.friction, CELLS[TETS], SIZE, name=f"b{k}",
              at=(0.003 * k, DISTANCE + case.height + k * (SIZE[1] + DISTANCE), 0.002 * k))
        for k in range(case.bodies)
    ]  # fmt: skip
    contact = {"thickness": DISTANCE} | way.settings
    return over(floor(case.friction), objects=blocks, velocity=(case.speed, 0, 0), dt=DT / way.substeps,
                gravity=case.gravity, contact=contact, solver=LOCKSTEP, device=device)  # fmt: skip


def _ours(case: Case, way: Way, device: str) -> Motion:
    sim = simulation(case, way, device)
    driver, shape = Driver(sim), (case.bodies, -1, 3)
    x, seconds, loop, force = [sim.fetch().x.reshape(shape).copy()], [], [], []
    for _ in range(case.frames):
        begun = time.process_time()
        records = driver.advance(way.substeps)
        process = time.process_time() - begun
        loop.append(1e-3 * float(times(records[:: case.bodies], device).sum()))
        seconds.append(process if device == "cpu" else loop[-1])
        force.append(-float(driver.reactions[-case.bodies :, 0, 1].sum()))
        x.append(sim.fetch().x.reshape(shape).copy())
    mass, rest = _of_a_body(sim)
    return Motion(np.array(x), np.array(seconds), np.array(force), mass, rest, "", loop=np.array(loop))


def _of_a_body(sim: Simulation) -> tuple[Reals, Reals]:
    body = sim.world.bodies[0]
    return sim.world.mass[body.nodes], sim.world.rest[body.nodes]


def _theirs(case: Case, way: Way, device: str, python: str) -> Motion:
    sim = simulation(case, Way(OURS, "", 1), "cpu")
    w, first = sim.world, sim.world.bodies[0]
    problem = {
        "dt": DT / way.substeps, "substeps": way.substeps, "frames": case.frames, "gravity": case.gravity,
        "friction": case.friction, "density": DENSITY, "young": YOUNG, "poisson": POISSON, "distance": DISTANCE,
        "device": "cpu" if device == "cpu" else "cuda:0", "settings": way.settings,
        "tets": (first.tets - first.first).tolist(),
        "bodies": [{"x": w.x[b.nodes].tolist(), "mass": w.mass[b.nodes].tolist(), "v": [case.speed, 0, 0]}
                   for b in w.bodies],
    }  # fmt: skip
    with TemporaryDirectory() as folder:
        given, written = Path(folder) / "problem.json", Path(folder) / "result.npz"
        given.write_text(json.dumps(problem))
        command = [python, str(HERE / way.script), str(given), str(written)]
        result = subprocess.run(command, capture_output=True, text=True, cwd=folder)  # MuJoCo leaves a log there
        if result.returncode:
            raise RuntimeError((result.stderr or result.stdout).strip().split("\n")[-1])
        found = np.load(written)
        x = np.concatenate([w.x[None], found["x"]]).reshape(case.frames + 1, case.bodies, -1, 3)
        mass, rest = _of_a_body(sim)
        return Motion(x, found["seconds"], found["floor"], mass, rest, str(found["version"]), str(found["notes"]))


def row(case: Case, way: Way, device: str, python: str = "") -> Row:
    """What there is to see in one case."""
    began = time.perf_counter()
    made = _theirs(case, way, device, python) if way.script else _ours(case, way, device)
    found: Row = {
        "case": case.name, "who": way.who, "settings": way.name, "device": device, "version": made.version,
        "dt ms": 1e3 * DT / way.substeps, **LOOKED_AT[case.name](case, made, DT / way.substeps),
        "ms a step": 1e3 * float(np.median(made.seconds)) / way.substeps,
        "ms a frame": 1e3 * float(np.median(made.seconds)), "most ms a frame": 1e3 * float(made.seconds.max()),
        "loop ms a frame": None if made.loop is None else 1e3 * float(np.median(made.loop)),
        "notes": made.notes, "seconds": time.perf_counter() - began,
    }  # fmt: skip
    return found


# --- what is looked at ------------------------------------------------------------------------------------------------


def _depths(made: Motion) -> Reals:
    """By how much the lowest node is nearer to the floor than the distance [mm], (frames,)."""
    return np.asarray(1e3 * (DISTANCE - made.x[1:, ..., 1].min(axis=(1, 2))))


def _creep(case: Case, made: Motion) -> float:
    """Of the centre of the last body in the frames that are looked at [mm/s]."""
    moved = made.middle[-1, -1] - made.middle[-1 - case.looked_at, -1]
    return 1e3 * float(np.linalg.norm(moved)) / (case.looked_at * DT)


def _drop(case: Case, made: Motion, dt: float) -> Row:
    depths, weight = _depths(made), float(made.mass.sum()) * G
    return {
        "deepest mm": float(max(0.0, depths.max())), "at rest mm": float(depths[-1]),
        "floor / weight": float(made.floor[-10:].mean()) / weight, "creep mm/s": _creep(case, made),
    }  # fmt: skip


def _slide(case: Case, made: Motion, dt: float) -> Row:
    stop, known = float(made.middle[-1, 0, 0] - made.middle[0, 0, 0]), 1 / (2 * case.friction * G) - dt / 2
    return {"stop m": stop, "known m": known, "error": stop / known - 1, "creep mm/s": _creep(case, made)}


def _free(case: Case, made: Motion, dt: float) -> Row:
    middle = made.middle[:, 0, 0]
    return {"speed m/s": float(middle[-1] - middle[-2]) / DT, "known m/s": case.speed}


def _slope(case: Case, made: Motion, dt: float) -> Row:
    return {"creep mm/s": _creep(case, made), "at rest mm": float(_depths(made)[-1])}


def _stack(case: Case, made: Motion, dt: float) -> Row:
    nearer = [_nearer(made, level) for level in range(case.bodies - 1)]
    return {
        "floor mm": float(_depths(made)[-1]), "between mm": max(nearer), "creep of the top mm/s": _creep(case, made),
        "stands": "yes" if made.x[-1, -1, :, 1].min() > (case.bodies - 1.5) * SIZE[1] else "**no**",
    }  # fmt: skip


def _nearer(made: Motion, level: int) -> float:
    """By how much the lowest node of the upper of two bodies is nearer to the lower one's top face than the distance.

    The top face: its nodes, with straight lines in between. [mm], at the end.
    """
    from scipy.interpolate import LinearNDInterpolator

    y, end = made.rest[:, 1], made.x[-1]
    top, bottom = end[level][y > y.max() - 1e-9], end[level + 1][y < y.min() + 1e-9]
    surface = LinearNDInterpolator(top[:, [0, 2]], top[:, 1])(bottom[:, [0, 2]])
    return 1e3 * float(np.nanmax(DISTANCE - (bottom[:, 1] - surface)))


LOOKED_AT: dict[str, Callable[[Case, Motion, float], Row]] = {
    DROP.name: _drop, SLIDE.name: _slide, FREE.name: _free, STEEP.name: _slope, FLAT.name: _slope, STACK.name: _stack,
}  # fmt: skip
