# SPDX-License-Identifier: MIT
"""Elastic constants that differ from region to region of an object, chosen per element by its centroid."""

import logging
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Discriminator, Field, Tag

from sim_server.errors import InputError
from sim_server.scene import where
from sim_server.scene.parameters import Parameters, Positive, Where, complaint

log = logging.getLogger(__name__)

Poisson = Annotated[float, Field(ge=0, lt=0.5)]


class Region(Parameters):
    """Elements whose centroid satisfies `where`, or all that are left if there is none."""

    where: Where | None = Field(default=None, description="an expression in X, Y, Z, the rest coordinates [m]")
    young: Positive = Field(description="Young's modulus [Pa]")
    poisson: Poisson | None = Field(default=None, description="Poisson's ratio [-]; default: that of the object")


def _last_takes_the_rest(regions: list[Region]) -> list[Region]:
    if not regions:
        raise complaint("must have at least one region { where = ..., young = ... }")
    for i, region in enumerate(regions[:-1]):
        if region.where is None:
            raise complaint(f"region {i + 1} has no where and takes every element left: put it last")
    return regions


def _shape_of_young(value: Any) -> str:
    return "<regions>" if isinstance(value, list) else "<number>"


# Tags in <> tell the two forms apart and are left out of messages.
Young = Annotated[
    Annotated[Positive, Tag("<number>")]
    | Annotated[list[Region], AfterValidator(_last_takes_the_rest), Tag("<regions>")],
    Discriminator(_shape_of_young),
]


def region_values(
    young: float | list[Region], poisson: float, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Young's modulus [Pa] and Poisson's ratio of each element: two arrays (m,).

    young: one value or regions, of which the first that holds at the centroid wins; poisson: where a region gives
    none; points: centroids at rest, before the pose [m], (m, 3). Raises InputError for an element in no region.
    """
    if not isinstance(young, list):
        return np.full(len(points), float(young)), np.full(len(points), float(poisson))
    chosen_young = np.zeros(len(points))
    chosen_poisson = np.full(len(points), float(poisson))
    left = np.ones(len(points), dtype=bool)
    for i, region in enumerate(young):
        here = left & where.mask(region.where or "true", points)
        if not here.any():
            log.warning("region %d (where = %r, young = %g Pa) holds no element", i + 1, region.where, region.young)
        chosen_young[here] = region.young
        if region.poisson is not None:
            chosen_poisson[here] = region.poisson
        left &= ~here
    if left.any():
        first = int(np.flatnonzero(left)[0])
        at = ", ".join(f"{c:.6g}" for c in points[first])
        raise InputError(
            f"element {first} with centroid ({at}) m is in no region of young ({int(left.sum())} such elements); "
            "add a last region without where for the rest"
        )
    return chosen_young, chosen_poisson
