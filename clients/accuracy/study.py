# SPDX-License-Identifier: MIT
"""Measures the points of a scene within a given time, keeps each in points.json as soon as it is there, and goes on."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clients.accuracy.axes import COARSEST, Candidate, SceneValues, candidates, left_out, mesh_settings
from clients.accuracy.errors import add_round, measure, point_of
from clients.accuracy.points import SCENE, Point, Points, Settings, load, save, short_words
from clients.accuracy.runs import LOG_FOLDER, Run, Task, run_point
from clients.accuracy.sources import (
    LINEAR,
    LINEARIZATION,
    MESH,
    MODEL,
    TIME,
    errors_by_source,
    is_rough,
    mesh_error,
    sentence,
)
from clients.accuracy.trajectories import Trajectory, distance, extrapolate, load_trajectory, save_trajectory
from clients.errors import BadInput, ClientError

ROUNDS = 3  # of each point, as far as the time goes
FRAMES = 24  # compared times, at least half as many where the duration allows
PARTS = (4, 8, 16, 32, 64)  # of dt: time steps of references; two of them at least
REFERENCE_SHARE = 0.35  # of the time given, that references may take
LONGEST_SHARE = 0.25  # of the time given, that one point may take before it counts as timed out
FINE_ENOUGH = 1e-6  # uncertainty of the reference over the size of the objects, below which no finer one is made
FINER = 2.2  # times the wall time of a reference that the next finer one takes
SHORTEST_LIMIT = 30.0  # s; a point counts as timed out no sooner, and is tried again when there is more time
START_TIMEOUT = 120.0  # s for the first start, which compiles
NO_TIME = "no time"
ONE_BY_ONE = ("scheme", "model", "preconditioner")  # axes whose settings are refused one by one; others as a whole

Progress = Callable[[float, str], None]  # seconds gone, and what runs


@dataclass(frozen=True)
class Reference:
    """A run to compare with. wall: time of its process [s]; unconverged: its solves that were not exact."""

    settings: Settings
    trajectory: Trajectory
    wall: float
    unconverged: int = 0


class Study:
    """Measures a scene and keeps what it finds in a folder: points.json, and runs/*.npz to compare with.

    Raises BadInput for a scene that the server refuses, a folder that cannot be written to or with points of another
    scene.
    """

    def __init__(self, scene: Path, folder: Path, duration: float | None, device: str, progress: Progress):
        """Reads the scene. duration: simulated in each run [s]; None, to look only: that of the points in the folder"""
        self.folder, self._progress, self._began = folder, progress, time.monotonic()
        for log in folder.glob(f"{LOG_FOLDER}*"):  # of a run that was killed
            shutil.rmtree(log, ignore_errors=True)
        self._what = "the scene is read"
        self._scene_run: Run | None = None
        path = folder / "points.json"
        old = _to_look_at(scene, path) if duration is None else None
        probed, _ = probe(scene, old.device if old is not None and device == "auto" else device, self._tick)
        self.values = SceneValues(probed.scene, probed.device)
        if duration is None:
            assert old is not None
            self.task = Task(scene, self.values.dt, old.duration, old.interval, device)
        else:
            self.task = task_of(scene, self.values.dt, duration, device)
        self.found = resumed(path, _fresh(scene, self.task, probed))
        self._start = probed.wall  # s that a process takes beside its steps
        self._began = time.monotonic()  # what the first start compiles takes none of the time given
        _make(folder)

    def run(self, minutes: float) -> Points:
        """Measures for so many minutes, or until all is measured; 0: only what is there is looked at."""
        self._deadline, self._minutes = self._began + 60 * minutes, minutes
        found = self.found
        if minutes > 0:
            longest = self._longest()
            found.points = [p for p in found.points if p.limit is None or p.limit >= longest]
            found.left_out = []  # what the server refused is asked again: it may be another version
            self._keep()
            self._run_scene()
            self._reference()
            self._measure(Candidate(SCENE, {}))
            wanted = candidates(self.values, found.size)
            missing = [each for each in wanted if not self._measure(each)]
            self._more_rounds()
            found.left_out += [{"axis": c.axis, "settings": c.settings, "reason": NO_TIME} for c in missing]
        self._sources()
        if minutes > 0 or found.points:
            self._keep()
        return found

    def _tick(self) -> None:
        self._progress(time.monotonic() - self._began, self._what)

    def _left(self) -> float:
        return self._deadline - time.monotonic()

    def _longest(self) -> float:
        """Returns the wall time that one point may take before it counts as timed out [s]."""
        return max(SHORTEST_LIMIT, 60 * self._minutes * LONGEST_SHARE)

    def _keep(self) -> None:
        save(self.found, self.folder / "points.json")

    def _run(self, what: str, settings: Settings, timeout: float) -> Run:
        self._what = what
        workers = int(self.values.wants_workers(settings))
        return run_point(self.task, settings, workers, max(timeout, 0.1), self._tick, self.folder)

    def _run_scene(self) -> None:
        """Runs the scene's own settings, first of all: what they take tells what other runs will."""
        if self._kept("scene") is not None and self.found.point({}) is not None:
            return
        run = self._run("the scene as it is", {}, self._left())
        if run.trajectory is None or run.seconds is None:
            raise ClientError(f"the scene could not be run for {self.task.duration:g} s: {run.reason or run.status}")
        self._start = max(0.1, run.wall - run.seconds * self.task.duration)
        self._scene_run = run
        save_trajectory(run.trajectory, self._file("scene"))

    # -- the reference --

    def _reference(self) -> None:
        """Makes references with ever smaller time steps; the finest is kept, and its distance from the one before.

        One that is there is made finer where it is too rough for what the errors tell, and there is time.
        """
        until = time.monotonic() + REFERENCE_SHARE * 60 * self._minutes
        kept, about = self._kept("reference"), self.found.reference
        if kept is not None and about["uncertainty"] is not None:
            self.reference = kept
            if is_rough(self.found):
                self._refine(Reference(about["settings"], kept, about.get("wall", math.inf)), until)
            return
        said: list[str] = []
        doubtful: list[list[Reference]] = []
        for choice in range(len(self.values.references(1))):
            if doubtful and time.monotonic() > until:
                break
            made = self._references(choice, until, said, bool(doubtful))
            if len(made) > 1 and not _unconverged(made):
                return
            doubtful += [made] if len(made) > 1 else []
        if not doubtful:
            why = "; ".join(dict.fromkeys(said)) or "there was no time"
            raise ClientError(f"no two references could be made ({why}); more --minutes or less --duration may help")
        self._take(*min(doubtful, key=_unconverged)[-2:])

    def _references(self, choice: int, until: float, said: list[str], spare: bool) -> list[Reference]:
        """Makes references of one choice of settings, each of which is kept once it is exact, as is the one before.

        spare: there are others to be taken, so that also the first two have to end at `until`
        """
        made: list[Reference] = []
        for parts in PARTS:
            enough = len(made) > 1
            if enough:
                apart = distance(made[-1].trajectory, made[-2].trajectory).error
                if not self._is_time_for_finer(made[-1], until) or apart < FINE_ENOUGH * self.found.size:
                    break
            limit = until - time.monotonic() if enough or spare else self._left()
            found = self._make_reference(parts, choice, limit, said)
            if found is None or (enough and found.unconverged):
                break
            made.append(found)
            if len(made) > 1 and not _unconverged(made):
                self._take(*made[-2:])
        return made

    def _make_reference(self, parts: int, choice: int, limit: float, said: list[str]) -> Reference | None:
        """Runs a reference; None if that failed. said: takes the reason."""
        settings = self.values.references(parts)[choice]
        run = self._run(f"reference with dt / {parts}", settings, limit)
        if run.status != "done" or run.trajectory is None:
            said.append(f"dt / {parts}: {run.reason or run.status}")
            return None
        return Reference(settings, run.trajectory, run.wall, run.unconverged)

    def _is_time_for_finer(self, last: Reference, until: float) -> bool:
        return time.monotonic() + FINER * last.wall <= until

    def _take(self, before: Reference, finest: Reference) -> None:
        """Keeps a reference, and how far it is from the one before."""
        self.reference = finest.trajectory
        self.found.reference = {
            "settings": finest.settings, "uncertainty": distance(finest.trajectory, before.trajectory).error,
            "compared_with": before.settings, "wall": finest.wall, "unconverged": _unconverged([before, finest]),
        }  # fmt: skip
        save_trajectory(finest.trajectory, self._file("reference"))
        self._keep()

    def _refine(self, last: Reference, until: float) -> None:
        """Makes finer references while there is time for them, and for all points once more: these are removed."""
        found = self.found
        seconds = [p.seconds for p in found.points if p.seconds is not None]
        again = sum(self._start + each * self.task.duration for each in seconds)
        while self._is_time_for_finer(last, min(until, self._deadline - again)) and is_rough(found):
            parts = round(self.values.dt / float(last.settings["dt"]))
            choices = self.values.references(parts)
            finer = next((each for each in PARTS if each > parts), None)
            if finer is None or last.settings not in choices:
                return
            made = self._make_reference(finer, choices.index(last.settings), until - time.monotonic(), [])
            if made is None or made.unconverged:
                return
            found.points = []
            self._take(last, made)
            last = made

    # -- points --

    def _measure(self, candidate: Candidate) -> bool:
        """Measures a point unless it is there or refused; returns False if there is no time for it."""
        settings, found = candidate.settings, self.found
        if found.point(settings) is not None or self._is_refused(candidate):
            return True
        scene = found.point({})
        if scene is not None:
            took = (scene.seconds or 0.0) * self.task.duration * candidate.cost
            if self._start + took > self._left():
                return False
        if not settings and self._scene_run is not None:
            run = self._scene_run
        else:
            limit = min(self._longest(), self._left())
            run = self._run(f"{candidate.axis}: {short_words(settings)}", settings, limit)
            if run.status == "timed out" and self._left() <= 0:
                return False
        if run.status == "refused":
            found.left_out.append({"axis": candidate.axis, "settings": settings, "reason": run.reason})
        else:
            self._add(point_of(candidate.axis, settings, run, self.reference, self._sizes()), run)
        self._keep()
        return True

    def _is_refused(self, candidate: Candidate) -> bool:
        """True if the server refused these settings, or the axis as a whole: its first point, and none was taken."""
        refused = [left for left in self.found.left_out if left["axis"] == candidate.axis]
        if any(left["settings"] == candidate.settings for left in refused):
            return True
        taken = any(p.axis == candidate.axis for p in self.found.points)
        return bool(refused) and not taken and candidate.axis not in ONE_BY_ONE

    def _add(self, point: Point, run: Run) -> None:
        self.found.points.append(point)
        if point.status == "timed out":
            point.limit = self._longest()
        role = self._role(point)
        if not role or point.status != "done" or run.trajectory is None:
            return
        save_trajectory(run.trajectory, self._file(role))
        if role in ("coarse", "fine"):
            self._measure_meshes()

    def _role(self, point: Point) -> str:
        """Names the trajectory of a point that others are compared with; "" for the rest."""
        roles = {"scene": {}, "exact_solves": self.values.exact_solves(), "exact_steps": self.values.exact_steps()}
        roles |= {name: mesh_settings(self.values, name == "fine") for name in ("coarse", "fine")}
        found = next((role for role, settings in roles.items() if settings == point.settings), "")
        first = point.axis == "model" and not self._file("model").exists()
        return found or ("model" if first else "")

    def _measure_meshes(self) -> None:
        """Measures all points of the axis mesh from the reference extrapolated to a mesh of size zero."""
        scene, coarse, fine = (self._kept(name) for name in ("scene", "coarse", "fine"))
        if scene is None or (found := mesh_error(coarse, scene, fine)) is None:
            return
        against, power = "reference extrapolated to a mesh of size zero", 2 ** (found[1] or 0.0)
        if found[1] is None:
            assert fine is not None
            goal, against = extrapolate(self.reference, scene, fine, 1.0), "reference extrapolated to the finer mesh"
        elif fine is not None:
            goal = extrapolate(self.reference, scene, fine, power / (power - 1))
        else:
            assert coarse is not None
            goal = extrapolate(self.reference, coarse, scene, 1 / (power - 1))
        for name, trajectory in (("coarse", coarse), ("fine", fine)):
            point = self.found.point(mesh_settings(self.values, name == "fine"))
            if point is not None and trajectory is not None:
                measure(point, trajectory, goal, self._sizes())
                point.against = against
        if (own := self.found.point({})) is not None:
            own.mesh_error = distance(scene, goal).error

    def _more_rounds(self) -> None:
        """Repeats points for the median of their times, those with the fewest rounds first, while there is time."""
        for rounds in range(1, ROUNDS):
            for point in self.found.points:
                if point.status != "done" or len(point.rounds) != rounds or point.seconds is None:
                    continue
                if self._start + point.seconds * self.task.duration > self._left():
                    continue
                what = f"round {rounds + 1} of {point.axis}: {short_words(point.settings)}"
                run = self._run(what, point.settings, self._left())
                if run.status == "done":
                    add_round(point, run)
                    self._keep()

    # -- what follows from them --

    def _sources(self) -> None:
        own, values = self.found.point({}), self.values
        scene = self._kept("scene") if own is not None and own.status == "done" else None
        chain = {LINEAR: "exact_solves", LINEARIZATION: "exact_steps", TIME: "reference"}
        if not values.exact_solves():
            del chain[LINEAR]
        if not values.exact_steps():
            del chain[LINEARIZATION]
        sources, rest = errors_by_source(scene, {name: self._kept(role) for name, role in chain.items()})
        missing = [name for name in chain if sources[name] is None]
        mesh = None if scene is None else mesh_error(self._kept("coarse"), scene, self._kept("fine"))
        if mesh is not None:
            sources[MESH] = mesh[0]
        elif mesh_settings(values, fine=True):
            missing.append(MESH)
        if scene is not None and (model := self._kept("model")) is not None:
            sources[MODEL] = distance(scene, model).error
        self.found.sources = sources
        self.found.at_least = [MESH] if mesh is not None and mesh[1] is None else []
        self.found.sentence = sentence(self.found, missing, rest)
        asked = [left for left in self.found.left_out if left["settings"]]
        without = [{"axis": axis, "settings": {}, "reason": reason} for axis, reason in left_out(self.values)]
        self.found.left_out = asked + without

    def _sizes(self) -> dict[str, float]:
        return {name: o["size"] for name, o in self.found.objects.items()}

    def _file(self, role: str) -> Path:
        return self.folder / "runs" / f"{role}.npz"

    def _kept(self, role: str) -> Trajectory | None:
        return load_trajectory(self._file(role))


def check_scene(scene: Path) -> None:
    """Raises BadInput if there is no such file, and it cannot be a scene that comes with the server (gallery/NAME)."""
    if not scene.is_file() and scene.parts[:-1] != ("gallery",):
        raise BadInput(f"{scene}: is a folder, allowed is a scene" if scene.is_dir() else f"{scene}: no such file")


def probe(scene: Path, device: str, tick: Callable[[], None] = lambda: None) -> tuple[Run, str]:
    """Runs one step of a scene; returns the run and the digest of its points. Raises BadInput, ClientError."""
    check_scene(scene)
    run = run_point(Task(scene, 1.0, 1.0, 1.0, device), {}, timeout=START_TIMEOUT, tick=tick)
    if run.status == "refused":
        raise BadInput(run.reason)
    if not run.scene or run.trajectory is None:
        raise ClientError(f"{scene}: could not be run: {run.reason}")
    return run, digest(run.scene, run.trajectory)


def task_of(scene: Path, dt: float, duration: float, device: str) -> Task:
    """Returns the task whose duration and interval are whole numbers of every time step. Raises BadInput."""
    grid = COARSEST * dt
    if duration < grid * (1 - 1e-9):
        raise BadInput(
            f"--duration {duration:g}: allowed is {grid:g} s at least, {COARSEST} time steps of the scene ({dt:g} s)"
        )
    interval = grid * max(1, int(duration / grid / FRAMES * (1 + 1e-9)))
    return Task(scene, dt, interval * int(duration / interval * (1 + 1e-9)), interval, device)


def resumed(path: Path, fresh: Points) -> Points:
    """Returns the points of a file, to go on with, or `fresh` if there is none. Raises BadInput for other points."""
    if not path.exists():
        return fresh
    old = load(path)
    for what in ("digest", "duration", "interval", "device"):
        if getattr(old, what) != getattr(fresh, what):
            words = {
                "digest": "the scene has changed since", "duration": f"they are of {old.duration:g} s simulated",
                "interval": f"they were compared every {old.interval:g} s",
            }  # fmt: skip
            raise BadInput(
                f"{path.parent} holds points that this run cannot go on with: "
                f"{words.get(what, f'they were measured on another device ({old.device})')}; "
                "give another --out, or remove the folder to begin anew"
            )
    if old.machine.get("processor") != fresh.machine.get("processor"):
        raise BadInput(
            f"{path.parent} holds points of another machine ({old.machine.get('processor')}); give another --out, or "
            "remove the folder to begin anew"
        )
    old.scene, old.objects = fresh.scene, fresh.objects
    return old


def _unconverged(made: list[Reference]) -> int:
    """Returns the number of solves of the last two that did not reach their tolerance."""
    return sum(each.unconverged for each in made[-2:])


def _to_look_at(scene: Path, path: Path) -> Points:
    """Reads points that are to be drawn only. Raises BadInput if there are none."""
    check_scene(scene)
    if not path.exists():
        raise BadInput(f"{path}: no such file, so there is nothing to draw; --minutes above 0 measures")
    return load(path)


def _make(folder: Path) -> None:
    """Makes the folder for the results. Raises BadInput."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{folder}: cannot be made: {error.strerror}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadInput(f"{folder}: cannot be written to")


def _fresh(scene: Path, task: Task, probed: Run) -> Points:
    assert probed.trajectory is not None
    own = SceneValues(probed.scene, probed.device).own()
    rest = probed.trajectory.rest
    objects: dict[str, dict[str, float]] = {
        name: {"size": float(np.ptp(x, axis=0).max()), "nodes": len(x), "elements": probed.elements[name]}
        for name, x in rest.items()
    }
    return Points(
        str(scene), digest(probed.scene, probed.trajectory), task.duration, task.interval, own, probed.device,
        machine(probed.software), objects=objects,
    )  # fmt: skip


def digest(resolved: dict[str, Any], trajectory: Trajectory) -> str:
    """Returns a digest of a resolved scene, but for its name, what its log holds and what only viewers see, and of the
    nodes at rest."""
    kept = {key: value for key, value in resolved.items() if key not in ("name", "record")}
    kept["object"] = [{key: value for key, value in o.items() if key != "skin"} for o in kept.get("object", ())]
    found = hashlib.sha256(json.dumps(kept, sort_keys=True).encode())
    for name, rest in sorted(trajectory.rest.items()):
        found.update(name.encode() + rest.tobytes())
    return found.hexdigest()


def machine(software: str) -> dict[str, str]:
    """Describes this machine."""
    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), processor)
    except OSError:
        pass
    return {
        "processor": processor, "cores": str(os.cpu_count() or 1), "system": platform.platform(), "software": software,
    }  # fmt: skip
