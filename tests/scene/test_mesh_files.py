# SPDX-License-Identifier: MIT
"""Meshes from files, written here through meshio: reduced, repaired or refused with the offender named."""

import logging
import sys

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import Mesh, bar, check, read
from sim_server.mesh.surface import volumes
from sim_server.scene import load

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
TETS = np.array([[0, 1, 2, 3], [4, 2, 1, 3]])


@pytest.mark.parametrize(
    ("suffix", "form"),
    [(".vtk", "vtk"), (".vtu", "vtu"), (".msh", "gmsh"), (".msh", "gmsh22"), (".mesh", "medit"), (".inp", "abaqus")],
)
def test_read_and_repair_winding(tmp_path, caplog, suffix, form):
    box = bar([2, 2, 3], [1, 1, 2])
    tets = box.tets.copy()
    tets[::3] = tets[::3][:, [1, 0, 2, 3]]
    path = tmp_path / f"box{suffix}"
    surface = [] if form == "gmsh" else [("triangle", tets[:2, :3])]  # gmsh 4 would want entities for two cell types
    meshio.write(path, meshio.Mesh(box.rest, [*surface, ("tetra", tets)]), form)
    mesh = read(path)
    assert mesh.name == path.name
    with caplog.at_level(logging.WARNING):
        mesh = check(mesh)
    assert f"winding of {len(tets[::3])} of {len(tets)} tets repaired" in caplog.text
    assert np.allclose(mesh.rest, box.rest) and mesh.tets.dtype == np.int32
    assert np.allclose(volumes(mesh.rest, mesh.tets), 2.0 / len(tets))
    assert np.array_equal(np.sort(mesh.tets, axis=1), np.sort(box.tets, axis=1))


@pytest.mark.parametrize(("suffix", "form"), [(".vtk", "vtk"), (".vtu", "vtu"), (".msh", "gmsh")])
def test_quadratic_tets_are_reduced(tmp_path, caplog, suffix, form):
    pairs = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    middles = np.array([(CORNERS[TETS[0][a]] + CORNERS[TETS[0][b]]) / 2 for a, b in pairs])
    points = np.concatenate([middles, CORNERS[:4]])  # mid-edge nodes first, so corners must be renumbered
    cell = np.array([[6, 7, 8, 9, 0, 1, 2, 3, 4, 5]])
    path = tmp_path / f"quadratic{suffix}"
    meshio.write(path, meshio.Mesh(points, [("tetra10", cell)]), form)
    with caplog.at_level(logging.WARNING):
        mesh = check(read(path))
    assert "1 tetra10 cells reduced to their corners; 6 of 10 nodes dropped" in caplog.text
    assert len(caplog.records) == 1 and mesh.dropped == 6
    assert np.allclose(mesh.rest, CORNERS[:4]) and mesh.tets.tolist() == [[0, 1, 2, 3]]


def test_unreadable_files(tmp_path, capsys):
    surface = tmp_path / "surface.vtk"
    meshio.write(surface, meshio.Mesh(CORNERS, [("triangle", np.array([[0, 1, 2]]))]))
    broken = tmp_path / "broken.msh"
    broken.write_text("not a mesh\n")
    truncated = tmp_path / "truncated.vtu"
    truncated.write_text("<VTKFile><Unstr")
    other = tmp_path / "mesh.docx"
    other.write_text("?")
    beyond = tmp_path / "beyond.inp"
    meshio.write(beyond, meshio.Mesh(CORNERS, [("tetra", TETS + 3)]), "abaqus")
    vtk = tmp_path / "beyond.vtk"
    meshio.write(vtk, meshio.Mesh(CORNERS, [("tetra", TETS + 3)]))
    capsys.readouterr()
    for path, words in [
        (tmp_path / "absent.msh", ["absent.msh", "no such file"]),
        (tmp_path, ["no such file"]),
        (surface, ["surface.vtk", "no tetrahedra", "cells in it: 1 triangle", "tetra10"]),
        (broken, ["broken.msh", "cannot be read", ".vtu", ".inp"]),
        (truncated, ["truncated.vtu", "cannot be read", "formats by extension"]),
        (other, ["mesh.docx", "cannot be read", ".msh"]),
        (beyond, ["beyond.inp"]),
        (vtk, ["beyond.vtk", "tet 0 (nodes [3, 4, 5, 6])", "node numbers must be 0 to 4"]),
    ]:
        with pytest.raises(InputError) as error:
            read(path)
        assert all(w in str(error.value) for w in words), str(error.value)
    assert capsys.readouterr().out == ""


