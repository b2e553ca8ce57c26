# SPDX-License-Identifier: MIT
"""Others on the same axes: the beam of neo_hookean.toml, each at several settings beside the small steps of its law.

A peer runs in a Python of its own, in which it is installed (`--peer-python`), by a script beside this file. It reads
JSON: dt, substeps [steps of a frame], frames, gravity, density, young, poisson, device, settings, tets, held (numbers
of nodes), x and mass of the nodes. It writes x (frames, nodes, 3) [m], seconds (frames,) of processor time of the whole
process, on a GPU of wall time, version, notes and why it diverged, if it says so. SciPy with CHOLMOD is there always:
beam.toml, one sparse direct solve a step.
"""

import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sim_server.simulation import Simulation
from tests.bench.accuracy.axes import EXPLICIT_NAME, SCHEMES
from tests.bench.accuracy.cases import BEAM, RUBBER, Settings, usual
from tests.bench.accuracy.motion import LIMIT, Motion, error, exact_step, reference, rms
from tests.bench.accuracy.points import measured
from tests.bench.cpu.scipy_step import ScipyStep

HERE = Path(__file__).parent
FRAME = RUBBER.dt
POISSON, DENSITY = 0.45, 1000.0  # of the scene
US = "ours"
MODULES = {
    "MuJoCo": "mujoco",
    "Newton": "newton",
    "PyBullet": "pybullet",
}  # of those that have a script beside this file
WITHOUT_SCRIPT = ("Genesis",)
Row = dict[str, Any]


@dataclass(frozen=True)
class Way:
    """Somebody's settings. young [Pa]; dt [s]; settings: of the script; limit: dt [s] of its own small steps, by its
    settings `limit_by`; 0: ours are those of its law."""

    who: str
    series: str
    value: str
    young: float
    dt: float
    script: str
    module: str
    settings: dict[str, Any] = field(hash=False)
    limit: float = 0.0
    limit_by: dict[str, Any] = field(default_factory=dict, hash=False)
    on_gpu: bool = False

    @property
    def substeps(self) -> int:
        return round(FRAME / self.dt)

    def small_steps(self, more: int = 1) -> "Way":
        """What its points are compared with; more: so many times longer."""
        name = f"limit, {1e3 * more * self.limit:g} ms"
        return replace(self, series=name, value="", dt=more * self.limit, settings=self.limit_by)


def _mujoco(series: str, young: float, milliseconds: Sequence[float], **settings: str) -> list[Way]:
    limit: dict[str, Any] = {"limit": 2.5e-4 if young < 5e6 else 1.25e-4, "limit_by": {"integrator": "RK4"}}
    return [
        Way("MuJoCo", series, f"{ms:g} ms", young, 1e-3 * ms, "peers_mujoco.py", "mujoco", settings, **limit)
        for ms in milliseconds
    ]


def _semi_implicit(young: float, milliseconds: Sequence[float]) -> list[Way]:
    settings = {"solver": "semi-implicit"}
    limit: dict[str, Any] = {"limit": 2.5e-4 if young < 5e6 else 1.25e-4, "limit_by": settings, "on_gpu": True}
    return [
        Way("Newton", "semi-implicit", f"{ms:g} ms", young, 1e-3 * ms, "peers_newton.py", "newton", settings, **limit)
        for ms in milliseconds
    ]


def _vbd(young: float, ms: float, iterations: Sequence[int]) -> list[Way]:
    return [
        Way("Newton", f"VBD, {ms:g} ms", f"{number} iterations", young, 1e-3 * ms, "peers_newton.py", "newton",
            {"solver": "VBD", "iterations": number}, on_gpu=True)
        for number in iterations
    ]  # fmt: skip


def _pybullet(young: float, milliseconds: Sequence[float]) -> list[Way]:
    limit: dict[str, Any] = {"limit": 2.5e-4 if young < 5e6 else 1.25e-4}
    return [
        Way("PyBullet", "neo-Hookean", f"{ms:g} ms", young, 1e-3 * ms, "peers_pybullet.py", "pybullet", {}, **limit)
        for ms in milliseconds
    ]


