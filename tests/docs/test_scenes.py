# SPDX-License-Identifier: MIT
"""docs/scenes.md has every key of a scene with its default and what is allowed, and no others."""

import re
import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import pytest
from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic.fields import FieldInfo

from sim_server import effects
from sim_server.scene.accuracy_options import AccuracyOptions
from sim_server.scene.holders import Holder
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.live import Live
from sim_server.scene.model import MeshSource, RecordOptions, Scene, SceneObject
from sim_server.scene.obstacles import Obstacle
from sim_server.scene.pose import Pose
from sim_server.scene.solver_options import PRECONDITIONERS, SolverOptions
from sim_server.scene.ties import Attachment, Spring
from tests.docs.figures import DOCS, Row, table_under

TEXT = (DOCS / "scenes.md").read_text()
# What no type of a model says: chosen by a validator, or taken from elsewhere.
BY_HAND = {
    ("The scene", "name"): ("the file's without ending", None),
    ("[integrator]", "beta"): ("1/4", None),
    ("[integrator]", "gamma"): ("1/2", None),
    ("[solver]", "preconditioner"): (None, ", ".join(f"`{p}`" for p in PRECONDITIONERS)),
    ("[solver]", "update"): (None, "`never`, `every-N`, `async`, `adaptive`, `lockstep-D`; N and D: 1 to 999,999"),
    ("[accuracy]", "position"): (None, "above 0, or"),
    ("Objects", "density"): ("1000", None),
    ("Objects", "friction"): ("0.5", None),
    ("Obstacles", "scale"): ("1", None),
    ("Obstacles", "max_speed"): ("1", None),
    ("Obstacles", "max_turn"): ("3", None),
    ("Obstacles", "keyframes"): (None, "at least one"),
    ("Holders", "max_speed"): ("1", None),
    ("Holders", "max_turn"): ("3", None),
    ("Holders", "keyframes"): (None, "at least one"),
    ("Springs", "between"): (None, "two of"),
    ("Objects", "mesh.split"): ('"mirrored"', None),
    ("Objects", "mesh.scale"): ("1", None),
}


def types_of(kind: Any) -> list[Any]:
    """The alternatives of an annotation, without None; Annotated is kept."""
    if get_origin(kind) in (Union, types.UnionType):
        return [t for k in get_args(kind) for t in types_of(k) if t is not type(None)]
    return [kind]


def bounds(field: FieldInfo) -> list[Any]:
    """Bounds of a field: its own, those of its type, and of the first of its alternatives (a value, not regions)."""
    found: list[Any] = list(field.metadata)
    queue = types_of(field.annotation)[:1]
    while queue:
        kind = queue.pop()
        if get_origin(kind) is Annotated:
            inner, *more = get_args(kind)
            found += more
            queue += types_of(inner)[:1]
        elif get_origin(kind) in (tuple, list):
            queue += get_args(kind)[:1]
    flat = []
    for item in found:
        flat += item.metadata if isinstance(item, FieldInfo) else [item]
    return flat


def number(value: float) -> str:
    return f"{int(value):,}" if float(value).is_integer() else f"{value:g}"


def allowed(field: FieldInfo) -> str:
    """In the words of the page; empty if the type says nothing."""
    kinds = types_of(field.annotation)
    kind = get_args(kinds[0])[0] if get_origin(kinds[0]) is Annotated else kinds[0]
    if get_origin(kind) is Literal:
        return ", ".join(f"`{v}`" if isinstance(v, str) else str(v).lower() for v in get_args(kind))
    if kind is bool:
        return "true, false"
    given = bounds(field)
    low = next((b for b in given if isinstance(b, Ge | Gt)), None)
    high = next((b for b in given if isinstance(b, Le | Lt)), None)
    if lengths := [b for b in given if isinstance(b, MinLen | MaxLen)]:
        least = next(b.min_length for b in lengths if isinstance(b, MinLen))
        most = next(b.max_length for b in lengths if isinstance(b, MaxLen))
        return f"{least} to {most} {'of them' if get_origin(kind) is tuple else 'characters'}"
    if isinstance(low, Ge) and isinstance(high, Le):
        return f"{number(low.ge)} to {number(high.le)}"
    words = []
    if low is not None:
        words.append(f"at least {number(low.ge)}" if isinstance(low, Ge) else f"above {number(low.gt)}")
    if high is not None:
        words.append(f"up to {number(high.le)}" if isinstance(high, Le) else f"below {number(high.lt)}")
    return ", ".join(words)