def test_a_format_that_needs_another_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    path = tmp_path / "mesh.h5m"
    path.write_bytes(b"\x89HDF")
    with pytest.raises(InputError, match=r"mesh\.h5m: reading it needs the Python package 'h5py'"):
        read(path)


def moved(rows, value):
    rest = CORNERS.copy()
    rest[rows] = value
    return rest


@pytest.mark.parametrize(
    ("rest", "tets", "words"),
    [
        (moved(2, np.nan), TETS, ["node 2 (", "coordinates are not finite"]),
        (moved(2, [0, np.inf, 0]), TETS, ["node 2 ((0, inf, 0))"]),
        (CORNERS, TETS + 1, ["tet 1 (nodes [5, 3, 2, 4])", "must be 0 to 4"]),
        (CORNERS, TETS - 1, ["tet 0 (nodes [-1, 0, 1, 2])"]),
        (CORNERS, [[0, 1, 2, 2], [4, 2, 1, 3]], ["tet 0 (nodes [0, 1, 2, 2])", "occurs twice"]),
        (moved(3, [1, 1, 0]), TETS, ["tet 0 (0 m3 at a longest edge of 1.41 m)", "zero volume"]),
        (moved(3, [0.3, 0.3, 1e-14]), TETS, ["tet 0 (", "zero volume"]),
        (CORNERS, [*TETS, [3, 2, 1, 0]], ["tet 2 (nodes [3, 2, 1, 0])", "same four nodes as an earlier tet"]),
        (moved(4, [0, 0, 0]), TETS, ["node 0 (with node 4", "coincides with another node"]),
        (moved(4, [0, 0, 1e-12]), TETS, ["node 4 (with node 0"]),
        (CORNERS, TETS[:1], ["node 4 (at (1, 1, 1))", "belongs to no tetrahedron"]),
        (CORNERS, np.zeros((0, 4), dtype=int), ["no tetrahedra"]),
        (CORNERS[:, :2], TETS, ["shape (5, 2)", "must be (n, 3)"]),
        (CORNERS, TETS[:, :3], ["shape (2, 3)"]),
        (CORNERS, TETS + 0.5, ["float64", "whole numbers"]),
        (np.zeros((9, 3)) * np.nan, TETS, ["node 0", "node 1", "node 2", "9 in all"]),
        (CORNERS * 1e200, TETS, ["zero volume"]),  # overflows
    ],
)
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_check_names_the_offender(rest, tets, words):
    with pytest.raises(InputError) as error:
        check(Mesh(np.asarray(rest), np.asarray(tets), "liver.msh"))
    assert all(w in str(error.value) for w in ["liver.msh", *words]), str(error.value)


def test_check_lets_slivers_and_small_units_through():
    sliver = Mesh(moved(3, [0.3, 0.3, 1e-6])[:4], TETS[:1].astype(np.int32), "sliver")
    assert check(sliver) is sliver
    box = bar([2, 2, 2], [1e-6, 1e-6, 1e-6])
    assert check(box) is box
    far = Mesh(box.rest * 1e6 + 1000.0, box.tets)
    assert check(far) is far


def test_three_tets_on_one_face_are_told(caplog):
    points = np.array([*CORNERS, [0.2, 0.2, 2.0]])
    with caplog.at_level(logging.WARNING):
        check(Mesh(points, np.array([*TETS, [1, 2, 3, 5]]), "liver.msh"))
    assert [r.getMessage() for r in caplog.records] == [
        "mesh liver.msh: 1 faces belong to more than two tets, as that of nodes [1, 2, 3]"
    ]


def test_a_file_in_millimetres_is_scaled(tmp_path):
    import meshio

    mesh = bar((2, 1, 1), (20.0, 10.0, 10.0))
    meshio.Mesh(mesh.rest, [("tetra", mesh.tets)]).write(tmp_path / "mm.vtk")
    scene = tmp_path / "scene.toml"
    scene.write_text('dt = 0.01\n[[object]]\nname = "a"\nmesh = { file = "mm.vtk", scale = 0.001 }\n')
    loaded = load(scene).objects[0].load_mesh()
    assert np.allclose(loaded.rest.max(axis=0), [0.02, 0.01, 0.01])
    scene.write_text('dt = 0.01\n[[object]]\nname = "a"\nmesh = { bar = [1, 1, 1], size = [1, 1, 1], scale = 2 }\n')
    with pytest.raises(InputError, match="scale belongs to a file"):
        load(scene)
