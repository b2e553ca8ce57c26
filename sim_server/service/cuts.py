# SPDX-License-Identifier: MIT
"""Cuts of clients: finds the elements, removes them by a parameter of the effect, tells viewers of new surfaces."""

import json
from collections import deque
from functools import partial

import numpy as np

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64, Int64
from sim_server.errors import InputError
from sim_server.mechanics.cut_shapes import in_sphere, met_by_blade
from sim_server.mechanics.numbers import numbers_of
from sim_server.mechanics.removal import KEY, removal, removed_from
from sim_server.mechanics.world import Body
from sim_server.mesh.skin import Skin
from sim_server.network.link import ServerLink
from sim_server.parameters import ParameterUpdate
from sim_server.recording.recorder import Recorder
from sim_server.scene import where
from sim_server.simulation import Simulation

LONGEST = 65536  # characters of `elements`
FARTHEST = 1e9  # m, coordinates and radii of cuts
KEPT = 256  # cuts of an object whose steps are kept, for frames that come late


class BadCut(ValueError):
    """A cut that is refused; the text is for the client."""


def carry_out(simulation: Simulation, wanted: pb.Cut, client: str) -> pb.Reply:
    """Removes the elements of a cut from one of the next steps on. Raises BadCut, BadParameter."""
    body, scene = _body(simulation, wanted.object), simulation.parameters.scene
    known = removed_from(scene, body)
    try:
        found = np.setdiff1d(_chosen(simulation, body, wanted), known)
    except InputError as error:
        raise BadCut(str(error)) from None
    if len(found):
        simulation.parameters.set(removal(scene, body, found), client)
    return pb.Reply(removed=len(found), left=len(body.mesh.tets) - len(known) - len(found))


def _body(simulation: Simulation, name: str) -> Body:
    names = [body.name for body in simulation.world.bodies]
    if name not in names:
        raise BadCut(f"no object {name[:80]!r}; objects of the scene: {', '.join(names)}")
    body = simulation.world.bodies[names.index(name)]
    if "cutting" not in body.effects:
        raise BadCut(
            f"object {name!r} does not list the effect cutting, so it cannot be cut; add cutting = true to its effects"
        )
    return body


def _chosen(simulation: Simulation, body: Body, wanted: pb.Cut) -> Int64:
    """Returns the numbers of the elements that a cut names, where the body is now."""
    given = [bool(wanted.blade), wanted.radius != 0, bool(wanted.where), bool(wanted.elements)]
    if sum(given) != 1:
        raise BadCut("a cut needs one of blade, radius, where and elements")
    if wanted.where:
        return np.flatnonzero(where.mask(wanted.where, body.centroids))
    if wanted.elements:
        return _listed(body, wanted.elements)
    tets, x = body.mesh.tets, simulation.world.backend.fetch(simulation.world.x)[body.nodes].copy()
    if wanted.blade:
        corners = np.array([_finite(c, "blade") for c in wanted.blade])
        if len(corners) not in (3, 4):
            raise BadCut(f"blade has {len(corners)} corners; allowed: 3 or 4, of the surface that it sweeps")
        return met_by_blade(x, tets, corners)
    if not 0 < wanted.radius <= FARTHEST:
        raise BadCut(f"radius = {wanted.radius:g} m: must be above 0, at most {FARTHEST:g} m")
    return in_sphere(x, tets, _finite(wanted.center, "center"), wanted.radius)


def _listed(body: Body, text: str) -> Int64:
    if len(text) > LONGEST:
        raise BadCut(f"elements has {len(text)} characters: at most {LONGEST}")
    try:
        return numbers_of(text, len(body.mesh.tets))
    except ValueError as error:
        raise BadCut(f"elements: {error}") from None


def _finite(v: pb.Vector, what: str) -> Float64:
    if not all(abs(c) <= FARTHEST for c in (v.x, v.y, v.z)):
        raise BadCut(f"{what} = {v.x:g} {v.y:g} {v.z:g}: must be finite, at most {FARTHEST:g} m each")
    return np.array([v.x, v.y, v.z])


