# SPDX-License-Identifier: MIT
"""The reference of scene files: every key of the pydantic models, with type, default, unit, limits and meaning."""

import inspect
import re
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from docs.site.markdown import table
from sim_server import effects
from sim_server.scene.live import Live, unit_and_meaning
from sim_server.scene.model import Scene

INTRO = """\
# Keys of scene files

Every key that a scene may have, made from the models that check scenes. [Scene files](../scenes.md) explains how they
act together, which values contradict each other, and what the server chooses where a key is left out. A key that is
*required* has no default; – is a default that depends on other keys or means that there is none. *Live* keys may
[change while it runs](../scenes.md#parameters-while-it-runs). Units are those of the SI.

"""
HEAD = ("key", "type", "default", "unit", "allowed", "live", "meaning")
TOP = {"Scene": "The scene", "SceneObject": "[[object]]", "Shape": "Shapes"}
CHECKED = {  # types that a validator makes of text
    "_readable_expression": "expression",
    "_found": "file name",
    "_name": "name",
}


class Row(NamedTuple):
    """A key as the reference shows it."""

    key: str
    type: str
    default: str
    unit: str
    allowed: str
    live: str
    meaning: str


@dataclass
class Section:
    """A table of a scene: its title, what it is, its keys."""

    title: str
    about: str
    rows: list[Row]


def page() -> str:
    """The whole page in Markdown."""
    parts = [INTRO]
    parts += [_shown(section, "##") for section in sections()]
    parts += ["## Effects\n\n", EFFECTS]
    for name in effects.known_effects():
        first, *others = effect_sections(name)
        parts += [_shown(first, "###"), *(_shown(other, "####") for other in others)]
    return "".join(parts)


EFFECTS = """\
`NAME = true` takes an effect with its defaults. Those of the scene stand under `[effects]`, those of an object under
`[object.effects]`.

"""


def sections() -> Iterator[Section]:
    """Yields the tables of a scene but for effects."""
    yield from _sections(Scene, "The scene", "", set())


def effect_sections(name: str) -> list[Section]:
    """The table of an effect, and those in it."""
    module = effects.effect(name)
    where = "of the scene" if module.SCOPE == "scene" else "of an object"
    about = f"{_first_sentence(module.__doc__)} *({where})*"
    first, *others = _sections(module.Params, name, name, set())
    return [Section(name, about, first.rows), *others]


def _shown(section: Section, marks: str) -> str:
    rows = table(HEAD, section.rows) if section.rows else "No keys.\n"
    about = f"{section.about}\n\n" if section.about else ""
    return f"{marks} {section.title}\n\n{about}{rows}\n"


def _sections(
    model: type[BaseModel], title: str, path: str, told: set[type[BaseModel]], parent: type[BaseModel] | None = None
) -> Iterator[Section]:
    """Yields the table of a model and then those of the models in it, each once."""
    told.add(model)
    about = _first_sentence(model.__doc__ if "__doc__" in vars(model) else "")
    yield Section(title, about, [_row(key, field, path, parent) for key, field in model.model_fields.items()])
    for key, field in model.model_fields.items():
        place = _place(path, field.alias or key)
        for inner in _models(field.annotation):
            if inner not in told and inner is not BaseModel:
                yield from _sections(inner, _title(inner, field, place), place, told, model)


def _title(model: type[BaseModel], field: FieldInfo, place: str) -> str:
    if "." in place:
        return TOP.get(model.__name__) or place
    return f"[[{place}]]" if get_origin(_without_none(field.annotation)) is list else f"[{place}]"


