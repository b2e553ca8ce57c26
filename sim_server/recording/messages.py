# SPDX-License-Identifier: MIT
"""Converts a simulation to messages: scene, topologies, states, interactions, step records."""

import json
import platform
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.method import Method
from protocol.process.version import version
from sim_server.arrays import Float64
from sim_server.backends.kinds import Kind
from sim_server.backends.measured import Measured
from sim_server.mechanics.named_points import NamedPoints
from sim_server.mechanics.world import Body
from sim_server.mesh import posed
from sim_server.mesh.surface import surface_triangles
from sim_server.parameters import LiveParameter, ParameterUpdate
from sim_server.recording.object_steps import Additions, Encoded, Reactions, Readings, encoded
from sim_server.scene import Scene
from sim_server.scene.solver_options import FACTORS
from sim_server.simulation import Simulation
from sim_server.state import code

NAMES = {kind: kind.name.lower() for kind in Kind}


def scene(simulation: Simulation) -> pb.Scene:
    """Converts the scene, with the text of its file and with all defaults."""
    s = simulation.scene
    return pb.Scene(
        name=s.path.name or s.name,
        toml=s.text,
        resolved=json.dumps(s.resolved()),
        dt=s.dt,
        started_ns=time.time_ns(),
        software=", ".join(
            [
                f"warpfactor {version()}",
                simulation.world.backend.name,
                f"Python {platform.python_version()}",
                *map(str, code.codes(simulation)),
            ]
        ),
        objects=[b.name for b in simulation.world.bodies],
        device=simulation.world.backend.name,
        build=code.build_id(simulation),
        obstacles=simulation.posed_names,
    )


def published(message: pb.Scene) -> pb.Scene:
    """Returns a scene as the network has it: texts of meshes are left out, since topologies hold these meshes."""
    table = json.loads(message.resolved)
    large = [o["mesh"] for o in table["object"] if "data" in o["mesh"]]
    if not large:
        return message
    for mesh in large:
        mesh["data"] = ""
    sent = pb.Scene()
    sent.CopyFrom(message)
    sent.resolved = json.dumps(table)
    return sent


def topology(simulation: Simulation, body: Body) -> pb.Topology:
    """Converts mesh and block pattern of one object as they are now; epoch 1, unless it was split."""
    message = pb.Topology(
        header=pb.Header(object=body.name, epoch=simulation.epoch(body.name, simulation.engine.step)),
        nodes=body.last - body.first,
    )
    shape(simulation, body, simulation.parameters.scene, message)
    if body.mesh.quadratic is not None:
        message.quadratic = _bytes(body.mesh.quadratic, "<i4")
    if body.skin is not None:
        message.skin_nodes, message.skin_weights = _bytes(body.skin.nodes, "<i4"), _bytes(body.skin.weights, "<f8")
        message.skin_triangles = _bytes(body.skin.triangles, "<i4")
    moduli(simulation, body, message)
    return message


def shape(simulation: Simulation, body: Body, scene: Scene, message: pb.Topology) -> None:
    """Sets mesh and block pattern in a topology. scene: with the parameters by which the body is split."""
    pose, splitting, fixed = simulation.scene.objects[body.index].pose, simulation.world.splitting, simulation.fixed
    row_start, columns = simulation.system.body_pattern(body.first, body.last)
    rest, tets, triangles = body.mesh.rest, body.mesh.tets, surface_triangles(body.mesh.tets)
    if splitting is not None and simulation.system.followed is not None:
        row_start, columns = simulation.system.followed.body_pattern(scene, body.first, body.last)
        fixed = fixed[splitting.nodes(scene, "root")]
        if body.index in splitting.splitters:
            split = splitting.of(scene, body.index)
            rest, tets = rest[split.root], split.tets
            triangles = splitting.splitters[body.index].faces.surface(np.ones(len(tets)), tets, split.closed)
    message.rest = _bytes(posed(rest, pose.rotate, pose.translate), "<f8")
    message.tets, message.triangles = _bytes(tets, "<i4"), _bytes(triangles, "<i4")
    message.row_start, message.columns = _bytes(row_start, "<i4"), _bytes(columns, "<i4")
    message.fixed = _bytes(np.flatnonzero(fixed[body.nodes]), "<i4")
    if any(pose.rotate) or any(pose.translate):
        message.reference = _bytes(rest, "<f8")
    for name, group in body.mesh.groups.items():
        parts = (_bytes(part, "<i4") for part in (group.elements, group.faces, group.nodes))
        message.groups.append(pb.Group(**dict(zip(("elements", "faces", "nodes"), parts, strict=True)), name=name))


def moduli(simulation: Simulation, body: Body, message: pb.Topology) -> None:
    """Sets Young's moduli and Poisson's ratios of the elements in a topology, as they are now."""
    for e in simulation.effects.values():
        if body.index in e.elastic:
            young, poisson = e.elastic[body.index]
            message.young, message.poisson = _bytes(young, "<f4"), _bytes(poisson, "<f4")


def add_places(points: list[NamedPoints], status: pb.Status) -> None:
    """Adds bounding box and tip of each object to a status."""
    for found, place in zip(status.objects, points, strict=True):
        low, high = place.box()
        for vector, (x, y, z) in ((found.low, low), (found.high, high), (found.tip, place.tip())):
            vector.CopyFrom(pb.Vector(x=x, y=y, z=z))