def ways(young: float) -> list[Way]:
    """Of a stiffness [Pa]: explicit steps as long as is stable and half of that, one that is not; all the others."""
    soft = young < 5e6
    return [
        *_mujoco("Euler", young, (2.0, 1.0, 0.5) if soft else (1.0, 0.5, 0.25), integrator="Euler"),
        *_mujoco("RK4", young, (4.0, 2.0, 1.0) if soft else (1.0, 0.5, 0.25), integrator="RK4"),
        *_mujoco("discrete, CG", young, (20.0, 10.0, 5.0), integrator="discrete", solver="CG"),
        *_mujoco("discrete, Newton", young, (20.0,), integrator="discrete", solver="Newton"),
        *_pybullet(young, (2.0, 1.0, 0.5) if soft else (1.0, 0.5, 0.25)),
        *_semi_implicit(young, (2.0, 1.0, 0.5) if soft else (1.0, 0.5, 0.25)),
        *_vbd(young, 20.0, (10, 30, 100)), *_vbd(young, 5.0, (20,)), *_vbd(young, 2.0, (10,)),
    ]  # fmt: skip


OURS: dict[str, tuple[tuple[float, ...], Settings]] = {  # time steps [ms] and settings beside them
    "backward Euler": ((20.0, 10.0, 5.0), {}),
    "Newmark, 3 linearizations": (
        (20.0, 10.0, 5.0),
        SCHEMES["Newmark, 3 linearizations"] | {"solver.tolerance": "1e-4"},
    ),
    "Newmark": ((10.0, 5.0, 2.0), SCHEMES["Newmark"] | {"solver.tolerance": "1e-4"}),
    "ros2, factor": ((20.0, 10.0, 5.0), SCHEMES["ros2, factor"]),
    EXPLICIT_NAME: ((20.0, 1.0, 0.5), SCHEMES[EXPLICIT_NAME]),
}
STIFFNESSES = (1e6, 1e7)  # Pa
SCIPY_STEPS = (0.02, 0.01, 0.005)  # s


@cache
def missing(python: Path | None, module: str) -> str:
    """Why a peer cannot run, '' if it can."""
    if python is None:
        return "no --peer-python"
    try:
        found = subprocess.run([str(python), "-c", f"import {module}"], capture_output=True, text=True)
    except OSError as why:
        return str(why)
    return "" if found.returncode == 0 else f"no {module} there"


@dataclass
class Made:
    """What a peer wrote."""

    motion: Motion
    seconds: float | None  # of a simulated second
    version: str
    notes: str


@cache
def run(way: Way, device: str, python: str) -> Made:
    """A peer's motion. What it says last is why it failed."""
    frames = round(RUBBER.seconds / FRAME)
    with TemporaryDirectory() as folder:
        given, written = Path(folder) / "problem.json", Path(folder) / "result.npz"
        given.write_text(json.dumps(_problem(way, device, frames)))
        command = [python, str(HERE / way.script), str(given), str(written)]
        try:
            result = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=5 * LIMIT)
        except subprocess.TimeoutExpired:
            return _without(way, "timed out", f"after {5 * LIMIT:g} s")
        if result.returncode:
            return _without(way, "failed", (result.stderr or result.stdout).strip().split("\n")[-1])
        found = np.load(written)
    x, seconds, warned = np.asarray(found["x"], dtype=float), found["seconds"], str(found["diverged"])
    motion = Motion(
        FRAME, x, _simulation().world.rest, len(_simulation().world.bodies[0].mesh.tets), np.empty(0), device
    )
    if warned or not _well(x):
        motion.status, motion.reason = "diverged", warned
    return Made(motion, float(np.sum(seconds)) / RUBBER.seconds, str(found["version"]), str(found["notes"]))


def _well(x: Any) -> bool:
    """Finite, and no further away than a body can be that hangs at its held end."""
    return bool(np.isfinite(x).all() and np.abs(x).max() < 3 * RUBBER.length)


