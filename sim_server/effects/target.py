# SPDX-License-Identifier: MIT
"""Target shape: springs that pull the nodes of an object, or of a part of it, to where another shape has them.

For shapes that are wanted and not prescribed, as where a model follows a segmented image, or a soft arm a plan: a
holder moves its nodes as one rigid body, whatever that takes; here each node has a target of its own, and the material
has a say. With the nodes' masses m, k_a = `stiffness` m_a / (sum of m in `where`), and ::

    f_a = -k_a (x_a - t_a),    -df_a/dx_a = k_a I,    W = sum k_a |x_a - t_a|^2 / 2

so `stiffness` [N/m] is that of all springs together, on any mesh. The target is ::

    t = pose of ((1 - blend) (X, Y, Z) + blend (to_x, to_y, to_z))

with `to` three expressions in the rest coordinates X, Y, Z [m], which may have what `where` may but for comparisons,
and the pose that of the object. `blend` and `stiffness` are live: a client that raises `blend` from 0 to 1 makes the
motion. The energy of the springs counts as elastic, what a change adds to it as work. A quasi-static scene has to be
held by fixed nodes beside it.

Usual ranges: stiffness 0.1 to 100 times that of the part (Young's modulus times its size).

Source: Winkler, Die Lehre von der Elasticitaet und Festigkeit, 1867 (springs of a foundation); Bookstein, Principal
warps, IEEE Transactions on Pattern Analysis 11, 1989 (elastic bodies that approach landmarks).
"""

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, params_in
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh import posed
from sim_server.scene import Scene, where
from sim_server.scene.live import STIFFNESS, Live
from sim_server.scene.parameters import Parameters, Positive, Where, as_tuple, complaint

SCOPE = "object"
TEXT = "effects/target.cu"


def _readable(to: tuple[str, str, str]) -> tuple[str, str, str]:
    for text in to:
        try:
            where.parse(text, "number")
        except InputError as error:
            raise complaint(f"{where.shortened(text)}: {error}") from None
    return to


To = Annotated[tuple[str, str, str], BeforeValidator(as_tuple), AfterValidator(_readable)]


class Params(Parameters):
    to: To = Field(description="three expressions in X, Y, Z, the rest coordinates: where nodes are pulled to [m]")
    stiffness: Annotated[Positive, STIFFNESS] = Field(description="of all springs together [N/m]")
    blend: Annotated[float, Live(0, 1)] = Field(default=1.0, description="part of the way from rest to there [-]")
    where: Where | None = Field(default=None, description="nodes: an expression in X, Y, Z [m]; all if left out")


class Target(Effect):
    """The springs of all listed bodies; stiffness (n,) [N/m] is 0 at other nodes, goal (n, 3) [m]."""

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world, self._bodies = world, [body for body, _ in listed]
        self._shapes = [_shape(body, params) for body, params in listed]
        self._chosen = [_nodes(body, params) for body, params in listed]
        self.stiffness = world.follow("target", compute=self._stiffness)
        self.goal = world.follow("target", compute=self._goal)
        self._energy = np.zeros(world.nodes)
        self._owner = world.body_of(np.arange(world.nodes, dtype=np.int32)).astype(np.int64)
        world.backend.keep(self._energy)

    def _stiffness(self, scene: Scene) -> Float64:
        out = np.zeros(self.world.nodes)
        given = zip(self._bodies, self._chosen, params_in(scene, "target", self._bodies), strict=True)
        for body, chosen, params in given:
            mass = np.where(chosen, self.world.mass[body.nodes], 0)
            out[body.nodes] = params.stiffness * mass / mass.sum()
        return out

    def _goal(self, scene: Scene) -> Float64:
        out = np.zeros((self.world.nodes, 3))
        given = zip(self._bodies, self._shapes, params_in(scene, "target", self._bodies), strict=True)
        for body, shape, params in given:
            pose = scene.objects[body.index].pose
            blended = (1 - params.blend) * body.mesh.rest + params.blend * shape
            out[body.nodes] = posed(blended, pose.rotate, pose.translate)
        return out

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w = self.world
        tie: Launch = w.backend.module(TEXT).bind(
            "tie", w.nodes, stiffness=self.stiffness, goal=self.goal, x=w.x, predictor=w.predictor,
            h=w.force_coefficient, dx_dv=w.dx_dv, diagonal=system.diagonal, b=system.b,
        )  # fmt: skip
        return [tie]

    def energies(self) -> ElementEnergies:
        """k |x - t|^2 / 2 of each node [J]."""
        launch = self.world.backend.module(TEXT).bind(
            "energy", self.world.nodes, stiffness=self.stiffness, goal=self.goal, x=self.world.x, energy=self._energy
        )
        return ElementEnergies(launch, self._energy, self._owner)


def _shape(body: Body, params: Params) -> Float64:
    """Returns where the rest shape goes, before the pose, (nodes, 3) [m]."""
    try:
        return np.stack([where.values(text, body.mesh.rest) for text in params.to], axis=1)
    except InputError as error:
        raise InputError(f"object {body.name!r}, target to: {error}") from error


def _nodes(body: Body, params: Params) -> Any:
    chosen = where.nodes(params.where or "true", body.mesh)
    if not chosen.any():
        raise InputError(
            f"object {body.name!r}: target where = {params.where!r} holds 0 of {len(chosen)} nodes; it must hold "
            "one or more"
        )
    return chosen


def build(world: World, listed: list[tuple[Body, Any]]) -> Target:
    """The springs; raises InputError for a part without nodes, or an expression that is not finite at one."""
    return Target(world, listed)
