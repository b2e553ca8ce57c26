# SPDX-License-Identifier: MIT
"""The [[obstacle]] tables of a scene, and what contact needs of the scene as a whole."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Protocol

from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import InitErrorDetails

from sim_server.errors import InputError
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.live import Live
from sim_server.scene.motion import Moved
from sim_server.scene.parameters import File, NotNegative, Positive, Sizes, Vector, as_tuple, complaint, nearest
from sim_server.scene.pose import Pose

FRICTION = 0.5  # coefficient of a surface of which nothing is said
KEYS = {  # of each shape: those that it must have
    "plane": (), "sphere": ("radius",), "box": ("size",), "capsule": ("radius", "length"), "grid": ("file", "spacing"),
}  # fmt: skip


class Obstacle(Moved):
    """A rigid shape that objects touch: fixed, moved along keyframes, or moved by a client."""

    shape: Literal["plane", "sphere", "box", "capsule", "grid"] = Field(description="in a frame that pose places")
    radius: Positive | None = Field(default=None, description="of a sphere or a capsule [m]")
    size: Sizes | None = Field(default=None, description="of a box along x, y, z [m]")
    length: Positive | None = Field(default=None, description="of the axis of a capsule, along y [m]")
    file: File | None = Field(default=None, description="a closed surface, in a file that meshio reads")
    scale: Positive | None = Field(default=None, description="scale of the coordinates in the file")
    spacing: Positive | None = Field(default=None, description="of the grid of distances from the surface [m]")
    friction: Annotated[NotNegative, Live(0, 1.5)] = Field(
        default=FRICTION, description="coefficient of its surface [-]"
    )
    edge: Annotated[tuple[Vector, Vector], BeforeValidator(as_tuple)] | None = Field(
        default=None, description="ends of a cutting edge in its frame [m], which removes elements that it sweeps"
    )
    pose: Pose = Pose()

    @model_validator(mode="after")
    def _edge_that_moves(self) -> "Obstacle":
        if self.edge is None:
            return self
        if self.keyframes is None and self.moved is None:
            raise complaint('edge: an obstacle cuts as it moves; needed: keyframes or moved = "client"')
        if self.edge[0] == self.edge[1]:
            raise complaint("edge: its two ends are the same point")
        return self

    @model_validator(mode="after")
    def _keys_of_its_shape(self) -> "Obstacle":
        all_keys = sorted({key for keys in KEYS.values() for key in keys} | {"scale"})
        needed, given = KEYS[self.shape], [key for key in all_keys if getattr(self, key) is not None]
        allowed = [*needed, *(["scale"] if self.shape == "grid" else [])]
        if missing := [key for key in needed if key not in given]:
            raise complaint(f"shape {self.shape!r} needs {' and '.join(missing)}")
        if others := [key for key in given if key not in allowed]:
            raise complaint(
                f"shape {self.shape!r} has no {' and no '.join(others)}; allowed: {', '.join(allowed) or 'none'}"
            )
        return self

    @model_validator(mode="after")
    def _starts_once(self) -> "Obstacle":
        if self.keyframes is not None and self.pose != Pose():
            raise complaint("keyframes and pose: the first keyframe says where it is at the start; leave pose out")
        return self


class HasName(Protocol):
    """An object of a scene, as far as contact names it."""

    name: str

    @property
    def effects(self) -> Mapping[str, Any]: ...


def contact_errors(
    contact: Any, objects: Sequence[HasName], obstacles: Sequence[Obstacle], integrator: IntegratorOptions
) -> Iterator[InitErrorDetails]:
    """Yields what is wrong with obstacles and contact as a whole.

    contact: parameters of the effect, None without it
    """
    names, shapes = [o.name for o in objects], [o.name for o in obstacles]
    for index, name in enumerate(shapes):
        if name in names or name in shapes[:index]:
            text = f"names must differ, also those of objects and obstacles; more than once: {name}"
            yield _error(text, "obstacle", index)
        if obstacles[index].edge is not None and not any("cutting" in o.effects for o in objects):
            yield _error("it has nothing to cut: no object lists cutting = true", "obstacle", index, "edge")
    if contact is None:
        if obstacles:
            yield _error("objects touch it by the effect contact: list contact = true under [effects]", "obstacle", 0)
        return
    if not obstacles and not contact.self and (len(objects) < 2 or not contact.between):
        text = "there is nothing to touch; needed: an [[obstacle]], another object, or self = true"
        yield _error(text, "effects", "contact")
    if integrator.scheme == "quasi_static" or integrator.explicit:
        allowed = "'backward_euler', 'newmark', 'bdf2', 'generalized_alpha', 'ros2'"
        yield _error(
            f"contact with integrator.scheme = {integrator.scheme!r}; allowed: {allowed}", "effects", "contact"
        )
    pairs: list[set[str]] = []
    for index, pair in enumerate(contact.friction or ()):
        if text := _wrong_pair(set(pair.between), names, shapes, pairs, contact.self):
            yield _error(text, "effects", "contact", "friction", index, "between")
        pairs.append(set(pair.between))


def check_contact_on(device: str, contact: Any, integrator: IntegratorOptions) -> None:
    """Raises InputError for contact that the device ("cpu" or "gpu") does not have."""
    if device == "gpu" and integrator.scheme != "backward_euler":
        raise InputError(
            f"effects.contact with integrator.scheme = {integrator.scheme!r} on a GPU; allowed: 'backward_euler', or "
            "--device cpu"
        )
    if device == "gpu" and integrator.linearizations > 1:
        raise InputError(
            f"effects.contact with integrator.linearizations = {integrator.linearizations} on a GPU; allowed: 1, or "
            "--device cpu"
        )


def _wrong_pair(pair: set[str], objects: list[str], obstacles: list[str], earlier: list[set[str]], itself: bool) -> str:
    for name in sorted(pair):
        if name not in objects and name not in obstacles:
            return f"no object or obstacle {name!r}" + nearest(name, [*objects, *obstacles], "names")
    if (len(pair) != 2 and not itself) or not pair & set(objects):
        return f"{' and '.join(sorted(pair))}: must be an object, and an obstacle or another object"
    return f"{' and '.join(sorted(pair))} stand in the list already" if pair in earlier else ""


def _error(message: str, *place: str | int) -> InitErrorDetails:
    return InitErrorDetails(type=complaint(message), loc=place, input={})
