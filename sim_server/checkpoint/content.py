# SPDX-License-Identifier: MIT
"""Makes checkpoints of a simulation that stands still, and puts them back into one that has made no steps.

A checkpoint has the arrays that steps carry on (state/arrays.py), pushes and grabs, where clients want obstacles, step
and time, and under the policies by which a run repeats (never, every-N, lockstep-D) the factors in use and the matrices
of jobs in flight. On one build a run goes on to the bit as if it had not been interrupted. Under async and adaptive the
first factor has to come first, as after a start. What `auto` has measured is not kept.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from protocol.factor import Factor, FactorPattern
from protocol.refused import Refused
from sim_server.checkpoint.file import Checkpoint
from sim_server.errors import InputError
from sim_server.scene import Scene, earlier_defaults
from sim_server.simulation import Simulation
from sim_server.state.arrays import state_arrays
from sim_server.state.code import build_id
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Job

if TYPE_CHECKING:
    from sim_server.effects.touch import Interaction

PATTERN = ("permutation", "super_start", "row_start", "rows")
Point = tuple[float, float, float]


class Entry(BaseModel):
    """A table of the manifest; other keys and types are refused."""

    model_config = ConfigDict(extra="forbid", strict=False)


class FactorEntry(Entry):
    step: int
    worker: str
    seconds: float
    remedy: str
    method: str


class JobEntry(Entry):
    step: int
    method: str


class BodyEntry(Entry):
    name: str
    frozen: bool
    kind: int
    probe: int
    factor: FactorEntry | None = None
    job: JobEntry | None = None


class TouchEntry(Entry):
    id: int
    client: str
    object: str
    point: Point
    radius: float
    duration: float
    force: Point
    target: Point
    stiffness: float
    limit: float
    start: float


class Manifest(Entry):
    """digest: of the scene with all defaults and overrides, `resolved`. start_time: of the simulation at step 0 [s].
    parameters: that were set since, by key, as TOML."""

    format: str
    version: int
    software: str
    device: str
    build: str
    scene: str
    digest: str
    resolved: dict[str, Any]
    step: int
    start_time: float
    bodies: list[BodyEntry]
    interactions: list[TouchEntry]
    last_interaction: int
    parameters: dict[str, str]


@dataclass(frozen=True)
class SavedFactors:
    """Of a checkpoint: factors in use and jobs in flight."""

    factors: list[Factor]
    jobs: list[Job]


def digest(resolved: dict[str, Any]) -> str:
    """Returns a digest of the scene with all defaults and overrides, but for what a log is to hold."""
    table = {k: v for k, v in resolved.items() if k != "record"}
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()


def capture(simulation: Simulation, driver: Driver, software: str) -> Checkpoint:
    """Returns a checkpoint; all arrays are copies. While the loop stands still between two steps."""
    engine, touch = simulation.engine, simulation.touch
    arrays = {f"state/{a.name}": a.read() for a in state_arrays(simulation)}
    for k, mover in enumerate(simulation.movers):
        arrays |= {f"mover{k}/{name}": value.copy() for name, value in mover.given().items()}
    interactions = touch.alive() if touch else []
    for a in interactions:
        arrays |= {f"touch/{a.id}/nodes": a.nodes, f"touch/{a.id}/offset": np.ascontiguousarray(a.offset)}
    bodies = []
    for state in driver.bodies:
        settings, name = engine.settings(state.body.index), state.body.name
        entry = BodyEntry(name=name, frozen=state.frozen, kind=settings.kind, probe=settings.probe)
        if (factor := state.factors.kept) is not None:
            entry.factor = FactorEntry(
                step=factor.step, worker=factor.worker, seconds=factor.seconds, remedy=factor.remedy,
                method=factor.method,
            )  # fmt: skip
            arrays |= {f"factor/{name}/{part}": getattr(factor.pattern, part) for part in PATTERN}
            arrays[f"factor/{name}/values"] = factor.values
        if not driver.policy.free and state.job.matrix is not None:
            step, values = state.job.matrix
            method = driver.method(state.body.index, step)
            if simulation.epoch(name, step) == simulation.epoch(name, engine.step):  # another one has another pattern
                entry.job = JobEntry(step=step, method=method.name if method else "")
                blocks = simulation.system.body_values(state.body.first, state.body.last)
                arrays[f"job/{name}/matrix"] = values[: len(blocks)].copy() if values.ndim == 3 else values.copy()
        bodies.append(entry)
    manifest = Manifest(
        format="", version=0, software=software, device=simulation.world.backend.name,
        build=build_id(simulation), scene=simulation.scene.name, digest=digest(simulation.scene.resolved()),
        resolved=simulation.scene.resolved(), step=engine.step, start_time=engine.loop.start_time, bodies=bodies,
        interactions=[_touch_entry(a) for a in interactions], last_interaction=touch.last_id if touch else 0,
        parameters=simulation.parameters.changed,
    )  # fmt: skip
    return Checkpoint(manifest.model_dump(exclude={"format", "version"}), arrays)


def manifest_of(checkpoint: Checkpoint) -> Manifest:
    """Returns the manifest, checked. Raises InputError."""
    try:
        return Manifest.model_validate(checkpoint.manifest)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"manifest.json: {where} = {str(first['input'])[:80]!r}: {first['msg']}") from None


def restore(simulation: Simulation, checkpoint: Checkpoint) -> Manifest:
    """Puts a simulation that has made no step where the checkpoint was made; factors are for `restore_factors`.

    Raises InputError if the checkpoint is of another scene or device, or damaged.
    """
    manifest, engine, touch = manifest_of(checkpoint), simulation.engine, simulation.touch
    if manifest.device != simulation.world.backend.name:
        raise InputError(f"made on a {manifest.device}, this is a {simulation.world.backend.name}: --device")
    if manifest.digest != digest(now := simulation.scene.resolved()):
        saved = _as_of_this_version(manifest.resolved)
        if digest(saved) != digest(now):
            raise InputError(f"of another scene ({_differences(saved, now)})")
    arrays = [a for a in state_arrays(simulation) if not a.added or f"state/{a.name}" in checkpoint.arrays]
    values = [checkpoint.array(f"state/{a.name}", now.dtype, now.shape) for a in arrays for now in [a.read()]]
    known = {f"state/{a.name}" for a in arrays}
    if other := [name for name in checkpoint.arrays if name.startswith("state/") and name not in known]:
        raise InputError(f"array {other[0]!r} is not known to this version")
    interactions = [_interaction(simulation, checkpoint, entry) for entry in manifest.interactions]
    if interactions and touch is None:
        raise InputError("manifest.json: interactions in a scene that takes none")
    try:
        if manifest.parameters:
            simulation.parameters.set(manifest.parameters)
    except ValueError as error:
        raise InputError(f"manifest.json: parameters: {error}") from None
    engine.prepare()
    for array, value in zip(arrays, values, strict=True):
        array.write(value)
    for k, mover in enumerate(simulation.movers):
        now = mover.given()
        mover.give({name: checkpoint.array(f"mover{k}/{name}", a.dtype, a.shape) for name, a in now.items()})
    if touch is not None:
        touch.last_id = manifest.last_interaction
        if interactions:
            touch.restore(interactions)
    engine.resume(manifest.step, manifest.start_time)
    for body, entry in zip(simulation.world.bodies, manifest.bodies, strict=True):
        settings = engine.settings(body.index)
        settings.kind, settings.probe = entry.kind, entry.probe
    return manifest


def saved_factors(simulation: Simulation, checkpoint: Checkpoint, manifest: Manifest) -> SavedFactors:
    """Returns the factors in use and the jobs in flight. Raises InputError."""
    found = SavedFactors([], [])
    solver = simulation.scene.solver
    for body, entry in zip(simulation.world.bodies, manifest.bodies, strict=True):
        warped = body.index in simulation.warped
        if entry.factor is not None:
            f, at = entry.factor, f"factor/{body.name}"
            types = (np.int32, np.int32, np.int64, np.int32)
            parts = [checkpoint.array(f"{at}/{n}", t) for n, t in zip(PATTERN, types, strict=True)]
            try:
                pattern = FactorPattern.build(*parts)
            except Refused as error:
                raise InputError(f"{at}: {error}") from None
            if pattern.size != 3 * (body.last - body.first):
                raise InputError(f"{at}: {pattern.size} degrees of freedom; expected: {3 * (body.last - body.first)}")
            kind = np.float32 if checkpoint.arrays.get(f"{at}/values", np.zeros(0)).dtype == np.float32 else np.float64
            values = checkpoint.array(f"{at}/values", kind, (pattern.nonzeros,))
            found.factors.append(
                Factor(body.name, 1, f.step, warped, pattern, values, f.worker, f.seconds, f.remedy, method=f.method)
            )
        if entry.job is not None:
            shape = simulation.system.body_values(body.first, body.last).shape
            if checkpoint.arrays.get(f"job/{body.name}/matrix", np.zeros(0)).ndim == 2:  # positions
                shape = (body.last - body.first, 3)
            matrix = checkpoint.array(f"job/{body.name}/matrix", np.float64, shape)
            method = solver.method_named(entry.job.method)
            epoch = simulation.epoch(body.name, entry.job.step)
            found.jobs.append(Job(body.name, epoch, entry.job.step, warped, matrix, solver.factor_dtype, method))
    return found


def restore_driver(driver: Driver, manifest: Manifest, saved: SavedFactors) -> None:
    """Gives the loop the factors that were in use, and has the policy send the jobs that were in flight again."""
    for state, entry in zip(driver.bodies, manifest.bodies, strict=True):
        state.frozen = entry.frozen
    if driver.policy.free:
        return
    for factor in saved.factors:
        driver.take_back(factor)
    driver.policy.take_back(saved.jobs)


def _touch_entry(a: Interaction) -> TouchEntry:
    return TouchEntry(**{name: getattr(a, name) for name in TouchEntry.model_fields})


def _interaction(simulation: Simulation, checkpoint: Checkpoint, entry: TouchEntry) -> Interaction:
    from sim_server.effects.touch import Interaction

    nodes: NDArray[Any] = checkpoint.array(f"touch/{entry.id}/nodes", np.int32)
    if nodes.ndim != 1 or not len(nodes) or not ((nodes >= 0) & (nodes < simulation.world.nodes)).all():
        raise InputError(f"array 'touch/{entry.id}/nodes': nodes that the scene does not have")
    offset = checkpoint.array(f"touch/{entry.id}/offset", np.float64, (len(nodes), 3))
    if entry.object not in {b.name for b in simulation.world.bodies}:
        raise InputError(
            f"manifest.json: an interaction with object {entry.object[:80]!r}, which the scene does not have"
        )
    return Interaction(nodes=nodes, offset=offset, **entry.model_dump())


def _as_of_this_version(resolved: dict[str, Any]) -> dict[str, Any]:
    """Returns a resolved scene of any version with the keys of this one; as it is where this one cannot read it."""
    try:
        return Scene.model_validate(earlier_defaults.named(resolved), context={"files": "known"}).resolved()
    except ValidationError:
        return resolved


def _differences(saved: Any, now: Any, at: str = "") -> str:
    """Returns the first key of the scene at which two resolved scenes differ, with both values."""
    if isinstance(saved, dict) and isinstance(now, dict):
        for key in sorted({*saved, *now} - ({"record"} if not at else set())):
            if saved.get(key) != now.get(key):
                return _differences(saved.get(key), now.get(key), f"{at}.{key}" if at else key)
    if isinstance(saved, list) and isinstance(now, list) and len(saved) == len(now):
        for k, (a, b) in enumerate(zip(saved, now, strict=True)):
            if a != b:
                return _differences(a, b, f"{at}[{k}]")
    return f"{at}: saved with {str(saved)[:80]}, here {str(now)[:80]}"