def _without(way: Way, status: str, reason: str) -> Made:
    none = np.empty((0, 0, 3))
    return Made(Motion(FRAME, none, np.empty((0, 3)), 0, np.empty(0), "cpu", status, reason), None, "", "")


@cache
def _simulation() -> Simulation:
    return Simulation.load(RUBBER.file)


def _problem(way: Way, device: str, frames: int) -> dict[str, Any]:
    w = _simulation().world
    body = w.bodies[0]
    return {
        "dt": way.dt, "substeps": way.substeps, "frames": frames, "gravity": [0, -9.81, 0], "density": DENSITY,
        "young": way.young, "poisson": POISSON, "device": "cpu" if device == "cpu" else "cuda:0",
        "settings": way.settings,
        "tets": (body.tets - body.first).tolist(), "held": np.flatnonzero(w.free == 0).tolist(),
        "x": w.x.tolist(), "mass": w.mass.tolist(),
    }  # fmt: skip


def row(way: Way, device: str, python: str) -> Row:
    """A point. step error [m]: against steps of backward Euler of this length solved exactly, of VBD."""
    made = run(way, device, python)
    if way.limit:
        true, coarser = (run(way.small_steps(more), "cpu", python).motion for more in (1, 2))
        apart, exact = error(true, coarser), None
    else:
        found = reference(RUBBER, with_young(way.young))
        true, apart = found.motion, found.apart
        exact = exact_step(RUBBER, with_young(way.young) | RUBBER.stepped(way.dt))
    return {
        "device": device, "who": way.who, "E MPa": way.young / 1e6, "series": way.series, "value": way.value,
        "settings": way.settings | {"dt": way.dt}, "status": made.motion.status, "reason": made.motion.reason,
        "error": error(made.motion, true), "rms": rms(made.motion, true), "apart": apart, "length": RUBBER.length,
        "step error": None if exact is None else error(made.motion, exact),
        "seconds": made.seconds, "version": made.version, "notes": made.notes,
    }  # fmt: skip


def with_young(young: float) -> Settings:
    """Overrides of the scene."""
    return {} if young == 1e6 else {"object.beam.effects.stable_neo_hookean.young": f"{young:g}"}


def our_rows(young: float, device: str, rounds: int) -> list[Row]:
    """Ours on the same axes."""
    changed, found = with_young(young), []
    for series, (milliseconds, more) in OURS.items():
        for ms in milliseconds:
            settings = usual(changed, more, RUBBER.stepped(1e-3 * ms))
            made = measured(RUBBER, settings, device, rounds, reference(RUBBER, changed), against_steps=not changed)
            names = {"device": device, "who": US, "E MPa": young / 1e6, "series": series, "value": f"{ms:g} ms"}
            found.append(names | made | {"version": "", "notes": ""})
    return found


# --- SciPy ------------------------------------------------------------------------------------------------------------


def scipy_row(dt: float) -> Row:
    """One factorization by CHOLMOD a step, as one would write it."""
    settings: Settings = BEAM.stepped(dt)
    sim = Simulation.load(BEAM.file, [f"{key}={value}" for key, value in settings.items()])
    step, frames, seconds = ScipyStep(sim), [], 0.0
    each = round(BEAM.dt / dt)
    for number in range(1, round(BEAM.seconds / dt) + 1):
        seconds += step.step()["whole"]
        if number % each == 0:
            frames.append(step.x.copy())
    motion = Motion(BEAM.dt, np.array(frames), sim.world.rest, len(step.tets), np.empty(0), "cpu")
    true = reference(BEAM)
    return {
        "device": "cpu", "who": "SciPy", "E MPa": 1.0, "series": "CHOLMOD each step", "value": f"{1e3 * dt:g} ms",
        "settings": {"dt": dt}, "status": "done", "reason": "", "length": BEAM.length,
        "error": error(motion, true.motion), "rms": rms(motion, true.motion), "apart": true.apart,
        "step error": error(motion, exact_step(BEAM, {})) if dt == BEAM.dt else None,
        "seconds": seconds / BEAM.seconds, "version": "", "notes": "",
    }  # fmt: skip
