# SPDX-License-Identifier: MIT
"""The [[attachment]] and [[spring]] tables of a scene, which bind objects to each other and to obstacles."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

from pydantic import Field
from pydantic_core import InitErrorDetails

from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.parameters import Name, NotNegative, Parameters, Positive, Vector, Where, complaint, nearest


class Attachment(Parameters):
    """Nodes of an object that stick to the surface of another one, or to an obstacle."""

    name: Name = Field(description="for clients and logs")
    object: str = Field(description="whose nodes are attached")
    where: Where = Field(description="nodes: an expression in X, Y, Z, the rest coordinates [m]")
    to: str = Field(description="another object, or an obstacle")
    reach: Positive | None = Field(
        default=None, description="farthest that a node may be from the other's surface [m]; half its shortest edge"
    )
    stiffness: float = Field(default=100.0, ge=4, le=1e6, description="of a row over that of its nodes [-]")
    breaking: Positive | None = Field(default=None, description="force at a node that tears it off [N]")


class SpringEnd(Parameters):
    """A node of an object: the nearest one to a point."""

    object: str = Field(description="name of the object")
    at: Vector = Field(description="rest coordinates [m]")


class Spring(Parameters):
    """A spring between two nodes, of one object or of two."""

    name: Name = Field(description="for clients and logs")
    between: Annotated[list[SpringEnd], Field(min_length=2, max_length=2)] = Field(description="its two ends")
    stiffness: Positive = Field(description="force by elongation [N/m]")
    rest_length: NotNegative | None = Field(
        default=None, description="length without force [m]; the distance at the start if left out"
    )
    breaking: Positive | None = Field(default=None, description="force that breaks it [N]")


def tie_errors(
    attachments: Sequence[Attachment], springs: Sequence[Spring], objects: Sequence[str], shapes: Sequence[str],
    taken: Sequence[str], integrator: IntegratorOptions,
) -> Iterator[InitErrorDetails]:  # fmt: skip
    """Yields what is wrong with attachments and springs as a whole. taken: names of all else that has one."""
    kinds: list[tuple[str, int, Attachment | Spring]] = []
    kinds += [("attachment", k, a) for k, a in enumerate(attachments)]
    kinds += [("spring", k, s) for k, s in enumerate(springs)]
    names = list(taken)
    for kind, index, tie in kinds:
        if tie.name in names:
            yield _error(
                f"names must differ, also those of objects and all else; more than once: {tie.name}", kind, index
            )
        names.append(tie.name)
        ends = [tie.object] if isinstance(tie, Attachment) else [end.object for end in tie.between]
        for name in {*ends} - {*objects}:
            yield _error(f"no object {name!r}" + nearest(name, list(objects), "objects"), kind, index)
    for index, a in enumerate(attachments):
        others = [name for name in (*objects, *shapes) if name != a.object]
        if a.to not in others:
            yield _error(
                f"no other object and no obstacle {a.to!r}" + nearest(a.to, others, "names"), "attachment", index, "to"
            )
    if kinds and (integrator.scheme != "backward_euler" or integrator.linearizations > 1):
        found = f"{integrator.scheme!r} with linearizations = {integrator.linearizations}"
        text = f"integrator.scheme = {found}; allowed: 'backward_euler' with linearizations = 1"
        yield _error(text, *kinds[0][:2])


def _error(message: str, *place: Any) -> InitErrorDetails:
    return InitErrorDetails(type=complaint(message), loc=place, input={})
