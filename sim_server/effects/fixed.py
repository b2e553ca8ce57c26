# SPDX-License-Identifier: MIT
"""Nodes that keep their place, or keep it along some directions: clamps, rollers and planes of symmetry.

For a fixed node i the condition is dv_i = 0. Its rows and columns leave the system: the diagonal block A_ii is the
identity, every A_ij and A_ji is zero and b_i = 0, so A stays symmetric positive definite and the Krylov iteration
never moves the node (a projective constraint; Baraff and Witkin 1998, section 5.3, with a full-rank filter).

With `along` nodes keep their place along these directions alone, and slide in the others without friction (section 5.3
there with filters of lower rank; mechanics/rollers.py): ``fixed = { where = "X < 0.01", along = "x" }`` is a roller, or
a plane of symmetry. Directions are of the object at rest and turn with its pose, as `where` selects by rest
coordinates; while the body moves they stay what they are. A plane does not turn.

A list holds several groups: ``fixed = [{ where = "X < 0.01" }, { where = "Y < 0.01", along = "y" }]``. A node in
several keeps its place along all of their directions and what these span; with three it is a fixed one. Nodes of a
holder go where that says.

`where` selects nodes by rest coordinates X, Y, Z [m], before the pose, so turning an object never changes what is
held. Example: ``fixed = { where = "X < 0.01" }`` holds the end face of a bar along x. Take a bound between the
first two layers of nodes: a comparison with an exact coordinate depends on rounding.

At least three nodes that are not on one line are needed to remove the six rigid motions, or rollers that do the same,
such as three planes of symmetry; fewer are allowed, and the object then turns or falls.

Objects in a scene with contact, and those that attachments and springs bind, cannot have `along`: the impulses there
would push their nodes off the planes.
"""

from collections.abc import Sequence
from math import isfinite
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainValidator, model_validator

from sim_server.arrays import Float64
from sim_server.effects._base import Effect
from sim_server.errors import InputError
from sim_server.mechanics.rollers import Rollers, span_of
from sim_server.mechanics.world import Body, World
from sim_server.mesh import Mesh, pose_matrix
from sim_server.scene import where
from sim_server.scene.parameters import Parameters, Where, as_tuple, complaint, where_or_tables

SCOPE = "object"
AXES = ("x", "y", "z")


def _direction(value: Any) -> tuple[str, ...] | tuple[float, ...]:
    """Returns the names of axes, or a vector."""
    given = (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list | tuple) else ()
    if given and all(isinstance(name, str) and name in AXES for name in given):
        return given
    numbers = all(isinstance(c, int | float) and not isinstance(c, bool) and isfinite(c) for c in given)
    if len(given) == 3 and numbers and any(given):
        return tuple(float(c) for c in given)
    raise complaint('must be "x", "y" or "z", a list of these, or a vector of three numbers that is not zero')


Along = Annotated[Any, PlainValidator(_direction)]  # tuple[str, ...] or tuple[float, float, float]
ABOUT_WHERE = "nodes to hold: an expression in X, Y, Z, the rest coordinates [m]"
ABOUT_ALONG = '"x", "y" or "z", a list of these, or a vector, at rest; all directions if left out'


class Group(Parameters):
    """Nodes, and the directions along which they keep their place."""

    where: Where = Field(description=ABOUT_WHERE)
    along: Along | None = Field(default=None, description=ABOUT_ALONG)


class Params(Parameters):
    where: Where | None = Field(default=None, description=ABOUT_WHERE)
    along: Along | None = Field(default=None, description=ABOUT_ALONG)
    tables: Annotated[tuple[Group, ...], BeforeValidator(as_tuple)] | None = Field(
        default=None, description="several groups of nodes, each { where, along }"
    )

    @model_validator(mode="after")
    def _one_form(self) -> "Params":
        where_or_tables(self)
        return self

    @property
    def groups(self) -> Sequence[Group]:
        """The groups of nodes."""
        if self.tables is not None:
            return self.tables
        assert self.where is not None
        return (Group(where=self.where, along=self.along),)


def clamped_nodes(params: Params, mesh: Mesh) -> NDArray[np.bool_]:
    """Returns which nodes a group holds along all directions, (n,)."""
    held = np.zeros(len(mesh.rest), bool)
    for group in params.groups:
        if group.along is None:
            held |= where.nodes(group.where, mesh)
    return held


def build(world: World, listed: list[tuple[Body, Any]]) -> Effect:
    """Marks the nodes; raises InputError where a group has no nodes, or nothing is left free."""
    found: dict[int, Float64] = {}
    for body, params in listed:
        kept = _directions(world, body, params)
        fixed = np.array([len(span) == 3 for span in kept])
        if fixed.all():
            said = " and ".join(f"where = {group.where!r}" for group in params.groups)
            raise InputError(
                f"object {body.name!r}: fixed {said} holds {len(fixed)} of {len(fixed)} nodes; "
                "it must hold some and leave some free"
            )
        world.free[body.nodes] = np.where(fixed, 0.0, world.free[body.nodes])
        sliding = {body.first + node: span for node, span in enumerate(kept) if 0 < len(span) < 3}
        sliding = {node: span for node, span in sliding.items() if not world.held[node]}
        if sliding:
            _check_alone(world, body)
        found |= sliding
    if found:
        world.rollers = Rollers(found, world.nodes, world.backend)
    return Effect()


def _directions(world: World, body: Body, params: Params) -> list[Float64]:
    """Returns a basis of the directions along which each node of the body keeps its place."""
    turned = pose_matrix(world.at_start(lambda scene: scene.objects[body.index].pose.rotate))
    vectors: list[list[Float64]] = [[] for _ in body.mesh.rest]
    for group in params.groups:
        held = where.nodes(group.where, body.mesh)
        if not held.any():
            raise InputError(
                f"object {body.name!r}: fixed where = {group.where!r} holds 0 of {len(held)} nodes; "
                "it must hold some and leave some free"
            )
        for node in np.flatnonzero(held):
            vectors[node] += list(_vectors(group) @ turned.T)
    spans = {np.array(v).tobytes(): v for v in vectors}  # most nodes have the same ones
    bases = {key: span_of(v) for key, v in spans.items()}
    return [bases[np.array(v).tobytes()] for v in vectors]


def _vectors(group: Group) -> Float64:
    """Returns the directions of a group, (k, 3)."""
    names = [name for name in AXES if group.along is None or name in group.along]
    return np.eye(3)[[AXES.index(name) for name in names]] if names else np.array([group.along], float)


def _check_alone(world: World, body: Body) -> None:
    """Raises InputError where impulses of contact or of ties would act on the body."""
    ties = [(a.name, {a.object, a.to}) for a in world.attachments]
    ties += [(s.name, {end.object for end in s.between}) for s in world.springs]
    others = ["the effect contact"] if world.at_start(lambda scene: "contact" in scene.effects) else []
    others += [f"the attachment or spring {name!r}" for name, ends in ties if body.name in ends]
    if others:
        raise InputError(
            f"object {body.name!r}: fixed with along does not go together with {others[0]}; allowed: fixed without "
            "along, or a scene without it"
        )
