# SPDX-License-Identifier: MIT
"""Validates the effect tables of a scene: imports the effects that are listed and checks their parameters."""

from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import InitErrorDetails

from sim_server import effects
from sim_server.errors import InputError
from sim_server.scene.parameters import complaint, nearest

BELONGS = {
    "scene": "it acts on the whole scene: list it under [effects] at the top of the file",
    "object": "it acts on one object: list it under [object.effects] of that object",
}


def checked_effects(scope: str, table: Any, context: Any = None) -> dict[str, BaseModel]:
    """Returns the validated parameters of each effect in `table`, in the order of the file.

    An effect is a table, or `true` for its defaults; one that is `false` is absent. A list of tables stands for the key
    `tables` of an effect that has it. Raises ValidationError with every error in the table, each with its place.

    scope: "scene" or "object", where the table stands
    context: of the validation, with the `folder` of the scene file
    """
    if not isinstance(table, dict):
        raise complaint("must be a table of effects, as { gravity = true }")
    checked: dict[str, BaseModel] = {}
    errors: list[InitErrorDetails] = []
    for name, values in table.items():
        try:
            params = _checked(scope, name, values, context)
        except ValidationError as error:
            errors += [_moved(e, name) for e in error.errors(include_url=False)]
        else:
            checked |= {name: params} if params is not None else {}
    if errors:
        raise ValidationError.from_exception_data("effects", errors)
    return checked


def _checked(scope: str, name: str, values: Any, context: Any) -> BaseModel | None:
    if not effects.exists(name):
        raise _error("no such effect" + nearest(name, effects.all_effects(), "effects"), values)
    if values is False:
        return None
    try:
        module = effects.effect(name)
    except InputError as error:
        raise _error(str(error), values) from error
    if scope != module.SCOPE:
        raise _error(f"effect {name!r} does not belong here; {BELONGS[module.SCOPE]}", values)
    if isinstance(values, module.Params):
        return values
    if isinstance(values, list) and "tables" in module.Params.model_fields:
        values = {"tables": values}
    if values is not True and not isinstance(values, dict):
        raise _error("must be a table of parameters, true (its defaults) or false (absent)", values)
    return module.Params.model_validate({} if values is True else values, context=context)


def _error(message: str, value: Any) -> ValidationError:
    return ValidationError.from_exception_data("effect", [InitErrorDetails(type=complaint(message), input=value)])


def _moved(error: Any, name: str) -> InitErrorDetails:
    """Returns the same error with its place relative to the table of effects."""
    return InitErrorDetails(
        type=complaint(error["msg"], error["type"]), loc=(name, *error["loc"]), input=error["input"]
    )