def state(
    body: Body, step: int, time: float, x: NDArray[np.float64], v: NDArray[np.float64], cut: int = 0, epoch: int = 1
) -> pb.State:  # fmt: skip
    """Converts a frame of one object. x, v: positions [m] and velocities [m/s] of all nodes of the scene."""
    return pb.State(
        header=pb.Header(object=body.name, epoch=epoch),
        step=step,
        time=time,
        nodes=body.last - body.first,
        x=_bytes(x[body.nodes], "<f8"),
        v=_bytes(v[body.nodes], "<f8"),
        cut=cut,
    )


def interaction(a: Any) -> pb.Interaction:
    """Converts a push or a grab, an Interaction of the effect touch."""

    def vector(v: tuple[float, float, float]) -> pb.Vector:
        return pb.Vector(x=v[0], y=v[1], z=v[2])

    return pb.Interaction(
        id=a.id, client=a.client, object=a.object, kind="grab" if a.stiffness else "push", point=vector(a.point),
        radius=a.radius, force=vector(a.force), duration=a.duration, target=vector(a.target),
        stiffness=a.stiffness, max_force=a.limit, nodes=len(a.nodes), start=a.start,
    )  # fmt: skip


def live_parameter(p: LiveParameter) -> pb.LiveParameter:
    """Converts a live parameter."""
    return pb.LiveParameter(
        now=pb.Parameter(key=p.field.key, value=p.text), unit=p.field.unit, low=p.low, high=p.high,
        logarithmic=p.field.live.logarithmic, about=p.field.about,
    )  # fmt: skip


def parameter_set(step: int, update: ParameterUpdate) -> pb.ParameterSet:
    """Converts parameters that the loop took up after `step` completed steps."""
    values = [pb.Parameter(key=key, value=value) for key, value in update.values.items()]
    return pb.ParameterSet(step=step, parameters=values, client=update.client)


def steps(
    simulation: Simulation, records: NDArray[Any], methods: Callable[[int, int], Method | None] | None = None,
    reactions: Reactions | None = None, readings: Readings | None = None,
) -> list[pb.ObjectStep]:  # fmt: skip
    """Returns the messages of `encoded_steps`."""
    return [
        pb.ObjectStep.FromString(step.data) for step in encoded_steps(simulation, records, methods, reactions, readings)
    ]


def encoded_steps(
    simulation: Simulation, records: NDArray[Any], methods: Callable[[int, int], Method | None] | None = None,
    reactions: Reactions | None = None, readings: Readings | None = None, excess: Float64 | None = None,
    age_bound: int = 0, additions: Additions | None = None, left_out: NDArray[np.int64] | None = None,
) -> list[Encoded]:  # fmt: skip
    """Step records (structs.RECORD) as messages.

    methods: of body and step, how that factor was made ("auto"). reactions, readings: of the same records
    excess, age_bound, left_out: as of object_steps.encoded. additions: what else the messages have
    """
    bodies, added = simulation.world.bodies, Additions() if additions is None else additions
    names = [bodies[body].name for body in records["body"].tolist()]
    if reactions is not None:
        reactions.add_to(added, records)
    if readings is not None:
        readings.add_to(added, names)
    data = encoded(records, names, _preconditioners(simulation, records, methods), excess, age_bound, left_out)
    for number, message in added.items():
        data[number] += message.SerializeToString()
    return list(map(Encoded, names, records["step"].tolist(), records["time"].tolist(), data))


def _preconditioners(
    simulation: Simulation, records: NDArray[Any], methods: Callable[[int, int], Method | None] | None
) -> tuple[list[str], list[str]]:
    """Returns the names of those that solves used and began with."""
    names = {int(kind): name for kind, name in preconditioner_names(simulation).items()}
    used, asked = ([names[kind] for kind in records[column].tolist()] for column in ("kind", "asked"))
    if methods is None or simulation.scene.solver.preconditioner != "auto":
        return used, asked
    factor = NAMES[Kind.CHOLESKY]
    for number, place in enumerate(zip(records["body"].tolist(), records["factor_step"].tolist(), strict=True)):
        if factor in (used[number], asked[number]) and (method := methods(*place)) is not None:
            used[number], asked[number] = (
                method.name if name == factor else name for name in (used[number], asked[number])
            )
    return used, asked


def reactions(simulation: Simulation, on_obstacles: Float64, others: NDArray[Any]) -> Reactions:
    """What objects exerted in the steps of records, as an engine tells it."""
    obstacles = simulation.reaction_names if on_obstacles.shape[1] else []
    return Reactions(on_obstacles, others, obstacles, [b.name for b in simulation.world.bodies])


def readings(simulation: Simulation, values: Float64) -> Readings:
    """What effects tell of objects in the steps of records, as an engine tells it."""
    bodies = simulation.world.bodies
    measured: dict[str, list[Measured]] = {}
    for each in simulation.measured:
        measured.setdefault(bodies[each.body].name, []).append(each)
    return Readings(values, measured)


def preconditioner_names(simulation: Simulation) -> dict[Kind, str]:
    """Returns the name of each kind of preconditioner; any factor is Kind.CHOLESKY in the loop."""
    wanted = simulation.scene.solver.preconditioner
    return NAMES | ({Kind.CHOLESKY: wanted} if wanted in FACTORS else {})


def _bytes(values: NDArray[Any], dtype: str) -> bytes:
    return np.asarray(values, dtype).tobytes()
