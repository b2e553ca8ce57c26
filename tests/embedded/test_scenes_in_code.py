# SPDX-License-Identifier: MIT
"""Scenes that a program builds, writes and reads back."""

import pickle

import numpy as np
import pytest

import warpfactor as wf
from sim_server.errors import InputError
from sim_server.mesh import bar

GRID = bar((2, 1, 1), (0.2, 0.1, 0.1))
YOUNG = [{"where": "X < 0.1", "young": np.float64(2e4), "name": "tip", "poisson": 0.3}, {"young": 1e4}]


def beam(**keys: object) -> wf.Scene:
    """A bar of arrays with groups, in a scene with values of NumPy."""
    groups = {"left": GRID.centroids[:, 0] < 0.1, "wall": {"nodes": np.flatnonzero(GRID.rest[:, 0] < 0.01)}}
    body = {
        "name": "beam",
        "mesh": wf.Mesh(GRID.rest, GRID.tets, groups),
        "pose": {"rotate": np.array([0, 90, 0]), "translate": (0, 0.1, 0)},
        "density": np.int64(900),
        "effects": {"corotational": {"young": YOUNG, "poisson": 0.4}, "fixed": {"group": "wall"}, "touch": True},
    }
    floor = {"name": "floor", "shape": "plane", "friction": 0.2}
    return wf.Scene(
        {"dt": 0.01, "effects": {"gravity": True, "contact": True}, "solver": {"update": "every-3"}},
        object=[body],
        obstacle=[floor],
        **keys,
    )


def test_what_is_written_is_read_back_equal(tmp_path):
    """All of it: meshes of arrays with their groups to the bit, regions, obstacles, tables without a heading."""
    scene = beam(name="beams")
    read = wf.Scene.load(scene.save(tmp_path / "beam.toml"))
    assert read == scene and read.table() == scene.table()
    (mine,), (theirs,) = (s.checked.objects for s in (scene, read))
    mesh, other = mine.load_mesh(), theirs.load_mesh()
    np.testing.assert_array_equal(mesh.rest, GRID.rest)
    assert np.array_equal(mesh.rest, other.rest) and np.array_equal(mesh.tets, other.tets)
    np.testing.assert_array_equal(mesh.groups["left"].elements, other.groups["left"].elements)
    assert read != read.with_values({"dt": 0.02})
    text = (tmp_path / "beam.toml").read_text()
    assert "[[object]]" in text and "[object.effects]" in text and "[solver]" in text


@pytest.mark.parametrize("name", ["beam", "creature", "sheet", "tentacle"])
def test_scenes_of_files_are_written_as_well(tmp_path, name):
    scene = wf.Scene.load(f"gallery/{name}", ["dt=0.004"])
    assert wf.Scene.load(scene.save(tmp_path / "copy.toml")) == scene


def test_texts_are_quoted_as_toml_has_them(tmp_path):
    """Quotes, other alphabets and control characters in the one free text that regions have."""
    body = {"name": "b", "mesh": {"bar": [1, 1, 1], "size": [1, 1, 1]}}
    young = [{"where": "X < 1", "name": 'a "tumour" \x7f \\ Ω 😀\n', "young": 1e4}]
    scene = wf.Scene(dt=0.01, object=[body | {"effects": {"corotational": {"young": young, "poisson": 0.3}}}])
    assert wf.Scene.load(scene.save(tmp_path / "scene.toml")).table()["object"] == scene.table()["object"]


def test_other_values_are_set_as_on_the_command_line():
    for scene in (beam(), wf.Scene.load("gallery/beam", ["dt=0.005"])):
        made = scene.with_values({"dt": np.float64(0.002), "solver.tolerance": "1e-4", "solver.update": "lockstep-2"})
        assert made.table()["dt"] == 0.002 and made.table()["solver"]["tolerance"] == 1e-4
        assert made.table()["solver"]["update"] == "lockstep-2"
    assert beam().table()["dt"] == 0.01
    young = beam().with_values({"object.beam.effects.corotational.poisson[tip]": 0.2})
    assert young.table()["object"][0]["effects"]["corotational"]["young"][0]["poisson"] == 0.2
    with pytest.raises(InputError, match="no object 'bean'"):
        beam().with_values({"object.bean.density": 3})


def test_scenes_go_to_other_processes(tmp_path):
    for scene in (beam(), wf.Scene.load("gallery/beam", ["dt=0.005"]), wf.Scene.load(beam().save(tmp_path / "b.toml"))):
        assert pickle.loads(pickle.dumps(scene)) == scene


def test_a_key_is_given_once():
    with pytest.raises(InputError, match="dt is given twice, in the table and as a keyword"):
        wf.Scene({"dt": 0.1}, dt=0.2)
