# SPDX-License-Identifier: MIT
"""`material = "liver"` of an object: the density and the law of a file, what wins beside it, what is refused."""

from pathlib import Path
from typing import Any

import pytest

from protocol import materials
from sim_server.errors import InputError
from sim_server.scene import load
from sim_server.scene.model import Scene

OBJECT = 'dt = 0.01\n[[object]]\nname = "organ"\nmesh = { bar = [1, 1, 1], size = [1, 1, 1] }\n'
LIVER = materials.read("liver")
SILICONE = materials.read("ecoflex_00_30")


def resolved(folder: Path, text: str, *overrides: str) -> dict[str, Any]:
    """The resolved object of a scene with these lines in it."""
    (folder / "scene.toml").write_text(OBJECT + text)
    return dict(load(folder / "scene.toml", overrides).resolved()["object"][0])


def test_a_material_sets_density_and_law_and_is_gone(tmp_path):
    found = resolved(tmp_path, 'material = "liver"\n[object.effects]\nfixed = { where = "X < 0.1" }')
    assert "material" not in found and found["density"] == LIVER["density"]
    assert found["effects"]["stable_neo_hookean"] == LIVER["typical"]
    assert list(found["effects"]) == ["stable_neo_hookean", "fixed"]
    again = Scene.model_validate({"name": "a", "dt": 0.01, "object": [found]}, context={"files": "known"})
    assert again.resolved()["object"] == [found]


@pytest.mark.parametrize("at", materials.PLACES)
def test_an_end_of_the_range(at, tmp_path):
    found = resolved(tmp_path, f'material = {{ name = "liver", at = "{at}" }}')
    assert found["effects"] == {"stable_neo_hookean": LIVER[at]}


def test_an_override_names_a_material(tmp_path):
    found = resolved(tmp_path, "", "object.organ.material=kidney")
    assert found["effects"] == {"stable_neo_hookean": materials.read("kidney")["typical"]}


@pytest.mark.parametrize(
    ("text", "density", "mass", "law"),
    [
        ("density = 900.0", 900, None, LIVER["typical"]),
        ("mass = 2.0", None, 2, LIVER["typical"]),
        ("[object.effects]\nstable_neo_hookean = true", 1060, None, LIVER["typical"]),
        ("[object.effects]\nstable_neo_hookean = { young = 1e4 }", 1060, None, LIVER["typical"] | {"young": 1e4}),
        ("[object.effects]\nstable_neo_hookean = false\nneo_hookean = false", 1060, None, None),
    ],
)
def test_what_the_object_says_wins(text, density, mass, law, tmp_path):
    found = resolved(tmp_path, f'material = "liver"\n{text}')
    assert (found.get("density"), found.get("mass")) == (density, mass)
    assert found["effects"].get("stable_neo_hookean") == law


def test_constants_of_terms_and_regions_win(tmp_path):
    other = "[object.effects]\nogden = { bulk = 1e6 }"
    law = resolved(tmp_path, f'material = "ecoflex_00_30"\n{other}')["effects"]["ogden"]
    assert law["bulk"] == 1e6 and law["mu"][0] == SILICONE["typical"]["mu"][0]
    parts = '[object.effects]\nogden = { mu = [{ where = "X < 0.5", mu = [1e4] }, { mu = [2e4] }] }'
    law = resolved(tmp_path, f'material = "ecoflex_00_30"\n{parts}')["effects"]["ogden"]
    assert [part["mu"][0] for part in law["mu"]] == [1e4, 2e4] and law["alpha"][0] == SILICONE["typical"]["alpha"][0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('material = "livr"', "material = 'livr': no such material; did you mean 'liver'? (known materials: brain, "),
        ("material = 3", "material = 3: must be a name, or { name = \"liver\", at = \"high\" }"),
        ('material = { name = "livr" }', "material.name = 'livr': no such material; did you mean 'liver'?"),
        ('material = { name = "liver", at = "soft" }', "material.at = 'soft': must be 'low', 'typical' or 'high'"),
        ('material = { nam = "liver" }', "material.name: missing"),
        (
            'material = { name = "ecoflex_00_30", at = "low" }',
            "material.at = 'low': ecoflex_00_30 has no published range that far; allowed: \"typical\", \"high\"",
        ),
        (
            'material = "liver"\n[object.effects]\nneo_hookean = { young = 1e4, poisson = 0.3 }',
            "effects.neo_hookean: the material liver has the law stable_neo_hookean, and an object has one law; "
            "allowed: no neo_hookean, or no material, or stable_neo_hookean = false, which takes its density alone",
        ),
        (
            'material = "ecoflex_00_30"\n[object.effects]\nogden = { mu = [1e4] }',
            "effects.ogden.mu = [10000.0]: the terms of ogden belong together: give mu and alpha, or none of them",
        ),
        ('material = "liver"\neffects = 3', "effects = 3: must be a table of effects"),
        ('material = "liver"\n[object.effects]\nstable_neo_hookean = 3', "stable_neo_hookean = 3: must be a table"),
    ],
)  # fmt: skip
def test_what_is_refused(text, message, tmp_path):
    with pytest.raises(InputError) as error:
        resolved(tmp_path, text)
    assert "scene scene.toml, object 'organ', " in str(error.value) and message in str(error.value)
