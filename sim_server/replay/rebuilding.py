# SPDX-License-Identifier: MIT
"""Builds the simulation of a log again, and compares what it is made of with what the log says."""

import json
from typing import Any

import numpy as np
from pydantic import ValidationError

from protocol.log_chunks import BadLog
from sim_server.backends.processor_variants import advice
from sim_server.errors import DeviceError
from sim_server.recording import messages
from sim_server.recording.obstacles import obstacle_messages
from sim_server.replay.log import Recording
from sim_server.scene import Scene, deleted, earlier_defaults
from sim_server.scene.messages import readable
from sim_server.simulation import Simulation
from sim_server.state import code
from sim_server.updates.worker_assembly import mesh_of_topology

MESH = ("nodes", "tets", "row_start", "columns", "fixed")


def simulation_of(recording: Recording) -> Simulation:
    """Builds the simulation of a log. Raises BadLog if that cannot be done here."""
    try:
        table = _without_skins(deleted.without(earlier_defaults.named(json.loads(recording.scene.resolved))))
        if table.get("solver", {}).get("warp") == "auto":
            table["solver"]["warp"] = True
            recording.notes.append(
                'recorded with warp = "auto", repeated with true: steps that were tried without may differ'
            )
        scene, watched = _scene(recording, table), "on_runaway" in table.get("solver", {})
    except ValidationError as error:
        reason, software = str(readable(error, f"in {recording.path.name}", table)), recording.scene.software
        reason += f"; recorded with {software}" if " effect " in software else ""
        raise BadLog(f"{recording.path}: the scene in the log cannot be built: {reason}") from error
    except ValueError as error:
        raise BadLog(f"{recording.path}: the scene in the log cannot be built: {error}") from error
    try:
        return Simulation(scene, recording.device, watched)
    except DeviceError as error:
        raise BadLog(
            f"{recording.path}: recorded on a GPU ({recording.scene.software}), and only one can run it again: {error}"
        ) from error


def _scene(recording: Recording, table: dict[str, Any]) -> Scene:
    """Returns the validated scene of the log; meshes that were made by filling a surface are those of the log, so
    neither surface nor mesher is needed."""
    listed = table["object"] if isinstance(table.get("object"), list) else []
    meshes = [o.get("mesh") for o in listed if isinstance(o, dict)]
    filled = any(isinstance(mesh, dict) and mesh.get("surface") for mesh in meshes)
    scene = Scene.model_validate(table, context={"files": "known"} if filled else None)
    for o in scene.objects if filled else ():
        recorded = recording.objects.get(o.name)
        if o.mesh.surface is not None and recorded is not None and recorded.topology is not None:
            o.use_mesh(mesh_of_topology(recorded.topology))
    return scene


def _without_skins(resolved: Any) -> Any:
    """Returns a resolved scene without skins: no step depends on them, and the log has them."""
    for each in resolved.get("object", ()) if isinstance(resolved, dict) else ():
        if isinstance(each, dict):
            each.pop("skin", None)
    return resolved


def check_meshes(simulation: Simulation, recording: Recording) -> None:
    """Raises BadLog unless the meshes of the scene are those of the log."""
    bodies = simulation.world.bodies
    if [b.name for b in bodies] != list(recording.scene.objects):
        raise BadLog(f"{recording.path}: the scene in the log has other objects than the log")
    for body in bodies:
        now, then = messages.topology(simulation, body), recording.objects[body.name].topology
        assert then is not None
        other = [name for name in MESH if getattr(now, name) != getattr(then, name)]
        if not other and not np.allclose(np.frombuffer(now.rest), np.frombuffer(then.rest), rtol=1e-9, atol=1e-12):
            other = ["rest"]
        if other:
            file = simulation.scene.objects[body.index].mesh.file
            raise BadLog(
                f"{recording.path}: the mesh of object {body.name!r} is not the recorded one "
                f"({', '.join(other)}){f'; was {file} changed?' if file else ''}"
            )


def check_obstacles(simulation: Simulation, recording: Recording) -> None:
    """Raises BadLog unless the surfaces of obstacles are those of the log."""
    for now in obstacle_messages(simulation):
        then = recording.obstacles.get(now.header.object)
        if then is not None and (now.vertices, now.triangles) != (then.vertices, then.triangles):
            raise BadLog(
                f"{recording.path}: the surface of obstacle {now.header.object!r} is not the recorded one; "
                "was its file changed?"
            )


def other_code(simulation: Simulation, recording: Recording) -> list[str]:
    """Tells of effects of other packages, and of a build, that are not the recorded ones."""
    scene = recording.scene
    notes = [
        f"{other} is not the code of the log: recorded with {scene.software}"
        for other in code.codes(simulation)
        if str(other) not in scene.software
    ]
    if scene.build and code.build_id(simulation) != scene.build:
        notes.append(
            "another build than the recorded one (kernels, compiler, processor or GPU): last digits may differ, and "
            "where another version solves otherwise iterations, and positions within the tolerance of solves"
            + advice(scene.build)
        )
    return notes
