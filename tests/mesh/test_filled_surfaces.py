# SPDX-License-Identifier: MIT
"""Surfaces that are filled with tetrahedra: by pytetwild where it is; the cache and the volume in any case."""

import logging
from importlib.util import find_spec

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import bar, fill
from sim_server.mesh.surface import surface_triangles
from sim_server.scene import load
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.mesh.test_meshes_without_files import record, repeat, table

BOX = bar([2, 1, 1], [2.0, 1.0, 1.0])
TRIANGLES = surface_triangles(BOX.tets)
needs_pytetwild = pytest.mark.skipif(find_spec("pytetwild") is None, reason="pytetwild is not installed")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of this test alone; compiled kernels stay where they are."""
    monkeypatch.setattr(fill, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "meshes"


@pytest.fixture
def filled_with_tets(monkeypatch):
    """In place of pytetwild: the tetrahedra of the box; each call appends its envelope."""
    calls: list[float] = []

    def tetrahedra(path, points, triangles, edge, envelope):
        calls.append(envelope)
        return BOX.rest.copy(), BOX.tets.copy()

    monkeypatch.setattr(fill, "tetrahedra_inside", tetrahedra)
    return calls


def write(path, triangles=TRIANGLES, scale=1.0):
    meshio.Mesh(scale * BOX.rest, [("triangle", triangles)]).write(path)
    return path


def test_a_mesh_is_made_once_for_a_surface_and_its_options(tmp_path, cache, filled_with_tets, caplog):
    path = write(tmp_path / "box.stl")
    for edge, envelope in ((0.5, None), (0.5, None), (0.4, None), (0.4, 0.01), (0.5, None)):
        with caplog.at_level(logging.WARNING):
            mesh = fill.filled(path, edge, envelope)
        assert np.array_equal(mesh.rest, BOX.rest) and mesh.name == "box.stl"
    assert len(filled_with_tets) == 3 and len(list(cache.glob("box-*.npz"))) == 3
    assert np.isclose(filled_with_tets[2], 0.01 / 6**0.5) and filled_with_tets[0] == 1e-3
    assert caplog.text.count("filled with 12 tetrahedra in 1 part, 2 m3") == 3
    next(cache.glob("box-*.npz")).write_bytes(b"damaged")
    for edge, envelope in ((0.5, None), (0.4, None), (0.4, 0.01)):
        fill.filled(path, edge, envelope)
    assert len(filled_with_tets) == 4


def test_processes_that_fill_a_surface_at_a_time_have_the_same_mesh(tmp_path, cache, filled_with_tets, monkeypatch):
    """As of a sweep: another one has kept its mesh while this one was filling, which gives another each time."""
    write(tmp_path / "block.stl")
    stands_in, others = fill.tetrahedra_inside, []

    def beside(*given):
        if not others:
            others.append(None)
            others[0] = fill.filled(tmp_path / "block.stl", 0.1)
        rest, tets = stands_in(*given)
        return rest * (1 + 1e-3 * (len(others) == 1 and others[0] is not None)), tets

    monkeypatch.setattr(fill, "tetrahedra_inside", beside)
    mine = fill.filled(tmp_path / "block.stl", 0.1)
    np.testing.assert_array_equal(mine.rest, others[0].rest)
    np.testing.assert_array_equal(mine.rest, fill.filled(tmp_path / "block.stl", 0.1).rest)
    assert len(list(cache.iterdir())) == 1


def test_volumes_of_surface_and_mesh_are_compared(tmp_path, filled_with_tets, caplog):
    """Of a closed surface, one wound inwards, one with a hole, and one that encloses more than is filled."""

    def said(name, *given):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            fill.filled(write(tmp_path / name, *given), 0.5)
        return [r.getMessage() for r in caplog.records if "filled with" not in r.getMessage()]

    assert said("closed.ply") == [] and said("inwards.obj", TRIANGLES[:, ::-1]) == []
    (hole,) = said("hole.ply", TRIANGLES[1:])
    assert "has 1 openings and, with flat lids, encloses 2 m3, its tetrahedra +0.0%" in hole
    (larger,) = said("larger.ply", TRIANGLES, 1.05)
    assert "encloses 2.315 m3, its tetrahedra -13.6%: it passes through itself" in larger
    with pytest.raises(InputError, match=r"encloses 6.75 m3, its tetrahedra 2 m3, -70%; allowed: 25%"):
        said("wrong.ply", TRIANGLES, 1.5)


def test_a_run_is_repeated_without_the_surface_and_what_fills_it(tmp_path, filled_with_tets):
    write(tmp_path / "box.stl", scale=1000)
    made = table({"surface": "box.stl", "edge": 0.5, "scale": 0.001})
    made["object"][0]["effects"] = {"corotational": {"young": 1e4, "poisson": 0.3}, "fixed": {"where": "X < 0.01"}}
    scene = Scene.model_validate(made, context={"folder": tmp_path})
    record(Simulation(scene), tmp_path / "run.mcap")
    (tmp_path / "box.stl").unlink()
    filled_with_tets.clear()
    repeat(tmp_path / "run.mcap")
    assert filled_with_tets == []


def test_without_pytetwild_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(fill, "find_spec", lambda name: None)
    with pytest.raises(InputError) as error:
        fill.filled(write(tmp_path / "box.stl"), 0.5)
    assert "needs pytetwild" in str(error.value) and "pip install" in str(error.value) and "mesh]" in str(error.value)
    with pytest.raises(InputError, match="below the diagonal of the surface, 2"):
        fill.filled(tmp_path / "box.stl", 50.0)


@needs_pytetwild
def test_a_box_is_filled(tmp_path, monkeypatch):
    """To its volume, within the envelope; from then on the mesh is that of the cache. Nothing is left behind."""
    (here := tmp_path / "here").mkdir()
    monkeypatch.chdir(here)
    mesh = fill.filled(write(tmp_path / "box.stl"), 0.7)
    assert abs(mesh.volumes.sum() / 2 - 1) < 0.02 and mesh.volumes.min() > 0
    scene = tmp_path / "scene.toml"
    scene.write_text('dt = 0.1\n[[object]]\nname = "a"\nmesh = { surface = "box.stl", edge = 0.7 }\n')
    assert np.array_equal(load(scene).objects[0].load_mesh().tets, mesh.tets)
    assert list(here.iterdir()) == []


@needs_pytetwild
def test_what_cannot_be_filled_is_told(tmp_path, cache):
    """What the process that fills says last; the next call asks it again."""
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    with pytest.raises(InputError, match=r"flat.stl: (there is nothing inside it|pytetwild cannot fill it \(.+\))"):
        fill.tetrahedra_inside(tmp_path / "flat.stl", flat, np.array([[0, 1, 2], [1, 3, 2]]), 0.5, 1e-3)


def test_a_process_that_fails_is_an_error_of_the_mesh(tmp_path):
    """Without its surface; the message ends with the last line that it wrote."""
    with pytest.raises(InputError, match=r"box.stl: pytetwild cannot fill it \(.*surface.npz"):
        fill.run_in(tmp_path / "box.stl", tmp_path)