def shown(value: Any) -> str:
    """A default, as the page has it; `` for none."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return "[" + ", ".join(map(shown, value)) + "]"
    return f"{value:g}".replace("e-0", "e-") if isinstance(value, int | float) else f'"{value}"'


def check(table: str, rows: dict[str, Row], fields: dict[str, FieldInfo]) -> None:
    """Raises AssertionError if keys, defaults or bounds differ."""
    assert set(rows) == set(fields)
    for key, field in fields.items():
        row, (default, words) = rows[key], BY_HAND.get((table, key), (None, None))
        if field.is_required() and not default:
            assert row["default"].startswith("required"), key
        elif default or isinstance(field.default, bool | int | float | str) or key == "update":
            said = row["default"].replace("`", "").replace(",", "")
            assert said == (default or shown(field.default)), f"{table} {key}"
        if words or allowed(field):
            assert row["allowed"].startswith(words or allowed(field)), f"{table} {key}: {words or allowed(field)}"


def rows_of(heading: str) -> dict[str, Row]:
    """By key; the tables of a scene that have a table of their own here are left out."""
    rows = table_under(TEXT, heading)
    return {row["key"].strip("`"): row for row in rows if not row["key"].startswith("`[")}


@pytest.mark.parametrize(
    ("heading", "fields"),
    [
        ("The scene", {k: f for k, f in Scene.model_fields.items() if k in ("dt", "name")}),
        ("[integrator]", IntegratorOptions.model_fields),
        ("[solver]", SolverOptions.model_fields),
        ("[accuracy]", AccuracyOptions.model_fields),
        ("[record]", RecordOptions.model_fields),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_keys_of_a_table(heading: str, fields: dict[str, FieldInfo]) -> None:
    check(heading, rows_of(heading), dict(fields))


def test_no_table_is_missing() -> None:
    tables = {field.alias or name for name, field in Scene.model_fields.items()} - {"dt", "name"}
    assert tables == {
        "accuracy",
        "effects",
        "integrator",
        "solver",
        "record",
        "object",
        "obstacle",
        "holder",
        "attachment",
        "spring",
    }


def test_keys_of_an_object() -> None:
    fields = {name: field for name, field in SceneObject.model_fields.items() if name not in ("mesh", "pose")}
    fields |= {f"mesh.{name}": field for name, field in MeshSource.model_fields.items()}
    fields |= {f"pose.{name}": field for name, field in Pose.model_fields.items()}
    check("Objects", rows_of("Objects"), fields)


def test_keys_of_an_obstacle() -> None:
    fields = {name: field for name, field in Obstacle.model_fields.items() if name != "pose"}
    fields |= {f"pose.{name}": field for name, field in Pose.model_fields.items()}
    check("Obstacles", rows_of("Obstacles"), fields)


def test_keys_of_a_holder() -> None:
    check("Holders", rows_of("Holders"), dict(Holder.model_fields))


def test_keys_of_attachments_and_springs() -> None:
    check("Attachments", rows_of("Attachments"), dict(Attachment.model_fields))
    check("Springs", rows_of("Springs"), dict(Spring.model_fields))


KEY = re.compile(r"`(\w+)`(?: \((.+?)\))?(?: \[(.+?)\])?(?:,|$)")


@pytest.mark.parametrize("name", effects.known_effects())
def test_keys_of_an_effect(name: str) -> None:
    rows = [row for row in table_under(TEXT, "Effects") if row["effect"].startswith(f"[{name}]")]
    assert len(rows) == 1
    assert ("(scene)" in rows[0]["effect"]) == (effects.effect(name).SCOPE == "scene")
    said = {key: (default, words) for key, default, words in KEY.findall(rows[0]["keys"].replace(" or ", " "))}
    fields = effects.effect(name).Params.model_fields
    assert set(said) == set(fields)
    for key, field in fields.items():
        default, words = said[key]
        expected = "" if field.is_required() or field.default is None else shown(field.default)
        assert default.replace("`", "").replace(",", "") == expected.replace(",", ""), key
        assert (words or "above 0") == (allowed(field) or "above 0"), key


def test_all_effects_are_listed() -> None:
    assert {row["effect"].split("]")[0][1:] for row in table_under(TEXT, "Effects")} == set(effects.known_effects())


def test_live_keys() -> None:
    rows = table_under(TEXT, "Parameters while it runs")
    said = {row["table"].strip("`[]"): set(re.findall(r"`(\w+)`", row["live keys"])) for row in rows}
    models: dict[str, Any] = {name: effects.effect(name).Params for name in effects.known_effects()}
    models |= {"object": SceneObject, "obstacle": Obstacle, "holder": Holder, "spring": Spring}
    marked = {
        name: {key for key, field in model.model_fields.items() if any(isinstance(m, Live) for m in field.metadata)}
        for name, model in models.items()
    }
    assert said == {name: keys for name, keys in marked.items() if keys}