def _place(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _row(key: str, field: FieldInfo, path: str, parent: type[BaseModel] | None) -> Row:
    name = field.alias or key
    description = field.description or ""
    if (
        not description and parent is not None and key in parent.model_fields
    ):  # constants of a region are those of a law
        description = parent.model_fields[key].description or ""
    unit, meaning = unit_and_meaning(description)
    marks = [f"`{name}`", _type(field.annotation, field.metadata), _default(field), unit.replace("-", "–")]
    live = "live" if any(isinstance(mark, Live) for mark in field.metadata) else ""
    return Row(*marks, _allowed(field), live, meaning or _about(field.annotation))


def _about(kind: Any) -> str:
    """What the model of a table says of itself."""
    return next((_first_sentence(model.__doc__) for model in _models(kind) if model is not BaseModel), "")


def _first_sentence(text: str | None) -> str:
    """Of a docstring, with symbols of its own left as code is not."""
    paragraph = inspect.cleandoc(text or "").partition("\n\n")[0].replace("\n", " ")
    return re.split(r"(?<=[.])\s", paragraph, maxsplit=1)[0].rstrip(":")


def _without_none(kind: Any) -> Any:
    kinds = [k for k in get_args(kind) if k is not type(None)]
    return kinds[0] if get_origin(kind) in (Union, types.UnionType) and len(kinds) == 1 else kind


def _models(kind: Any) -> Iterator[type[BaseModel]]:
    """Yields the models in an annotation."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        yield kind
    elif get_origin(kind) is not Literal:
        for inner in get_args(kind):
            yield from _models(inner)


def _type(kind: Any, marks: Any = ()) -> str:
    """An annotation in words."""
    origin = get_origin(kind)
    if origin is Annotated:
        inner, *marks = get_args(kind)
        return _type(inner, marks)
    if known := [CHECKED[name] for mark in marks if (name := _validator(mark)) in CHECKED]:
        return known[-1]
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_type(k) for k in get_args(kind) if k is not type(None)))
    if origin is tuple and get_args(kind)[1:] != (...,):
        return f"{len(get_args(kind))} {_many(_type(get_args(kind)[0]))}"
    if origin in (list, tuple):
        return f"list of {_many(_type(get_args(kind)[0]))}"
    return _plain(kind, origin)


def _plain(kind: Any, origin: Any) -> str:
    if origin is dict or any(_models(kind)):
        return "table"
    if origin is Literal:
        return " or ".join(dict.fromkeys(_type(type(value)) for value in get_args(kind)))
    words: dict[Any, str] = {bool: "boolean", int: "whole number", float: "number", str: "text", Any: "array"}
    return words.get(kind, "text")


def _validator(mark: Any) -> str:
    function: Callable[..., Any] | None = getattr(mark, "func", None)
    return getattr(function, "__name__", "")


def _many(word: str) -> str:
    """The plural of a type, as in "list of numbers"."""
    return f"lists of {word}" if word[0].isdigit() else f"{word}s"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "*required*"
    value = field.default
    if value is None or field.default_factory is not None or isinstance(value, BaseModel):
        return "–"
    return f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return f"{value:g}".replace("e-0", "e-")
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"'


def _allowed(field: FieldInfo) -> str:
    """Bounds, or the words that are allowed; of the first of several alternatives."""
    kind = _without_none(field.annotation)
    if get_origin(kind) is Literal:
        return ", ".join(f"`{_toml(value)}`" for value in get_args(kind))
    given = list(_bounds(field.annotation, field.metadata))
    words = [text for kind, text in LIMITS for mark in given if isinstance(mark, kind) for text in [text(mark)]]
    return ", ".join(dict.fromkeys(words))


LIMITS: list[tuple[type, Callable[[Any], str]]] = [
    (Gt, lambda mark: f"above {_number(mark.gt)}"),
    (Ge, lambda mark: f"at least {_number(mark.ge)}"),
    (Lt, lambda mark: f"below {_number(mark.lt)}"),
    (Le, lambda mark: f"at most {_number(mark.le)}"),
    (MinLen, lambda mark: f"length at least {mark.min_length}"),
    (MaxLen, lambda mark: f"length at most {mark.max_length}"),
]


def _number(value: float) -> str:
    return f"{int(value):,}" if float(value).is_integer() else f"{value:g}"


def _bounds(kind: Any, marks: Any) -> Iterator[Any]:
    """Yields the bounds of a field: its own, or those of its type, or of the items of that."""
    for mark in marks:
        yield from mark.metadata if isinstance(mark, FieldInfo) else [mark]
    kind = _without_none(kind)
    origin = get_origin(kind)
    if origin is Annotated:
        inner, *more = get_args(kind)
        yield from _bounds(inner, more)
    elif origin in (Union, types.UnionType, tuple, list):
        first = next(k for k in get_args(kind) if k is not type(None))
        if not (isinstance(first, type) and issubclass(first, BaseModel)):
            yield from _bounds(first, ())
