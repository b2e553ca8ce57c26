# SPDX-License-Identifier: MIT
"""Assembles the system matrix of one object from its positions, in a worker (section 5 of Courtecuisse et al. 2010).

The kernels and their constants are those of the server's loop, and so is the matrix. Scene and topology of the object
come from the server; they are checked like anything that came over a network, and no file that they name is read.
"""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from protocol.messages_pb2 import Group as GroupMessage
from protocol.messages_pb2 import Scene as SceneMessage
from protocol.messages_pb2 import Topology
from protocol.refused import Refused
from protocol.validate import all_finite, array, check_range
from sim_server.errors import InputError
from sim_server.mesh import Mesh, check
from sim_server.mesh.groups import Group
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation

# Settings of the server's device, and what a worker has in their place
WORKER_SETTINGS = {"precision": "float64", "factor_precision": "auto", "threads": 1, "gpus": 1, "budget": 0.0,
        "build": "server", "extrapolate": 0.0, "woodbury": 0}  # fmt: skip
MOTION = ("keyframes", "moved", "max_speed", "max_turn")  # of a holder: positions come with each job


class Assembly:
    """Assembles the matrices of one object in one topology epoch.

    Raises Refused for a description of which no simulation can be made.
    """

    def __init__(self, scene: SceneMessage, topology: Topology):
        name = topology.header.object
        try:
            self._simulation = Simulation(single_object_scene(scene.resolved, name, mesh_of_topology(topology)))
        except (InputError, ValidationError) as error:
            raise Refused(f"Scene.resolved, object {name!r}: {error}", "malformed") from error
        self._simulation.engine.begin = ()  # A of a scheme of several steps does not depend on the states before
        self._check_pattern(topology)

    @property
    def nodes(self) -> int:
        """Number of nodes of the object."""
        return self._simulation.world.nodes

    def matrix(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns A' = R^T A R, (blocks, 3, 3) in the order of the topology; overwritten by the next call.

        x: positions (nodes, 3) [m]. Velocities are taken as zero: A of no effect that workers know depends on them.
        Raises ValueError for positions of another shape or not finite.
        """
        world = self._simulation.world
        if x.shape != world.x.shape or not all_finite(x):
            raise ValueError(f"positions {x.shape}: must be finite, {world.x.shape}")
        world.x[...] = x
        self._simulation.engine.assemble()
        return self._simulation.system.values

    def _check_pattern(self, topology: Topology) -> None:
        row_start, columns = self._simulation.system.body_pattern(0, self.nodes)
        same = row_start.tobytes() == topology.row_start and columns.tobytes() == topology.columns
        if not same:
            raise Refused("Topology.columns is not the pattern that is built here: another version?", "pattern")


def single_object_scene(resolved: str, name: str, mesh: Mesh) -> Scene:
    """Returns the scene of one object alone, on a CPU, with this mesh; without contact, which A does not hold, and
    with holders at rest.

    resolved: Scene.resolved
    name: of the object
    Raises InputError, Refused or pydantic's ValidationError.
    """
    try:
        table: dict[str, Any] = json.loads(resolved)
        listed = [o for o in table["object"] if o["name"] == name]
        table["solver"] = {**table["solver"], **WORKER_SETTINGS}
        table["effects"] = {name: given for name, given in table["effects"].items() if name != "contact"}
        for kind in ("obstacle", "attachment", "spring"):
            table.pop(kind, None)
        held = [{k: v for k, v in h.items() if k not in MOTION} for h in table.pop("holder", []) if h["object"] == name]
        table |= {"holder": held} if held else {}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise Refused(f"Scene.resolved is no scene: {type(error).__name__}", "malformed") from error
    if len(listed) != 1:
        raise Refused(f"Scene.resolved has {len(listed)} objects called {name!r}; allowed: 1", "object")
    of_bar = {"mesh": {"bar": [1, 1, 1], "size": [1.0, 1.0, 1.0]}, "skin": None}  # in place of their sources
    table["object"] = [{**listed[0], **of_bar}]
    scene = Scene.model_validate(table, context={"files": False})
    scene.objects[0].use_mesh(mesh)
    return scene


def mesh_of_topology(topology: Topology) -> Mesh:
    """Returns the mesh of an object, before its pose. Raises Refused, InputError."""
    rest = array(topology.reference or topology.rest, np.float64, (topology.nodes, 3), "Topology.rest", finite=True)
    tets = array(topology.tets, np.int32, (-1, 4), "Topology.tets")
    check_range(tets, 0, topology.nodes, "Topology.tets")
    quadratic = None
    if topology.quadratic:
        quadratic = array(topology.quadratic, np.int32, (-1, 10), "Topology.quadratic")
        check_range(quadratic, 0, topology.nodes, "Topology.quadratic")
    groups = {group.name: _group(group, len(tets), topology.nodes) for group in topology.groups}
    return check(Mesh(rest, tets, topology.header.object, quadratic=quadratic, groups=groups))


def _group(given: GroupMessage, tets: int, nodes: int) -> Group:
    elements = array(given.elements, np.int32, (-1,), "Group.elements")
    faces = array(given.faces, np.int32, (-1, 4), "Group.faces")
    others = array(given.nodes, np.int32, (-1,), "Group.nodes")
    check_range(elements, 0, tets, "Group.elements")
    check_range(faces, 0, nodes, "Group.faces")
    check_range(others, 0, nodes, "Group.nodes")
    return Group(elements, faces, others)
