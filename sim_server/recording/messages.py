# SPDX-License-Identifier: MIT
"""The simulation in the words of the protocol: scene, topologies, states, step records."""

import json
import math
import platform
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.method import Method
from protocol.process.version import version
from sim_server.backends.kinds import Kind
from sim_server.mechanics.world import Body
from sim_server.mesh import posed
from sim_server.mesh.surface import surface_triangles
from sim_server.scene.solver_options import FACTORS
from sim_server.service.points import Points
from sim_server.simulation import Simulation

NAMES = {kind: kind.name.lower() for kind in Kind}


def scene(simulation: Simulation) -> pb.Scene:
    """What is simulated, with the text of the scene file and its defaults filled in."""
    s = simulation.scene
    return pb.Scene(
        name=s.path.name or s.name,
        toml=s.text,
        resolved=json.dumps(s.resolved()),
        dt=s.dt,
        started_ns=time.time_ns(),
        software=f"warpfactor {version()}, {simulation.world.backend.name}, Python {platform.python_version()}",
        objects=[b.name for b in simulation.world.bodies],
        device=simulation.world.backend.name,
        build=simulation.world.backend.build(),
    )


def topology(simulation: Simulation, body: Body) -> pb.Topology:
    """Mesh and block pattern of one object, epoch 1."""
    pose = simulation.scene.objects[body.index].pose
    row_start, columns = simulation.system.body_pattern(body.first, body.last)
    fixed = np.flatnonzero(simulation.world.free[body.nodes] == 0)
    message = pb.Topology(
        header=pb.Header(object=body.name, epoch=1),
        nodes=body.last - body.first,
        rest=_bytes(posed(body.mesh.rest, pose.rotate, pose.translate), "<f8"),
        tets=_bytes(body.mesh.tets, "<i4"),
        triangles=_bytes(surface_triangles(body.mesh.tets), "<i4"),
        row_start=_bytes(row_start, "<i4"),
        columns=_bytes(columns, "<i4"),
        fixed=_bytes(fixed, "<i4"),
    )
    if any(pose.rotate) or any(pose.translate):
        message.reference = _bytes(body.mesh.rest, "<f8")
    for e in simulation.effects.values():
        if body.index in e.elastic:
            young, poisson = e.elastic[body.index]
            message.young, message.poisson = _bytes(young, "<f4"), _bytes(poisson, "<f4")
    return message


def places(points: list[Points], status: pb.Status) -> None:
    """Adds to a status where each object is now."""
    for found, place in zip(status.objects, points, strict=True):
        low, high = place.box()
        for vector, (x, y, z) in ((found.low, low), (found.high, high), (found.tip, place.tip())):
            vector.CopyFrom(pb.Vector(x=x, y=y, z=z))


def state(body: Body, step: int, time: float, x: NDArray[np.float64], v: NDArray[np.float64]) -> pb.State:
    """One frame of one object; x and v of all nodes of the scene."""
    return pb.State(
        header=pb.Header(object=body.name, epoch=1),
        step=step,
        time=time,
        nodes=body.last - body.first,
        x=_bytes(x[body.nodes], "<f8"),
        v=_bytes(v[body.nodes], "<f8"),
    )


def steps(
    simulation: Simulation, records: NDArray[Any], methods: Callable[[int, int], Method | None] | None = None
) -> list[pb.ObjectStep]:
    """Step records (engine.RECORD) as messages. methods: of body and step, how that factor was made ("auto")."""
    names = [b.name for b in simulation.world.bodies]
    kinds = preconditioner_names(simulation)
    columns = [records[name].tolist() for name in records.dtype.names or ()]
    rows = (dict(zip(records.dtype.names or (), row, strict=True)) for row in zip(*columns, strict=True))
    if methods is None or simulation.scene.solver.preconditioner != "auto":
        return [_step(names, kinds, row) for row in rows]
    return [_step(names, kinds | _factor_name(methods(row["body"], row["factor_step"])), row) for row in rows]


def preconditioner_names(simulation: Simulation) -> dict[Kind, str]:
    """Of the kinds that the loop knows: any factor is Kind.CHOLESKY there."""
    wanted = simulation.scene.solver.preconditioner
    return NAMES | ({Kind.CHOLESKY: wanted} if wanted in FACTORS else {})


def _factor_name(method: Method | None) -> dict[Kind, str]:
    return {} if method is None else {Kind.CHOLESKY: method.name}


def _step(names: list[str], kinds: dict[Kind, str], r: dict[str, Any]) -> pb.ObjectStep:
    made = r["factor_step"]
    energies = {"kinetic_energy": r["kinetic"], "elastic_energy": r["elastic"], "gravity_energy": r["gravity"]}
    energies |= {"work": r["work"], "dissipated": r["budget"] - r["kinetic"] - r["elastic"]}
    return pb.ObjectStep(
        header=pb.Header(object=names[r["body"]], epoch=1),
        step=r["step"],
        time=r["time"],
        iterations=r["iterations"],
        status=r["status"],
        residual=r["residual"],
        factor_step=made,
        factor_age=r["step"] - 1 - made if made >= 0 else -1,
        preconditioner=kinds[Kind(r["kind"])],
        assemble_seconds=r["assemble"],
        solve_seconds=r["solve"],
        integrate_seconds=r["integrate"],
        step_seconds=r["whole"],
        late_seconds=r["late"],
        cpu_seconds=r["cpu"],
        fallbacks=r["fallbacks"],
        asked=kinds[Kind(r["asked"])] if r["asked"] != r["kind"] else "",
        probe=r["probe"],
        linearizations=0 if r["nonlinear"] == -1 else r["linearizations"],
        nonlinear_residual=0.0 if r["nonlinear"] == -1 else r["nonlinear"],
        **{name: value for name, value in energies.items() if not math.isnan(value)},
    )


def _bytes(values: NDArray[Any], dtype: str) -> bytes:
    return np.ascontiguousarray(values, dtype).tobytes()
