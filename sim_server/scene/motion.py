# SPDX-License-Identifier: MIT
"""Keys of what moves as the scene or a client says: obstacles and holders."""

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sim_server.scene.parameters import Name, NotNegative, Parameters, Positive, complaint
from sim_server.scene.pose import Pose

CLIENT = {"max_speed": 1.0, "max_turn": 3.0}  # defaults of what a client moves


class Keyframe(Pose):
    """Pose at a time."""

    time: NotNegative = Field(description="of the simulation [s]")


class Moved(Parameters):
    """Base of what is fixed, moved along keyframes, or moved by a client."""

    name: Name = Field(description="for clients and logs")
    keyframes: Annotated[list[Keyframe], Field(min_length=1)] | None = Field(
        default=None, description="poses at ascending times, held before the first and after the last"
    )
    moved: Literal["client"] | None = Field(default=None, description="clients give its poses")
    max_speed: Positive | None = Field(default=None, description="at which it goes to a client's pose [m/s]")
    max_turn: Positive | None = Field(default=None, description="at which it turns to a client's pose [rad/s]")

    @model_validator(mode="before")
    @classmethod
    def _bounded_by_default(cls, table: Any) -> Any:
        if not isinstance(table, dict) or table.get("moved") != "client":
            return table
        return {**table, **{key: value for key, value in CLIENT.items() if table.get(key) is None}}

    @model_validator(mode="after")
    def _one_motion(self) -> "Moved":
        if self.keyframes is not None and self.moved is not None:
            raise complaint("keyframes and moved: allowed is one of the two")
        if self.moved is None and (given := [key for key in CLIENT if getattr(self, key) is not None]):
            raise complaint(" and ".join(given) + ' without moved = "client", whose poses they bound')
        for before, after in pairwise(self.keyframes or ()):
            if not before.time < after.time:
                raise complaint(f"keyframes: time {after.time:g} s after {before.time:g} s; times must ascend")
        return self
