# SPDX-License-Identifier: MIT
"""The JSON schema of scenes: it takes what the server takes, and finds what users get wrong in one key."""

import json
import re
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft4Validator
from typer.testing import CliRunner

from sim_server import effects
from sim_server.cli import app
from sim_server.scene.json_schema import scene_schema
from tests.support.effect_samples import SAMPLES

ROOT = Path(__file__).parents[2]
SCENES = sorted([*(ROOT / "sim_server" / "gallery").glob("*.toml"), *(ROOT / "deploy" / "scenes").glob("*.toml")])
BEAM: dict[str, Any] = tomllib.loads((ROOT / "deploy" / "scenes" / "beam.toml").read_text())
NEWER = {"$defs", "prefixItems", "const", "discriminator", "dependentRequired", "unevaluatedProperties"}


@pytest.fixture(scope="module")
def schema() -> Draft4Validator:
    made = scene_schema()
    Draft4Validator.check_schema(made)
    return Draft4Validator(made)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_scenes_that_come_along_are_valid(schema: Draft4Validator, path: Path) -> None:
    assert [error.message for error in schema.iter_errors(tomllib.loads(path.read_text()))] == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.stem)
def test_scenes_of_the_docs_are_valid(schema: Draft4Validator, page: Path) -> None:
    for text in re.findall(r"^```toml\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
        assert [error.message for error in schema.iter_errors(tomllib.loads(text))] == []


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("dt",), "0.02"),
        (("dt",), 0),
        (("tolerance",), 1e-6),
        (("solver", "tolerence"), 1e-6),
        (("solver", "tolerance"), 1),
        (("solver", "preconditioner"), "choleski"),
        (("solver", "update"), "every-0"),
        (("solver", "threads"), 1.5),
        (("solver", "warp"), 1),
        (("object",), {"name": "beam"}),
        (("object", 0, "mesh", "bar"), [3, 3]),
        (("object", 0, "mesh", "split"), "middle"),
        (("object", 0, "density"), -1000),
        (("object", 0, "material"), "lever"),
        (("object", 0, "young"), 1e6),
        (("object", 0, "pose"), {"rotate": [40, 0]}),
        (("object", 0, "effects", "corotationel"), {"young": 1e6, "poisson": 0.4}),
        (("object", 0, "effects", "corotational", "poisson"), 0.5),
        (("object", 0, "effects", "corotational", "young"), [{"where": "X < 1", "yuong": 1e6}]),
        (("object", 0, "effects", "gravity"), True),
        (("object", 0, "effects", "prony"), True),
        (("object", 0, "effects", "fixed"), {"group": ["left"]}),
        (("obstacle",), [{"name": "floor", "shape": "plain"}]),
    ],
)
def test_mistakes_of_one_key_are_found(schema: Draft4Validator, place: tuple[str | int, ...], value: Any) -> None:
    scene = deepcopy(BEAM)
    *way, last = place
    table: Any = scene
    for key in way:
        table = table.setdefault(key, {}) if isinstance(table, dict) else table[key]
    table[last] = value
    assert not schema.is_valid(scene)
    (error,) = list(schema.iter_errors(scene))
    found = {tuple(each.absolute_path) for each in (error, *(error.context or ()))}
    assert any(place == at[: len(place)] or at == tuple(way) for at in found), (
        found
    )  # it is said there, or of its table


@pytest.mark.parametrize("key", ["dt", "object"])
def test_what_a_scene_needs_is_asked_for(schema: Draft4Validator, key: str) -> None:
    assert not schema.is_valid({name: value for name, value in BEAM.items() if name != key})
    without_mesh = deepcopy(BEAM)
    del without_mesh["object"][0]["mesh"]
    assert not schema.is_valid(without_mesh)


def test_other_forms_of_tables_are_valid(schema: Draft4Validator) -> None:
    for change in (
        {"fixed": {"group": "left"}},
        {"fixed": [{"where": "X < 0.1", "along": "x"}, {"group": "left"}]},
        {"fixed": {"where": {"group": "left", "where": "X < 0.1"}}},
        {"corotational": {"young": [{"group": "tumour", "young": 1e4, "poisson": 0.4}, {"young": 1e5}]}},
        {"ogden": {"mu": [1e4], "alpha": [2.0], "bulk": 1e6}},
        {"growth": {"expansion": 0.1}},
        {"fibres": {"stiffness": 1e4, "direction": [1, 0, 0]}},
        {"touch": False},
    ):
        scene = deepcopy(BEAM)
        scene["object"][0]["effects"] |= change
        assert [error.message for error in schema.iter_errors(scene)] == [], change
    soft = deepcopy(BEAM)
    soft["object"][0] |= {"material": {"name": "liver", "at": "low"}, "effects": {"corotational": {"poisson": 0.45}}}
    assert schema.is_valid(soft)


def test_every_effect_is_in_it_with_its_meaning(schema: Draft4Validator) -> None:
    root = schema.schema
    body = root["definitions"]["SceneObject"]["properties"]["effects"]["properties"]
    scene = root["properties"]["effects"]["properties"]
    assert set(body) | set(scene) == set(effects.all_effects()) and not set(body) & set(scene)
    assert all(table["description"] for table in (*body.values(), *scene.values()))
    assert set(SAMPLES) <= set(body) | set(scene)


def test_no_word_is_newer_than_draft_4(schema: Draft4Validator) -> None:
    def words(node: Any) -> set[str]:
        if isinstance(node, list):
            return {word for each in node for word in words(each)}
        if not isinstance(node, dict):
            return set()
        if isinstance(node.get("exclusiveMinimum"), (int, float)) and not isinstance(node["exclusiveMinimum"], bool):
            return {"a bound without its boolean"}
        if "$ref" in node and len(node) > 1:
            return {"words beside $ref"}
        inner = {key: each for key, each in node.items() if key not in ("properties", "definitions", "default")}
        maps = [each for key in ("properties", "definitions") for each in node.get(key, {}).values()]
        return set(inner) | words(list(inner.values())) | words(maps)

    found = words(schema.schema)
    assert not found & {*NEWER, "a bound without its boolean", "words beside $ref"} and "exclusiveMinimum" in found


def test_the_command_prints_it(schema: Draft4Validator) -> None:
    result = CliRunner().invoke(app, ["--schema"])
    assert result.exit_code == 0 and json.loads(result.stdout) == schema.schema