class CutTelemetry:
    """Numbers the cuts of each object as the loop takes them up; gives log and network the topologies without what was
    removed. The log has of each only what a cut changes; what a slow disk has no room for comes with the next frame."""

    def __init__(self, simulation: Simulation, link: ServerLink, recorder: Recorder | None, patient: bool):
        self._simulation, self._link, self._recorder, self._patient = simulation, link, recorder, patient
        self._bodies = {KEY.format(b.name): b for b in simulation.world.bodies if "cutting" in b.effects}
        self._waiting: deque[ParameterUpdate] = deque()
        self._taken: dict[str, deque[tuple[int, int]]] = {
            b.name: deque([(-1, 0)], maxlen=KEPT) for b in self._bodies.values()
        }  # steps before the first with it, and number, of cuts
        self._unwritten: dict[str, deque[tuple[pb.Topology, float]]] = {
            b.name: deque(maxlen=KEPT) for b in self._bodies.values()
        }  # what the log had no room for, and from when it holds [s]
        self._skins: dict[str, Int64] = {}  # element of each vertex
        self.removed: dict[str, int] = {}  # elements, by object
        if self._bodies:
            simulation.parameters.on_set.append(self._on_set)

    def open(self) -> None:
        """Tells of what the scene begins without, after topologies were announced."""
        for body in self._bodies.values():
            removed = removed_from(self._simulation.parameters.scene, body)
            if len(removed):
                self._tell(body, removed, self._simulation.engine.step - 1)

    def number(self, name: str, step: int) -> int:
        """Returns the number of the newest cut of an object in the frame after `step` steps."""
        if name not in self._taken:
            return 0
        return next((number for taken, number in reversed(self._taken[name]) if taken < step), 0)

    def written(self, name: str) -> bool:
        """Gives the log what it had no room for of an object; returns True if it has all of its meshes now."""
        waiting = self._unwritten.get(name)
        while waiting and self._recorder is not None:
            message, time = waiting[0]
            if not self._recorder.topology(message, block=self._patient, time=time, again=True):
                return False
            waiting.popleft()
        return True

    def take(self) -> None:
        """Tells of the cuts that the loop has taken up since the last call, before frames are sent."""
        newest: dict[str, tuple[str, int]] = {}  # by key: of several cuts between two calls the last one is told
        while self._waiting and self._waiting[0].taken >= 0:
            update = self._waiting.popleft()
            for key in update.values.keys() & self._bodies.keys():
                first = newest[key][1] if key in newest else update.taken
                newest[key] = json.loads(update.values[key]), first
        for key, (text, taken) in newest.items():
            body = self._bodies[key]
            self._tell(body, numbers_of(text, len(body.mesh.tets)), taken)

    def _on_set(self, update: ParameterUpdate) -> None:
        if self._waiting and self._waiting[-1] is update.replaces:  # which the loop never took up
            self._waiting.pop()
        if update.values.keys() & self._bodies.keys():
            self._waiting.append(update)

    def _tell(self, body: Body, removed: Int64, step: int) -> None:
        """step: steps before the first one without these elements."""
        number = self._taken[body.name][-1][1] + 1
        self._taken[body.name].append((step, number))
        self.removed[body.name] = len(removed)
        change = partial(_set_cut, self._cut_of(body, removed, number))
        self._link.renew_topology(body.name, change)
        if self._recorder is not None:
            message = pb.Topology(header=pb.Header(object=body.name, epoch=1), nodes=body.last - body.first)
            change(message)
            time = max(step, 0) * self._simulation.world.dt
            self._unwritten[body.name].append((message, time))
            self.written(body.name)

    def _cut_of(self, body: Body, removed: Int64, number: int) -> pb.Topology:
        """Returns the fields of a topology that change once these elements are gone."""
        assert self._simulation.cutting is not None
        present = np.ones(len(body.mesh.tets), bool)
        present[removed] = False
        found = pb.Topology(cut=number, removed=removed.astype("<i4").tobytes())
        found.triangles = self._simulation.cutting.faces[body.index].surface(present).astype("<i4").tobytes()
        if body.skin is not None:
            if body.name not in self._skins:
                self._skins[body.name] = _elements_of(body, body.skin)
            there = present[self._skins[body.name]]
            found.skin_triangles = body.skin.triangles[there[body.skin.triangles].all(axis=1)].astype("<i4").tobytes()
        return found


def _elements_of(body: Body, skin: Skin) -> Int64:
    """Returns the element that each vertex of a skin moves with, (s,)."""
    order = np.lexsort(np.sort(body.mesh.tets, axis=1).T[::-1])
    keys = [np.ascontiguousarray(np.sort(each, axis=1)).view([("", np.int32)] * 4).ravel() for each in
            (body.mesh.tets[order].astype(np.int32), skin.nodes.astype(np.int32))]  # fmt: skip
    return np.asarray(order[np.searchsorted(keys[0], keys[1])])


def _set_cut(of: pb.Topology, message: pb.Topology) -> None:
    message.cut, message.removed, message.triangles = of.cut, of.removed, of.triangles
    if message.skin_triangles or of.skin_triangles:
        message.skin_triangles = of.skin_triangles
