# SPDX-License-Identifier: MIT
"""Cuts of clients: finds the elements, removes them by a parameter of the effect, tells viewers of new surfaces."""

from collections import deque
from functools import partial
from threading import Lock

import numpy as np

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64, Int32, Int64
from sim_server.errors import InputError
from sim_server.mechanics.cut_shapes import border, in_sphere, met_by_blade, opened_by_blade
from sim_server.mechanics.numbers import numbers_of
from sim_server.mechanics.removal import KEY, present, removal, removed_from
from sim_server.mechanics.splitting import KEY as SPLIT
from sim_server.mechanics.splitting import opening
from sim_server.mechanics.world import Body
from sim_server.mesh.skin import Skin
from sim_server.network.link import ServerLink
from sim_server.parameters import ParameterUpdate
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.scene import Scene, where
from sim_server.simulation import Simulation

LONGEST = 65536  # characters of `elements`
FARTHEST = 1e9  # m, coordinates and radii of cuts
KEPT = 256  # cuts of an object whose steps are kept, for frames that come late


class BadCut(ValueError):
    """A cut that is refused; the text is for the client."""


def carry_out(simulation: Simulation, wanted: pb.Cut, client: str) -> pb.Reply:
    """Removes the elements of a cut, or splits the object, from one of the next steps on. Raises BadCut,
    BadParameter."""
    body, scene = _body(simulation, wanted.object), simulation.parameters.scene
    if wanted.split:
        return _split(simulation, body, wanted, client)
    known = removed_from(scene, body)
    try:
        found = np.setdiff1d(_chosen(simulation, body, wanted), known)
    except InputError as error:
        raise BadCut(str(error)) from None
    if len(found):
        simulation.parameters.set(removal(scene, body, found), client)
    return pb.Reply(removed=len(found), left=len(body.mesh.tets) - len(known) - len(found))


def _split(simulation: Simulation, body: Body, wanted: pb.Cut, client: str) -> pb.Reply:
    """Opens faces between elements that are there, along a blade or around the elements that a cut names."""
    scene, splitting = simulation.parameters.scene, simulation.world.splitting
    splitter = splitting.splitters.get(body.index) if splitting else None
    if splitting is None or splitter is None:
        raise BadCut(
            f"object {body.name!r} keeps no nodes to be split with: add spare to its effect cutting, as "
            "cutting = { spare = 1000 }"
        )
    _check_one(wanted)
    before, text = splitting.of(scene, body.index), scene.objects[body.index].effects["cutting"].opened  # type: ignore[attr-defined]
    owners, there = splitter.faces.owners, present(scene, [body]) > 0
    try:
        if wanted.blade:
            faces = opened_by_blade(_positions(simulation, body), before.tets, owners, _blade(wanted))
        else:
            chosen = np.zeros(len(there), bool)
            chosen[_chosen(simulation, body, wanted)] = True
            faces = border(chosen, owners)
    except InputError as error:
        raise BadCut(str(error)) from None
    faces = faces[before.closed[faces] & there[owners[faces]].all(axis=1)]
    if not len(faces):
        return pb.Reply(left=int(there.sum()))
    simulation.parameters.set(opening(splitter, text, faces), client)
    after = splitting.of(simulation.parameters.scene, body.index)
    return pb.Reply(left=int(there.sum()), opened=len(faces), copied=after.used - before.used)


def _positions(simulation: Simulation, body: Body) -> Float64:
    """Returns the positions of a body's nodes now, also of copies that the loop has not made yet [m]."""
    assert simulation.cutting is not None
    return np.asarray(simulation.cutting.positions(simulation.parameters.scene)[body.nodes])


def _tets(simulation: Simulation, body: Body) -> Int32:
    """Returns the elements of a body as it is split, by its own nodes."""
    splitting = simulation.world.splitting
    if splitting is None or body.index not in splitting.splitters:
        return body.mesh.tets
    return splitting.of(simulation.parameters.scene, body.index).tets


def _blade(wanted: pb.Cut) -> Float64:
    corners = np.array([_finite(c, "blade") for c in wanted.blade])
    if len(corners) not in (3, 4):
        raise BadCut(f"blade has {len(corners)} corners; allowed: 3 or 4, of the surface that it sweeps")
    return corners


