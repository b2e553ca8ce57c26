# SPDX-License-Identifier: MIT
"""Nodes that keep their place: v = 0 from the start.

For a fixed node i the condition is dv_i = 0. Its rows and columns leave the system: the diagonal block A_ii is the
identity, every A_ij and A_ji is zero and b_i = 0, so A stays symmetric positive definite and the Krylov iteration
never moves the node (a projective constraint; Baraff and Witkin 1998, section 5.3, with a full-rank filter).

`where` selects nodes by rest coordinates X, Y, Z [m], before the pose, so turning an object never changes what is
held. Example: ``fixed = { where = "X < 0.01" }`` holds the end face of a bar along x. Take a bound between the
first two layers of nodes: a comparison with an exact coordinate depends on rounding.

At least three nodes that are not on one line are needed to remove the six rigid motions; fewer are allowed, and the
object then turns or falls.
"""

from typing import Any

import numpy as np
from pydantic import Field

from sim_server.effects._base import Effect
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.scene import where
from sim_server.scene.parameters import Parameters, Where

SCOPE = "object"


class Params(Parameters):
    where: Where = Field(description="nodes to hold: an expression in X, Y, Z, the rest coordinates [m]")


def build(world: World, listed: list[tuple[Body, Any]]) -> Effect:
    """Marks the nodes; raises InputError where `where` selects none or all of an object."""
    for body, params in listed:
        held = where.mask(params.where, body.mesh.rest)
        if held.all() or not held.any():
            raise InputError(
                f"object {body.name!r}: fixed where = {params.where!r} holds {int(held.sum())} of {len(held)} nodes; "
                "it must hold some and leave some free"
            )
        world.free[body.nodes] = np.where(held, 0.0, world.free[body.nodes])
    return Effect()
