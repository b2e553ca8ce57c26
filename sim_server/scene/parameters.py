# SPDX-License-Identifier: MIT
"""Base class of all tables of a scene file: strict types, no unknown keys, finite numbers.

The tables of a scene and the `Params` of each effect derive from `Parameters`, so that one wrong key or value is
reported in the same words everywhere, together with the keys that exist.
"""

from difflib import get_close_matches
from os.path import isfile
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ValidatorFunctionWrapHandler

from protocol.channels import check_name
from protocol.refused import Refused
from sim_server.errors import InputError
from sim_server.scene import where


class Parameters(BaseModel):
    """A table of a scene file. Types are strict: "1" is no number and 1 is no boolean."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @property
    def variant(self) -> str:
        """Kernels that an effect needs: bodies with different values are built apart (effects/_base.py, Build)."""
        return ""

    def variant_of(self, elements: str) -> str:
        """`variant` of a body with these elements, as scene/elements.py names their kinds."""
        return self.variant

    @model_validator(mode="wrap")
    @classmethod
    def _name_the_known_keys(cls, table: Any, validate: ValidatorFunctionWrapHandler) -> Any:
        chooses = "where" in cls.model_fields and "group" not in cls.model_fields
        try:
            return validate(_with_group(cls, table) if chooses else table)
        except ValidationError as error:
            known = [field.alias or name for name, field in cls.model_fields.items()] + ["group"] * chooses
            details = [_with_known_keys(e, known) for e in error.errors(include_url=False)]
            raise ValidationError.from_exception_data(cls.__name__, details) from None


def _with_group(cls: type[Parameters], table: Any) -> Any:
    """Returns a table with its key `group` as part of `where`, so that all who read `where` know groups.

    A table that may have a name, but need not, has that of the group.
    """
    if not isinstance(table, dict) or "group" not in table:
        return table
    if not isinstance(table["group"], str):
        error = InitErrorDetails(type=complaint("must be the name of a group"), loc=("group",), input=table["group"])
        raise ValidationError.from_exception_data(cls.__name__, [error])
    rest = {key: value for key, value in table.items() if key != "group"}
    given = _of_a_group(table.get("where"))
    if given is not None and not isinstance(given, str):
        return rest  # its own error
    field = cls.model_fields.get("name")
    named = {"name": table["group"]} if field is not None and not field.is_required() else {}
    return {**named, **rest, "where": where.of_group(table["group"], given)}


def _with_known_keys(error: Any, known: list[str]) -> InitErrorDetails:
    kind, message = error["type"], error["msg"]
    if kind == "extra_forbidden" and len(error["loc"]) == 1:
        kind, message = "unknown_key", "unknown key" + nearest(str(error["loc"][0]), known, "keys")
    return InitErrorDetails(type=complaint(message, kind), loc=error["loc"], input=error["input"])


def complaint(message: str, kind: str = "refused") -> PydanticCustomError:
    """Returns an error for a validator to raise; the report shows its message unchanged, after place and value."""
    return PydanticCustomError(kind, "{message}", {"message": message})  # type: ignore[arg-type]


def nearest(word: str, known: list[str], what: str) -> str:
    """Returns the end of a message about an unknown word: the most similar known ones, then all."""
    similar = get_close_matches(word, known, n=3, cutoff=0.6)
    guess = f"; did you mean {' or '.join(repr(n) for n in similar)}?" if similar else ""
    return f"{guess} (known {what}: {', '.join(sorted(known))})"


def where_or_tables(params: BaseModel) -> None:
    """Raises unless an effect has either `where` or a list of `tables`, and nothing next to the list."""
    given = vars(params)
    if (given["where"] is None) == (not given["tables"]):
        raise complaint("needs where = ..., or a list of tables with where = ... each")
    nothing_beside_tables(params)


def nothing_beside_tables(params: BaseModel) -> None:
    """Raises if an effect has a list of `tables` and, next to it, a key of another value than its default."""
    given = vars(params)
    for key, field in type(params).model_fields.items():
        if given["tables"] is not None and key != "tables" and given[key] not in (None, field.default):
            raise complaint(f"{key}: stands in the tables of the list")


def as_tuple(value: Any) -> Any:
    """Converts an array of TOML to a tuple; other values stay as they are."""
    return tuple(value) if isinstance(value, list) else value


def _of_a_group(value: Any) -> Any:
    """Returns the expression of { group = "NAME" }, which may have `where` beside it; other values as they are."""
    if not isinstance(value, dict) or not {"group"} <= value.keys() <= {"group", "where"}:
        return value
    texts = all(isinstance(each, str) for each in value.values())
    return where.of_group(value["group"], value.get("where")) if texts else value


def _readable_expression(text: str) -> str:
    try:
        where.parse(text)
    except InputError as error:
        raise complaint(str(error)) from None
    return text


def _found(name: str, info: ValidationInfo) -> str:
    if (info.context or {}).get("files") is False:
        raise complaint("names a file, which is not read here")
    if (info.context or {}).get("files") == "known":  # of a resolved scene that is validated again
        return name
    path = Path((info.context or {}).get("folder", ".")) / name
    if not isfile(path):  # unlike Path.is_file, never raises: names may be too long or hold a null byte
        raise complaint(
            f"no such file ({where.shortened(str(path), 200)}); a relative path starts at the folder of the scene file"
        )
    return str(path.resolve())


def _name(name: str) -> str:
    try:
        return check_name(name, "name")  # it becomes part of a channel's key
    except Refused:
        raise complaint("must be 1 to 64 characters of A-Z a-z 0-9 _ . -") from None


Name = Annotated[str, AfterValidator(_name)]
Vector = Annotated[tuple[float, float, float], BeforeValidator(as_tuple)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Sizes = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(as_tuple)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Counts = Annotated[tuple[Count, Count, Count], BeforeValidator(as_tuple)]
OF_GROUP = {
    "type": "object",
    "properties": {"group": {"type": "string"}, "where": {"type": "string"}},
    "required": ["group"],
    "additionalProperties": False,
}
OfGroup = Annotated[dict[str, str], WithJsonSchema(OF_GROUP)]
Where = Annotated[
    str, BeforeValidator(_of_a_group, json_schema_input_type=str | OfGroup), AfterValidator(_readable_expression)
]
File = Annotated[str, AfterValidator(_found)]
