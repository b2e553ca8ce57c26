# SPDX-License-Identifier: MIT
"""Elements that are taken out of an object while it moves: by a blade, in a sphere, in a region, or by their numbers;
and faces between elements that are opened, so that it comes apart there.

What is removed has no stiffness, no mass and no surface from one step to the next: all constants of the element are 0,
and its nodes lose its part of their masses. What an element's removal opens becomes surface. Pieces that come apart
move on their own, and stay one object. A node that has no element left rests where it was, out of everything.

The pattern of A stays, with zeros in it, so that nothing of a step depends on how much was cut, and factors of matrices
from before a cut stay in use: their rows of nodes without elements are set apart, and on the nodes that lost elements
since the factor's matrix and their neighbours, T, they get a direct solve before and after (a symmetric multiplicative
Schwarz method; on a CPU, as long as that is cheap) ::

    z1 = S r,   z2 = z1 + P (r - A z1),   z = z2 + S (r - A z2),   S = A_TT^-1 on T, 0 elsewhere

The momentum of what stays is that before the cut. Cuts follow the elements: edges are as rough as the mesh is coarse.

With `spare` nodes a body is split along faces of its elements, too, and loses nothing (mechanics/splitting.py): the
elements around a node that no longer hang together through faces get a copy of it for each further group, where the
node is and with its velocity. `opened` are these faces, cut after cut, a live parameter like `removed`; pattern and
lists of A follow it (mechanics/split_pattern.py). With M the map by which copies move as the nodes that the factor
knows, M P M^T takes the place of P above.

`removed` is what the scene begins with, and a live parameter: clients cut by `sim-client cut`, which sets it; so cuts
are logged, replayed, kept by checkpoints, and taken back by a reset.

With `tear` a server looks at the largest principal stretch of each element, beside the steps, some fifty times a
second, and removes those above it, the most stretched one of neighbours first. Without a server call `torn`
(mechanics/cut_shapes.py) and set `removed`.

Source: Cotin, Delingette and Ayache, A hybrid elastic model for real-time cutting, deformations and force feedback,
2000 (removal); Smith, Bjorstad and Gropp, Domain Decomposition, 1996, section 1.3 (Schwarz).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import CutInput, Launch
from sim_server.effects._base import Effect
from sim_server.errors import InputError
from sim_server.mechanics.numbers import ranges_of
from sim_server.mechanics.removal import masses_left, present, present_nodes, whole_masses
from sim_server.mechanics.splitting import Splitting, cuts_of
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh.faces import Faces
from sim_server.scene import Scene
from sim_server.scene.live import Live
from sim_server.scene.parameters import Parameters, complaint

SCOPE = "object"
MOST_SPARES = 1_000_000
SPLIT_SCHEMES = "backward_euler", "newmark", "bdf2", "generalized_alpha", "central_difference"


def _numbers(text: str) -> str:
    try:
        ranges_of(text)
    except ValueError as error:
        raise complaint(str(error)) from None
    return text


def _cuts(text: str) -> str:
    try:
        cuts_of(text)
    except ValueError as error:
        raise complaint(str(error)) from None
    return text


class Params(Parameters):
    removed: Annotated[str, AfterValidator(_numbers), Live(listed=False)] = Field(
        default="", description='elements that are not there, by their numbers in the mesh from 0, such as "3 7-9 12"'
    )
    tear: Annotated[float | None, Live(1.05, 4)] = Field(
        default=None, gt=1, description="largest stretch of an element, above which it is removed [-]; none if left out"
    )

    spare: int = Field(
        default=0, ge=0, le=MOST_SPARES, description="nodes kept for splitting, which copies nodes; 0: none is split"
    )
    opened: Annotated[str, AfterValidator(_cuts), Live(listed=False)] = Field(
        default="",
        description='faces that hold nothing, cut after cut: 4 e + k for the k-th of element e, such as "3 7-9; 40"',
    )

    @model_validator(mode="after")
    def _spares_to_open(self) -> "Params":
        if self.opened.strip() and not self.spare:
            raise complaint("opened needs spare nodes: spare = 0")
        return self


class Cutting(Effect):
    """Removed elements of all bodies that list the effect.

    faces: of the meshes of these bodies, by index
    surface (n,): 1 at nodes of the surface; touchable (n,): 1 at those that move, which alone touch obstacles
    left (n,): part of each node's elements that is there; at_rest (n,): 1 at free nodes without any; changed_at (n,):
    time at which a node last lost or got back an element [s], -1: never
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world, self.bodies = world, [body for body, _ in listed]
        self._counted: tuple[Scene, Float64] | None = None
        if not world.inertia:
            raise InputError(
                f"object {self.bodies[0].name!r}, effect cutting: pieces that come apart need inertia, which the "
                "scheme quasi_static leaves out"
            )
        n, masses = world.nodes, world.mass.copy()
        world.uncut_mass = masses

        def left(scene: Scene) -> Float64:
            return masses_left(self._parts(scene), whole_masses(scene, world, masses))

        world.follow_into(world.mass, "cutting", compute=left)
        self.left = world.follow("cutting", compute=lambda scene: self._parts(scene).copy())
        self.faces = {body.index: Faces.of(body.mesh.tets) for body in self.bodies}
        self.surface = world.follow("cutting", compute=self._on_surface)
        self.touchable = world.touchable = np.ones(n)
        world.backend.keep(self.touchable)
        self._before, self.at_rest, self.changed_at = self.left.copy(), np.zeros(n), np.full(n, -1.0)
        world.without_elements = self.at_rest
        world.backend.keep(self._before, self.at_rest)
        world.backend.keep(self.changed_at, exact=True)
        if world.splitting is not None:
            self._keep_spares()

    def _keep_spares(self) -> None:
        """Begins what splitting needs: nodes that wait, and where copies come from."""
        w = self.world
        assert w.splitting is not None
        splitting, name = w.splitting, self.bodies[0].name
        if w.holders:
            raise InputError(
                f"object {name!r}, effect cutting: spare: objects of a scene with holders cannot be split; allowed: "
                "fixed, or spare = 0"
            )
        self.origin: Int32 = w.follow("cutting", compute=lambda scene: splitting.nodes(scene, "origin"))
        self._origin_before, self.copied_at = self.origin.copy(), np.full(w.nodes, -1.0)
        w.backend.keep(self._origin_before)
        w.backend.keep(self.copied_at, exact=True)
        self.at_rest[self.origin < 0] = 1

    def _parts(self, scene: Scene) -> Float64:
        """Returns `left` by the parameters of a scene, which two arrays ask for one after the other."""
        if self._counted is None or self._counted[0] is not scene:
            self._counted = scene, present_nodes(scene, self.world)
        return self._counted[1]

    def _on_surface(self, scene: Scene) -> Float64:
        """Returns 1 for nodes of surfaces, and for those of objects that are not cut."""
        out = np.ones(self.world.nodes)
        for body in self.bodies:
            triangles = self.surface_of(scene, body)
            out[body.nodes] = 0
            out[triangles.ravel() + body.first] = 1
        return out

    def surface_of(self, scene: Scene, body: Body) -> Int32:
        """Returns the surface of a body by the parameters of a scene, (t, 3) in its own nodes, outward."""
        faces, splitting = self.faces[body.index], self.world.splitting
        if splitting is None or body.index not in splitting.splitters:
            return faces.surface(present(scene, [body]))
        split = splitting.of(scene, body.index)
        return faces.surface(present(scene, [body]), split.tets, split.closed)

    def positions(self, scene: Scene) -> Float64:
        """Returns the positions of all nodes now (n, 3) [m]; of copies not made yet, of what they come from."""
        w, origin, waiting = self.world, np.zeros(0, np.int32), np.zeros(0, np.int64)
        if w.splitting is not None:
            origin = w.splitting.nodes(scene, "origin")
            before = w.backend.fetch(self._origin_before)  # before x is read, which has more then
            waiting = np.flatnonzero((origin >= 0) & (before < 0))
        x = w.backend.fetch(w.x).copy()
        for node in waiting:  # in their order, as copies follow what they come from
            x[node] = x[origin[node]]
        return x

    @property
    def known_to_workers(self) -> bool:
        """False where bodies may be split: workers know the mesh of the start, without what it has become."""
        return self.world.splitting is None

    def check(self, effects: Mapping[str, Effect]) -> None:
        """Raises InputError where another effect would go on as if nothing had been removed."""
        w = self.world
        for body in self.bodies:
            listed = [e for e in effects.values() if e.name in body.effects and e.name != "fixed"]
            if wrong := [e.name for e in listed if not e.cuttable(body)]:
                others = [b.name for b in w.bodies if b.elements != "linear" and wrong[0] in b.effects]
                why = f', which object {others[0]!r} has, too: set its elements = "linear"' if others else ""
                raise self._refusal(body, f"elements cannot be removed with the effect {wrong[0]}{why}")
            if body.effects["cutting"].spare:
                self._check_splittable(body, [e for e in listed if e is not self], effects)
            tied = {a.object for a in w.attachments} | {a.to for a in w.attachments}
            if body.name in tied | {end.object for s in w.springs for end in s.between}:
                raise self._refusal(body, "an object with attachments or springs cannot be cut")
        if "contact" in effects and not effects["contact"].cuttable(self.bodies[0]):
            raise self._refusal(
                self.bodies[0],
                "objects that are cut touch obstacles alone: contact = { between = false }, self = false",
            )

    def _check_splittable(self, body: Body, listed: list[Effect], effects: Mapping[str, Effect]) -> None:
        """Raises InputError where a body with spare nodes could be split, but something would not follow."""
        w = self.world
        if wrong := [e.name for e in listed if not e.splittable(body)]:
            raise self._refusal(
                body, f"spare: an object with the effect {wrong[0]} cannot be split; allowed: spare = 0"
            )
        if body.skin is not None:
            raise self._refusal(body, "spare: an object with a skin is not split, which would stay whole")
        named = w.at_start(lambda scene: scene.effects)
        if wrong := [name for name in named if not effects[name].splittable(body)]:
            raise self._refusal(body, f"spare: objects of a scene with the effect {wrong[0]} cannot be split")
        scheme = w.at_start(lambda scene: scene.integrator.scheme)
        if scheme not in SPLIT_SCHEMES:
            raise self._refusal(
                body, f"spare: objects are not split in the scheme {scheme}; allowed: {', '.join(SPLIT_SCHEMES)}"
            )

    def join(self, others: Sequence[Effect]) -> None:
        """Says what may be touched before the first step, once all that is fixed is known."""
        if self.world.splitting is not None:
            self._free_spares(self.world.splitting)
        self.touchable[:] = self.world.free * self.surface

    def _free_spares(self, splitting: Splitting) -> None:
        """Frees spare nodes of what regions have made of them; raises InputError for bodies with rollers."""
        w = self.world
        for index in splitting.splitters:
            body = w.bodies[index]
            if w.rollers is not None and w.rollers.limited[body.nodes].any():
                raise self._refusal(body, "spare: fixed with along does not go together with splitting")
        w.free[:] = w.free[
            w.at_start(lambda scene: splitting.nodes(scene, "root"))
        ]  # groups have nodes of the mesh alone
        w.free[self.origin < 0] = 1

    def _refusal(self, body: Body, why: str) -> InputError:
        return InputError(f"object {body.name!r}, effect cutting: {why}")

    def cuttable(self, body: Body) -> bool:
        return True

    @property
    def comes_first(self) -> bool:
        return True

    def cut_input(self, system: System, histories: Sequence[Float64]) -> CutInput:
        """Returns what engines need to know of cuts. histories: arrays (n, 3) that the scheme carries on, at most 3,
        beside those of the world and `dv`"""
        w = self.world
        given = CutInput([body.index for body in self.bodies], self.at_rest, self.changed_at, w.free)
        if w.splitting is None:
            return given
        first, second, third = (histories[k] if k < len(histories) else w.v for k in range(3))
        spawn = w.backend.module("effects/cutting_split.cu").bind(
            "spawn", w.nodes, origin=self.origin, origin_before=self._origin_before, x=w.x, v=w.v,
            predictor=w.predictor, damping_velocity=w.damping_velocity, dv=system.dv, first=first, second=second,
            third=third, free=w.free, at_rest=self.at_rest,
        )  # fmt: skip
        most = [system.most_blocks(body.first, body.last) for body in w.bodies]
        return replace(given, spawn=spawn, origin=self.origin, copied_at=self.copied_at, most_blocks=most)

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w = self.world
        settle: Launch = w.backend.module("effects/cutting.cu").bind(
            "settle", w.nodes, left=self.left, clock=system.clock, left_before=self._before,
            changed_at=self.changed_at, at_rest=self.at_rest, surface=self.surface, free=w.free,
            touchable=self.touchable, v=w.v, predictor=w.predictor,
        )  # fmt: skip
        if w.splitting is None:
            return [settle]
        note: Launch = w.backend.module("effects/cutting_split.cu").bind(
            "note", w.nodes, origin=self.origin, clock=system.clock, origin_before=self._origin_before,
            copied_at=self.copied_at,
        )  # fmt: skip
        return [settle, note]


def build(world: World, listed: list[tuple[Body, Any]]) -> Cutting:
    """Removes what the scene begins without. Raises InputError for numbers of elements that there are not."""
    return Cutting(world, listed)
