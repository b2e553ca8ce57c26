# SPDX-License-Identifier: MIT
"""The [[holder]] tables of a scene: groups of an object's nodes that are held together, and may be moved."""

from collections.abc import Iterator, Sequence

from pydantic import Field, model_validator
from pydantic_core import InitErrorDetails

from sim_server.errors import InputError
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.motion import Moved
from sim_server.scene.obstacles import HasName
from sim_server.scene.parameters import Vector, Where, complaint, nearest
from sim_server.scene.pose import Pose


class Holder(Moved):
    """Nodes of an object that keep their distances: fixed, moved along keyframes, or moved by a client."""

    object: str = Field(description="of which it holds nodes")
    where: Where = Field(description="nodes to hold: an expression in X, Y, Z, the rest coordinates [m]")
    center: Vector | None = Field(
        default=None, description="about which it turns, where the object begins [m]; the mean of its nodes if left out"
    )

    @model_validator(mode="after")
    def _begins_at_rest(self) -> "Holder":
        first = self.keyframes[0] if self.keyframes else None
        if first is not None and first.time == 0 and Pose(rotate=first.rotate, translate=first.translate) != Pose():
            raise complaint("keyframes: that of time 0 must be without rotate and translate, since the object is there")
        return self


def check_holders_on(device: str, holders: Sequence[Holder], integrator: IntegratorOptions) -> None:
    """Raises InputError for holders that the device ("cpu" or "gpu") does not have."""
    if device == "gpu" and holders and integrator.scheme == "ros2":
        allowed = "'backward_euler', 'newmark', 'bdf2', 'generalized_alpha', 'quasi_static', or --device cpu"
        raise InputError(f"holder {holders[0].name!r} with integrator.scheme = 'ros2' on a GPU; allowed: {allowed}")


def holder_errors(
    holders: Sequence[Holder], objects: Sequence[HasName], others: Sequence[str]
) -> Iterator[InitErrorDetails]:
    """Yields what is wrong with holders as a whole. others: names that are taken."""
    names = [o.name for o in objects]
    for index, holder in enumerate(holders):
        taken = [*names, *others, *(h.name for h in holders[:index])]
        if holder.name in taken:
            text = f"names must differ, also those of objects, obstacles and holders; more than once: {holder.name}"
            yield _error(text, index)
        if holder.object not in names:
            yield _error(f"no object {holder.object!r}" + nearest(holder.object, names, "objects"), index, "object")


def _error(message: str, index: int, *place: str) -> InitErrorDetails:
    return InitErrorDetails(type=complaint(message), loc=("holder", index, *place), input={})