def _check_one(wanted: pb.Cut) -> None:
    given = [bool(wanted.blade), wanted.radius != 0, bool(wanted.where), bool(wanted.elements)]
    if sum(given) != 1:
        raise BadCut("a cut needs one of blade, radius, where and elements")


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
    _check_one(wanted)
    if wanted.where:
        return np.flatnonzero(where.elements(wanted.where, body.mesh))
    if wanted.elements:
        return _listed(body, wanted.elements)
    tets, x = _tets(simulation, body), _positions(simulation, body)
    if wanted.blade:
        return met_by_blade(x, tets, _blade(wanted))
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
    removed, and those of what was split. The log has of each only what a removal changes; what a slow disk has no room
    for comes with the next frame. `announce` may be called from another thread than the rest."""

    def __init__(self, simulation: Simulation, link: ServerLink, recorder: Recorder | None, patient: bool):
        self._simulation, self._link, self._recorder, self._patient = simulation, link, recorder, patient
        bodies = [b for b in simulation.world.bodies if "cutting" in b.effects]
        self._bodies = {key.format(b.name): b for key in (KEY, SPLIT) for b in bodies}
        self._waiting: deque[tuple[ParameterUpdate, Scene]] = deque()
        self._taken: dict[str, deque[tuple[int, int, int]]] = {
            b.name: deque([(-1, 0, 1)], maxlen=KEPT) for b in bodies
        }  # steps before the first with it, number, and epoch, of cuts
        self._unwritten: dict[str, deque[tuple[pb.Topology, float]]] = {
            b.name: deque(maxlen=1) for b in bodies
        }  # the newest that the log had no room for, and from when it holds [s]
        self._logged: dict[str, deque[tuple[int, int]]] = {b.name: deque([(0, 1)], maxlen=KEPT) for b in bodies}
        self._skins: dict[str, Int64] = {}  # element of each vertex
        self._announced: dict[str, int] = {}  # epochs of objects, but for the first
        self._lock = Lock()
        self.removed: dict[str, int] = {}  # elements, by object
        if self._bodies:
            simulation.parameters.on_set.append(self._on_set)

    def open(self) -> None:
        """Tells of what the scene begins without, after topologies were announced."""
        scene, step = self._simulation.parameters.scene, self._simulation.engine.step
        for name, taken in self._taken.items():
            body = self._simulation.world.body(name)
            epoch = self._announced[name] = self._simulation.epoch(name, step)
            taken[0] = -1, 0, epoch
            self._logged[name].append((0, epoch))
            removed = removed_from(scene, body)
            if len(removed):
                self._tell(body, scene, step - 1)

    def announce(self, body: Body, epoch: int) -> None:
        """Tells workers and viewers of the mesh of a body that was split, unless that has been done."""
        splits = self._simulation.splits
        with self._lock:
            if splits is None or epoch <= self._announced.get(body.name, 1):
                return
            self._announced[body.name] = epoch
            self._link.announce(self._mesh_of(body, splits.scene(body.name, epoch), epoch))

    def number(self, name: str, step: int) -> tuple[int, int]:
        """Returns number and epoch of the newest cut of an object in the frame after `step` steps."""
        if name not in self._taken:
            return 0, 1
        taken = self._taken[name]
        return next(((number, epoch) for at, number, epoch in reversed(taken) if at < step), taken[0][1:])

    def written(self, name: str, step: int) -> bool:
        """Gives the log what it had no room for of an object; returns True if it has the mesh of a step's frame."""
        if name not in self._logged:
            return True
        self._write(name)
        return self.number(name, step) in self._logged[name]

    def _write(self, name: str) -> None:
        waiting = self._unwritten[name]
        while waiting and self._recorder is not None:
            message, time = waiting[0]
            if not self._recorder.topology(message, block=self._patient, time=time, again=True):
                return
            self._logged[name].append((message.cut, message.header.epoch))
            waiting.popleft()

    def take(self) -> None:
        """Tells of the cuts that the loop has taken up since the last call, before frames are sent."""
        newest: dict[str, tuple[Scene, int]] = {}  # of several removals between two calls the last one is told
        while self._waiting and self._waiting[0][0].taken >= 0:
            update, scene = self._waiting.popleft()
            for name in {self._bodies[key].name for key in update.values.keys() & self._bodies.keys()}:
                if self._splits(body := self._simulation.world.body(name)):  # frames have the nodes of each split
                    self._tell(body, scene, update.taken)
                    continue
                newest[name] = scene, newest[name][1] if name in newest else update.taken
        for name, (scene, taken) in newest.items():
            self._tell(self._simulation.world.body(name), scene, taken)

    def _on_set(self, update: ParameterUpdate) -> None:
        if self._waiting and self._waiting[-1][0] is update.replaces:  # which the loop never took up
            self._waiting.pop()
        if update.values.keys() & self._bodies.keys():
            self._waiting.append((update, self._simulation.parameters.scene))

    def _tell(self, body: Body, scene: Scene, step: int) -> None:
        """scene: with the parameters of the cut; step: steps before the first one with it."""
        _, number, before = self._taken[body.name][-1]
        epoch = self._simulation.epoch(body.name, max(step, 0))
        number += epoch == before
        self._taken[body.name].append((step, number, epoch))
        removed = removed_from(scene, body)
        self.removed[body.name] = len(removed)
        if self._splits(body):
            self.announce(body, epoch)
        change = partial(_set_cut, self._cut_of(body, scene, removed, number))
        self._link.renew_topology(body.name, change)
        if self._recorder is not None:
            if self._splits(body):  # a log has no other mesh of the epoch to begin from
                message = self._mesh_of(body, scene, epoch)
            else:
                message = pb.Topology(header=pb.Header(object=body.name, epoch=1), nodes=body.last - body.first)
            change(message)
            time = max(step, 0) * self._simulation.world.dt
            self._unwritten[body.name].append((message, time))
            self._write(body.name)

    def _splits(self, body: Body) -> bool:
        splitting = self._simulation.world.splitting
        return splitting is not None and body.index in splitting.splitters

    def _mesh_of(self, body: Body, scene: Scene | None, epoch: int) -> pb.Topology:
        """Returns the topology of a body that was split. scene: with its parameters; None: those of the start"""
        message = pb.Topology(header=pb.Header(object=body.name, epoch=epoch), nodes=body.last - body.first)
        messages.shape(self._simulation, body, scene or self._simulation.scene, message)
        messages.moduli(self._simulation, body, message)
        return message

    def _cut_of(self, body: Body, scene: Scene, removed: Int64, number: int) -> pb.Topology:
        """Returns the fields of a topology that change once these elements are gone."""
        assert self._simulation.cutting is not None
        found = pb.Topology(cut=number, removed=removed.astype("<i4").tobytes())
        found.triangles = self._simulation.cutting.surface_of(scene, body).astype("<i4").tobytes()
        if body.skin is not None:
            present = np.ones(len(body.mesh.tets), bool)
            present[removed] = False
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
