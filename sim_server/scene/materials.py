# SPDX-License-Identifier: MIT
"""Materials by name: the key `material` of an object becomes its density and the constants of its law.

What stands in the object itself wins: density or mass, and each constant of the law. A resolved scene has the plain
effect and no `material`, so that logs and replays do not depend on the files of materials.
"""

from typing import Any, Literal

from pydantic import Field, ValidationError
from pydantic_core import InitErrorDetails

from protocol import materials
from sim_server.scene.elements import LAWS
from sim_server.scene.parameters import Parameters, complaint, nearest

ELASTIC = ("corotational", "mass_spring", *LAWS)  # an object with a material has one of them alone
TOGETHER = ("mu", "alpha")  # of ogden: the terms of one belong to those of the other


class Material(Parameters):
    """A material and the end of its published range: { name = "liver", at = "high" }."""

    name: str = Field(description="of a file in protocol/materials, without ending")
    at: Literal["low", "typical", "high"] = Field(default="typical", description="which of its constants")


def with_material(table: dict[str, Any]) -> dict[str, Any]:
    """Returns the table of an object with density and law in place of its key `material`.

    Raises ValidationError for a material that is not there, and for another law beside that of the material.
    """
    given = table.get("material")
    table = {key: value for key, value in table.items() if key != "material"}
    if given is None:
        return table
    chosen = _chosen(given)
    found = materials.read(chosen.name)
    if chosen.at not in found:
        places = ", ".join(f'"{place}"' for place in materials.PLACES if place in found)
        raise _error(f"{chosen.name} has no published range that far; allowed: {places}", ("material", "at"), chosen.at)
    if table.get("density") is None and table.get("mass") is None:
        table["density"] = found["density"]
    effects = table.get("effects")
    if effects is None or isinstance(effects, dict):
        table["effects"] = _with_law(chosen.name, found["law"], found[chosen.at], effects or {})
    return table


def _chosen(given: Any) -> Material:
    """Returns the name of a known material and which of its constants; raises ValidationError."""
    if not isinstance(given, str | dict | Material):
        raise _error('must be a name, or { name = "liver", at = "high" }', ("material",), given)
    try:
        chosen = given if isinstance(given, Material) else Material.model_validate(_as_table(given))
    except ValidationError as error:
        raise ValidationError.from_exception_data(
            "material",
            [
                InitErrorDetails(type=complaint(e["msg"], e["type"]), loc=("material", *e["loc"]), input=e["input"])
                for e in error.errors(include_url=False)
            ],
        ) from None
    if chosen.name not in materials.names():
        place = ("material",) if isinstance(given, str) else ("material", "name")
        raise _error("no such material" + nearest(chosen.name, materials.names(), "materials"), place, chosen.name)
    return chosen


def _as_table(given: Any) -> Any:
    return {"name": given} if isinstance(given, str) else given


def _with_law(name: str, law: str, constants: dict[str, Any], effects: dict[str, Any]) -> dict[str, Any]:
    """Returns the effects of an object with the law of its material; what they say of the law wins."""
    listed = effects.get(law)
    if listed is False:  # the density alone
        return effects
    if others := [e for e in ELASTIC if e != law and effects.get(e, False) is not False]:
        message = (
            f"the material {name} has the law {law}, and an object has one law; allowed: no {others[0]}, or no "
            f"material, or {law} = false, which takes its density alone"
        )
        raise _error(message, ("effects", others[0]), effects[others[0]])
    if listed is None or listed is True:
        return {law: constants, **{key: value for key, value in effects.items() if key != law}}
    if not isinstance(listed, dict):
        return effects  # the effect says what is wrong with it
    terms = [key for key in TOGETHER if key in constants and key in listed]
    if len(terms) == 1 and not _regions(listed[terms[0]]):
        message = f"the terms of {law} belong together: give mu and alpha, or none of them"
        raise _error(message, ("effects", law, terms[0]), listed[terms[0]])
    return {**effects, law: {**constants, **listed}}


def _regions(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _error(message: str, place: tuple[str, ...], value: Any) -> ValidationError:
    details = InitErrorDetails(type=complaint(message), loc=place, input=value)
    return ValidationError.from_exception_data("material", [details])
