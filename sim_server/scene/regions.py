# SPDX-License-Identifier: MIT
"""Material constants by region of an object; the region of an element is found by its centroid."""

import logging
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationError, create_model, model_validator
from pydantic_core import InitErrorDetails
from pydantic_core.core_schema import ValidatorFunctionWrapHandler

from sim_server.arrays import Float64, Int32
from sim_server.errors import InputError
from sim_server.scene import where
from sim_server.scene.parameters import Parameters, Positive, Where, complaint

log = logging.getLogger(__name__)

Poisson = Annotated[float, Field(gt=-1, lt=0.5)]  # positive definite in between; below 0: auxetic


class Selection(Parameters):
    """Selects the elements whose centroid satisfies `where`, or all remaining ones without it."""

    where: Where | None = Field(default=None, description="an expression in X, Y, Z, the rest coordinates [m]")
    name: Annotated[str, Field(min_length=1, max_length=200)] | None = Field(
        default=None, description="by which its constants are set; that of its group if left out"
    )


class Region(Selection):
    """Selected elements and their constants of linear elasticity."""

    young: Positive = Field(description="Young's modulus [Pa]")
    poisson: Poisson | None = Field(default=None, description="Poisson's ratio [-]; default: the one of the object")


class Regional(Parameters):
    """Constants of a material. The first field may be a list of regions.

    A later field whose default is None is required, unless every region gives it.
    """

    @model_validator(mode="wrap")
    @classmethod
    def _given_somewhere(cls, table: Any, validate: ValidatorFunctionWrapHandler) -> Any:
        made = validate(table)
        first, *others = cls.model_fields
        regions = getattr(made, first)
        regions = regions if isinstance(regions, list) and isinstance(regions[0], Selection) else [made]
        missing = [
            name
            for name in others
            if cls.model_fields[name].default is None
            and getattr(made, name) is None
            and any(getattr(r, name, None) is None for r in regions)
        ]
        if missing:
            details = [InitErrorDetails(type="missing", loc=(name,), input=table) for name in missing]
            raise ValidationError.from_exception_data(cls.__name__, details)
        return made


def _last_takes_the_rest(regions: list[Selection]) -> list[Selection]:
    if not regions:
        raise complaint("must have at least one region { where = ..., young = ... }")
    for i, region in enumerate(regions[:-1]):
        if region.where is None:
            raise complaint(f"region {i + 1} has no where and takes every element left: put it last")
    return regions


def _is_list_of_tables(value: Any) -> str:
    tables = isinstance(value, list) and (not value or isinstance(value[0], (dict, Selection)))
    return "<regions>" if tables else "<value>"


def _shape_of_young(value: Any) -> str:
    return "<regions>" if isinstance(value, list) else "<value>"


# Tags in <> tell the two forms apart and are left out of messages.
Young = Annotated[
    Annotated[Positive, Tag("<value>")]
    | Annotated[list[Region], AfterValidator(_last_takes_the_rest), Tag("<regions>")],
    Discriminator(_shape_of_young),
]


def by_region(kinds: Mapping[str, Any]) -> Any:
    """Returns the type of the first constant of a law, which may be a list of regions instead of one value.

    In each region the first constant is required; others not given there are the ones of the object (see Regional).

    kinds: types of all constants of the law, by name
    """
    first, *others = kinds
    fields: dict[str, Any] = {first: (kinds[first], Field(...))}
    fields |= {name: (kinds[name] | None, None) for name in others}
    region = create_model(f"Region of {first}", __base__=Selection, **fields)
    return Annotated[
        Annotated[kinds[first], Tag("<value>")]
        | Annotated[list[region], AfterValidator(_last_takes_the_rest), Tag("<regions>")],  # type: ignore[valid-type]
        Discriminator(_is_list_of_tables),
    ]


def constants_by_region(
    constants: Mapping[str, Any], points: Float64, unit: str = "", members: where.Members | None = None
) -> dict[str, Float64]:
    """Returns each constant of each element by name: (m,), or (m, 3) for vectors.

    Raises InputError for an element in no region.

    constants: by name as in the scene; the first may be a list of regions, of which the first that holds at the
        centroid wins
    points: centroids at rest, before the pose [m], (m, 3)
    unit: of the first constant, for messages; members: which elements groups of the mesh have
    """
    first, *others = constants
    regions = constants[first]
    if not isinstance(regions, list):
        return {name: _everywhere(value, len(points)) for name, value in constants.items()}
    # A constant that is None is given in each region, whose values replace the ones of the first region below.
    chosen_others = {n: getattr(regions[0], n) if constants[n] is None else constants[n] for n in others}
    chosen = {name: _everywhere(value, len(points)) for name, value in chosen_others.items()}
    chosen = {first: np.zeros((len(points), *np.shape(getattr(regions[0], first)))), **chosen}
    left = np.ones(len(points), dtype=bool)
    for i, region in enumerate(regions):
        here = left & where.mask(region.where or "true", points, members)
        if not here.any():
            value = getattr(region, first)
            shown = f"{value:g} {unit}".strip() if isinstance(value, float) else value
            log.warning("region %d (where = %r, %s = %s) holds no element", i + 1, region.where, first, shown)
        for name in constants:
            if (given := getattr(region, name)) is not None:
                chosen[name][here] = given
        left &= ~here
    if left.any():
        number = int(np.flatnonzero(left)[0])
        at = ", ".join(f"{c:.6g}" for c in points[number])
        raise InputError(
            f"element {number} with centroid ({at}) m is in no region of {first} ({int(left.sum())} such elements); "
            "add a last region without where for the rest"
        )
    return chosen


def _everywhere(value: Any, elements: int) -> Float64:
    return np.broadcast_to(np.asarray(value, float), (elements, *np.shape(value))).copy()


def region_values(
    young: float | list[Region], poisson: float | None, points: Float64, members: where.Members | None = None
) -> tuple[Float64, Float64]:
    """Returns Young's modulus [Pa] and Poisson's ratio [-] of each element, (m,) each; see constants_by_region."""
    found = constants_by_region({"young": young, "poisson": poisson}, points, "Pa", members)
    return found["young"], found["poisson"]


def region_numbers(value: Any, points: Float64, members: where.Members | None = None) -> Int32:
    """Returns the region of each element, (m,): its place in the list of regions, 0 where there is one value for all.

    value: the constant that may be a list of regions; points, members: as of constants_by_region
    """
    number = np.zeros(len(points), np.int32)
    left = np.ones(len(points), dtype=bool)
    for i, region in enumerate(value if isinstance(value, list) else []):
        here = left & where.mask(region.where or "true", points, members)
        number[here] = i
        left &= ~here
    return number
