# SPDX-License-Identifier: MIT
"""The [accuracy] table of a scene."""

import re
import sys
from typing import Annotated, Any

from pydantic import Field, PlainValidator

from sim_server.arrays import Float64
from sim_server.scene.parameters import Parameters, Positive, complaint

MOST_LINEARIZATIONS = 8  # of a step, where the scene does not say
LONGEST = sys.float_info.max  # m
ROUNDING = 1e-12  # relative residual at which an equation ends at the latest, where the scene does not say


def _position(value: Any) -> float | str:
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= LONGEST:
        return float(value)
    if isinstance(value, str) and _percent(value) is not None:
        return value
    raise complaint('must be a length above 0 [m], or a part of the size of each object from 0 to 100 %, as "0.1 %"')


def _percent(text: str) -> float | None:
    """Number before the %, None if there is none that is allowed."""
    match = re.fullmatch(r"([0-9]+\.?[0-9]*(?:[eE][+-]?[0-9]+)?) *%", text)
    return float(match[1]) if match and 0 < float(match[1]) <= 100 else None


class AccuracyOptions(Parameters):
    """How exact steps are to be."""

    position: Annotated[float | str, PlainValidator(_position, json_schema_input_type=Positive | str)] = Field(
        description="largest estimated error of a node's position in a step [m], or 'P %' of the object's size"
    )

    def position_of(self, rest: Float64) -> float:
        """Returns the bound for an object [m].

        rest: (n, 3), its nodes before the pose; its size is the largest extent of their box
        """
        if isinstance(self.position, float):
            return self.position
        return (_percent(self.position) or 0.0) / 100 * float(max(rest.max(axis=0) - rest.min(axis=0)))
