# SPDX-License-Identifier: MIT
"""A JSON schema of scene files for editors, of all effects that are installed.

It is of Draft 4, which Taplo knows (the TOML language server of "Even Better TOML" for VS Code and of other editors).
It finds unknown keys, wrong types, words and bounds; what depends on several keys, meshes or devices it leaves to the
server. Whatever a server takes it takes, too.
"""

from collections.abc import Callable
from typing import Any

from pydantic.json_schema import models_json_schema

from protocol import materials
from sim_server import effects
from sim_server.errors import InputError
from sim_server.scene.materials import ELASTIC
from sim_server.scene.model import Scene, SceneObject

DRAFT = "http://json-schema.org/draft-04/schema#"
GROUP = {"type": "string", "description": "elements or nodes that have this name in the mesh"}


def scene_schema() -> dict[str, Any]:
    """Returns the schema, as JSON has it."""
    modules = _modules()
    models = [Scene, SceneObject, *(module.Params for module in modules.values())]
    places, whole = models_json_schema(
        [(model, "validation") for model in dict.fromkeys(models)], ref_template="#/definitions/{model}"
    )
    tables: dict[str, Any] = whole["$defs"]

    def of(model: Any) -> dict[str, Any]:
        found: dict[str, Any] = tables[places[model, "validation"]["$ref"].rsplit("/", 1)[1]]
        return found

    for table in tables.values():
        _with_group(table)
    scene, body = of(Scene), of(SceneObject)
    scene["required"].remove("name")  # that of the file
    for scope, table in (("scene", scene), ("object", body)):
        listed = {name: module for name, module in modules.items() if scope == module.SCOPE}
        table["properties"]["effects"] |= {
            "type": "object",
            "additionalProperties": False,
            "properties": {
                name: _effect(name, module, of(module.Params), places[module.Params, "validation"])
                for name, module in listed.items()
            },
        }
    known = {"enum": materials.names()}
    body["properties"]["material"]["anyOf"][0] = known
    tables["Material"]["properties"]["name"] |= known
    root = places[Scene, "validation"]["$ref"].rsplit("/", 1)[1]
    definitions = {name: _draft4(table) for name, table in tables.items() if name != root}
    return {"$schema": DRAFT, **_draft4(scene), "title": "Scene of sim-server", "definitions": definitions}


def _modules() -> dict[str, Any]:
    """Returns the modules of all effects by name, without those of other packages that cannot be imported."""
    found = {}
    for name in effects.all_effects():
        try:
            found[name] = effects.effect(name)
        except InputError:
            continue
    return found


def _with_group(table: dict[str, Any]) -> None:
    """Lets a table with `where` have `group`, instead of it or beside it, as scene/parameters.py does."""
    properties = table.get("properties", {})
    if "where" not in properties or "group" in properties:
        return
    properties["group"] = GROUP
    if "where" in table.get("required", ()):
        table["required"] = [name for name in table["required"] if name != "where"]
        table["anyOf"] = [{"required": ["where"]}, {"required": ["group"]}]


def _effect(name: str, module: Any, table: dict[str, Any], reference: dict[str, Any]) -> dict[str, Any]:
    """Returns what may stand behind the name of an effect: its table, a list of tables, true or false."""
    table["title"] = name
    if name in ELASTIC:  # a material gives what the scene does not
        table.pop("required", None)
    needs = table.get("required") or table.get("anyOf")
    several = [each for each in _alternatives(table, "tables") if each.get("type") == "array"]
    switch = {"enum": [False]} if needs else {"type": "boolean"}
    about = (module.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
    return {"description": about, "anyOf": [reference, *several, switch]}


def _alternatives(table: dict[str, Any], key: str) -> list[dict[str, Any]]:
    found = table.get("properties", {}).get(key, {})
    return found.get("anyOf", [found]) if found else []


def _draft4(schema: Any) -> Any:
    """Returns a schema of Draft 2020-12, as pydantic makes it, in the words of Draft 4."""
    if isinstance(schema, list):
        return [_draft4(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    new: dict[str, Any] = {}
    for key, value in schema.items():
        if key == "properties":
            new[key] = {name: _without_title(_draft4(each)) for name, each in value.items()}
        else:
            new |= WORDS.get(key, _same(key))(value)
    if len(new.get("anyOf", ())) == 1:
        new |= new.pop("anyOf")[0]
    if "$ref" in new and len(new) > 1:  # beside which Draft 4 reads nothing
        new["allOf"] = [{"$ref": new.pop("$ref")}]
    return new


def _same(key: str) -> Callable[[Any], dict[str, Any]]:
    return lambda value: {key: _draft4(value)}


def _tuple(items: list[Any]) -> dict[str, Any]:
    alike = all(item == items[0] for item in items)
    return {"items": _draft4(items[0])} if alike else {"items": _draft4(items), "additionalItems": False}


def _without_null(alternatives: list[Any]) -> dict[str, Any]:
    """TOML has no null."""
    return {"anyOf": [_draft4(each) for each in alternatives if each != {"type": "null"}]}


def _without_title(schema: Any) -> Any:
    """pydantic makes the title of a key of its name."""
    return {key: value for key, value in schema.items() if key != "title"}


def _default(value: Any) -> dict[str, Any]:
    return {} if value is None else {"default": value}


WORDS: dict[str, Callable[[Any], dict[str, Any]]] = {
    "anyOf": _without_null,
    "const": lambda value: {"enum": [value]},
    "default": _default,
    "discriminator": lambda value: {},
    "prefixItems": _tuple,
    "exclusiveMinimum": lambda value: {"minimum": value, "exclusiveMinimum": True},
    "exclusiveMaximum": lambda value: {"maximum": value, "exclusiveMaximum": True},
    "enum": lambda value: {"enum": value},
    "required": lambda value: {"required": value} if value else {},
}
