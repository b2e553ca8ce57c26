# SPDX-License-Identifier: MIT
"""Overlays, `--set @FILE`: TOML files with the keys of overrides."""

from pathlib import Path

import pytest

from sim_server.errors import InputError
from sim_server.scene import load

SCENE = """
dt = 0.02
[effects]
gravity = { g = [0, 0, -9.81] }
[[object]]
name = "beam"
mesh = { bar = [4, 1, 1], size = [4, 1, 1] }
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
[[object]]
name = "beam.tip"
mesh = { bar = [1, 1, 1], size = [1, 1, 1] }
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path / "scene.toml"


def test_an_overlay_is_the_overrides_that_it_lists(scene):
    overlay = """
        dt = 0.01                       # nested tables, dotted keys, and overrides as they are
        solver.tolerance = 1e-4
        set = ["object.beam.mesh={ bar = [2, 1, 1], size = [2, 1, 1] }", "solver.update=every-3"]
        [integrator]
        scheme = "newmark"
        [object.beam.effects]
        corotational.young = 2e5
        touch = {}
        fixed = { where = "X < 1" }
        [object."beam.tip"]
        density = 900
        [effects.gravity]
    """
    (scene.parent / "fast.toml").write_text(overlay)
    overrides = [
        "dt=0.01", "solver.tolerance=1e-4", "object.beam.mesh={ bar = [2, 1, 1], size = [2, 1, 1] }",
        "integrator.scheme=newmark", "object.beam.effects.corotational.young=2e5", "object.beam.effects.touch=true",
        "solver.update=every-3", "object.beam.effects.fixed.where=X < 1", "object.beam.tip.density=900",
    ]  # fmt: skip
    assert load(scene, ["@fast.toml"]).resolved() == load(scene, overrides).resolved() != load(scene).resolved()


def test_later_values_take_the_place_of_earlier_ones(scene):
    (scene.parent / "a.toml").write_text("dt = 0.01\nsolver.tolerance = 1e-4")
    (scene.parent / "b.toml").write_text("[solver]\ntolerance = 1e-5")
    found = load(scene, ["dt=0.03", "@a.toml", "solver.tolerance=1e-3", "@b.toml", "solver.max_iterations=9"])
    assert (found.dt, found.solver.tolerance, found.solver.max_iterations) == (0.01, 1e-5, 9)


def test_tables_are_merged_and_an_override_replaces_them(scene):
    (scene.parent / "merged.toml").write_text("object.beam.mesh = { bar = [8, 2, 2] }")
    assert load(scene, ["@merged.toml"]).objects[0].mesh.size == (4.0, 1.0, 1.0)
    (scene.parent / "replaced.toml").write_text("set = ['object.beam.mesh={ bar = [8, 2, 2] }']")
    with pytest.raises(InputError, match=r"scene scene\.toml with overlay replaced\.toml, object 'beam', mesh"):
        load(scene, ["@replaced.toml"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("solver.tolerence = 1e-8", ["with overlay wrong.toml, solver.tolerence = 1e-08", "did you mean 'tolerance'"]),
        ("solvr.tolerance = 1e-8", ["with overlay wrong.toml, solvr: unknown key", "did you mean 'solver'?"]),
        ("dt = -1", ["with overlay wrong.toml, dt = -1", "greater than 0"]),
        ("object.baem.density = 3", ["overlay wrong.toml, object.baem.density = 3", "did you mean 'beam'?"]),
        ("[[object]]\nname = 'b'", ["overlay wrong.toml, object = [", "write [object.NAME]"]),
        ("object.beam.effects.toch = {}", ["with overlay wrong.toml, object 'beam', effects.toch", "did you mean"]),
        ("dt.x = 3", ["overlay wrong.toml, dt.x = 3: dt = 0.02 is no table"]),
        ('"" = 3', ["overlay wrong.toml,  = 3: must be KEY=VALUE"]),
        ("dt = {}", ["with overlay wrong.toml, dt", "must be a number"]),
        ("set = 3", ["overlay wrong.toml, set = 3: must be an array of overrides"]),
        ("set = ['dt']", ["overlay wrong.toml, set = ['dt']: override 'dt': must be KEY=VALUE"]),
        ("set = ['@wrong.toml']", ["override '@wrong.toml': must be KEY=VALUE"]),
        ("dt =", ["overlay wrong.toml: not valid TOML"]),
        (b"\xff", ["overlay wrong.toml: not a text file"]),
    ],
)
def test_wrong_overlays(scene, text, words):
    (scene.parent / "wrong.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as error:
        load(scene, ["@wrong.toml"])
    assert all(word in str(error.value) for word in ["scene scene.toml", *words]), str(error.value)


@pytest.mark.parametrize("name", ["gone.toml", "", ".", "a\0b"])
def test_a_missing_overlay(scene, name):
    with pytest.raises(InputError, match=r"scene scene\.toml, overlay '.*': cannot be read .* an overlay file in TOML"):
        load(scene, [f"@{name}"])


def test_an_error_is_blamed_on_the_last_one_who_set_the_value(scene):
    (scene.parent / "a.toml").write_text("dt = -1\nsolver.tolerance = -1")
    with pytest.raises(InputError) as error:
        load(scene, ["@a.toml", "dt=-2"])
    dt, tolerance = str(error.value).splitlines()
    assert dt.startswith("scene scene.toml, dt = -2") and tolerance.startswith("scene scene.toml with overlay a.toml")


def test_the_documented_overlay(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text().split("\n## Overlays\n")[1]
    (tmp_path / "fast.toml").write_text(page.split("```")[1])
    found = load(Path(__file__).parents[2] / "deploy" / "scenes" / "beam.toml", [f"@{tmp_path / 'fast.toml'}"])
    (beam,) = found.objects
    assert (found.dt, beam.effects["corotational"].young, found.solver.tolerance) == (0.01, 2e6, 1e-4)
    assert "touch" in beam.effects and beam.mesh.size == (10.0, 2.0, 2.0)
