# SPDX-License-Identifier: MIT
"""Mesh files with other cells than tetrahedra: split so that neighbours match, or refused with counts."""

import logging

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import check, read
from sim_server.mesh.cells import FACES
from sim_server.mesh.surface import surface_triangles, volumes
from sim_server.scene import load
from sim_server.simulation import Simulation

CUBE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
CENTRE = np.array([[0.5, 0.5, 0.5]])
SOLIDS = {"hexahedron": CUBE, "wedge": CUBE[[0, 1, 3, 4, 5, 7]], "pyramid": np.array([*CUBE[:4], [0.5, 0.5, 1]])}


def written(path, points, cells):
    meshio.Mesh(points, cells).write(path)
    return path


def boundary_area(mesh):
    a, b, c = (mesh.rest[surface_triangles(mesh.tets)[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.parametrize("shape", SOLIDS)
def test_faces_of_the_table_are_outward(shape):
    points = SOLIDS[shape]
    for face in FACES[shape]:
        a, b, c = points[list(face[:3])]
        assert np.cross(b - a, c - a) @ (a - points.mean(axis=0)) > 0


@pytest.mark.parametrize(("shape", "volume", "area"), [
    ("hexahedron", 1.0, 6.0), ("wedge", 0.5, 3 + 2**0.5), ("pyramid", 1 / 3, 1 + 5**0.5),
])  # fmt: skip
def test_one_cell_in_any_numbering(tmp_path, caplog, shape, volume, area):
    """Whichever node has the smallest number, the tetrahedra fill the cell and its surface is the cell's."""
    random = np.random.default_rng(5)
    points = SOLIDS[shape]
    for _ in range(40):
        order = random.permutation(len(points))
        cell = np.argsort(order)[None]
        caplog.clear()
        mesh = check(read(written(tmp_path / "one.vtu", points[order], [(shape, cell)])))
        found = volumes(mesh.rest, mesh.tets)
        assert (found > 0).all() and np.isclose(found.sum(), volume) and np.isclose(boundary_area(mesh), area)
        assert [r.getMessage() for r in caplog.records] == [
            f"mesh {tmp_path / 'one.vtu'}: 1 {shape} cells split into {len(found)} tetrahedra"
        ]


@pytest.mark.parametrize("suffix", [".vtk", ".vtu", ".msh", ".inp", ".mesh"])
def test_a_grid_of_hexahedra_matches_at_its_faces(tmp_path, suffix):
    """Numbered at random, so that the diagonals differ from cell to cell: no inner face is left without a neighbour."""
    n = 4
    k, j, i = (a.ravel() for a in np.mgrid[:n, :n, :n])
    points = np.stack([i, j, k], axis=1).astype(float)
    inner = ((points > 0) & (points < n - 1)).all(axis=1)
    points[inner] += np.random.default_rng(1).uniform(-0.15, 0.15, (inner.sum(), 3))
    k, j, i = (a.ravel() for a in np.mgrid[: n - 1, : n - 1, : n - 1])
    first = i + n * j + n * n * k
    cells = first[:, None] + np.array([0, 1, n + 1, n, n * n, n * n + 1, n * n + n + 1, n * n + n])
    order = np.random.default_rng(2).permutation(n**3)
    path = written(tmp_path / f"grid{suffix}", points[order], [("hexahedron", np.argsort(order)[cells])])
    mesh = check(read(path))
    assert len(mesh.tets) == 6 * 27 and len(surface_triangles(mesh.tets)) == 6 * 9 * 2
    assert np.isclose(volumes(mesh.rest, mesh.tets).sum(), 27)


def hybrid():
    """A hexahedron, on it a wedge, beside it a pyramid, whose sides have tetrahedra: all types in one mesh."""
    points = np.array([*CUBE, [0.5, 0, 1.5], [0.5, 1, 1.5], [1.8, 0.5, 0.5], [1.5, 0.5, 2.0]])
    return points, [
        ("hexahedron", np.array([[0, 1, 2, 3, 4, 5, 6, 7]])),
        ("wedge", np.array([[4, 5, 8, 7, 6, 9]])),
        ("pyramid", np.array([[1, 2, 6, 5, 10]])),
        ("tetra", np.array([[5, 6, 11, 10]])),
    ]


def test_a_hybrid_mesh_loses_nothing(tmp_path, caplog):
    points, cells = hybrid()
    mesh = check(read(written(tmp_path / "hybrid.vtu", points, cells)))
    tet = points[[5, 6, 10, 11]]
    whole = 1 + 0.25 + 0.8 / 3 + abs(np.linalg.det(tet[1:] - tet[0])) / 6
    assert np.isclose(volumes(mesh.rest, mesh.tets).sum(), whole) and len(mesh.tets) == 6 + 3 + 2 + 1
    quads, shared = 6 + 3 + 1 - 4, 1
    triangles = 2 + 4 + 4 - 2 * shared
    assert len(surface_triangles(mesh.tets)) == 2 * quads + triangles
    for words in ("1 hexahedron cells split into 6", "1 wedge cells split into 3", "1 pyramid cells split into 2"):
        assert words in caplog.text
    assert len(caplog.records) == 1


def test_a_scene_runs_with_it(tmp_path):
    points, cells = hybrid()
    written(tmp_path / "hybrid.vtu", points, cells)
    scene = tmp_path / "scene.toml"
    scene.write_text(
        'dt = 0.01\n[effects]\ngravity = true\n[solver]\npreconditioner = "block_jacobi"\n'
        '[[object]]\nname = "a"\nmesh = { file = "hybrid.vtu" }\n'
        '[object.effects]\ncorotational = { young = 1e5, poisson = 0.3 }\nfixed = { where = "X < 0.01" }\n'
    )
    sim = Simulation(load(scene))
    assert np.isclose(sim.world.mass.sum(), 1000 * volumes(sim.world.rest, sim.world.bodies[0].tets).sum())
    sim.engine.run(5)
    assert (sim.fetch().x[8:, 1] < sim.world.rest[8:, 1]).all()


def test_quadratic_hexahedra_are_reduced(tmp_path, caplog):
    pairs = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    points = np.concatenate([CUBE, [(CUBE[a] + CUBE[b]) / 2 for a, b in pairs]])
    mesh = check(read(written(tmp_path / "q.vtu", points, [("hexahedron20", np.arange(20)[None])])))
    assert np.isclose(volumes(mesh.rest, mesh.tets).sum(), 1) and mesh.dropped == 12
    assert "1 hexahedron20 cells reduced to their corners" in caplog.text


def test_what_cannot_be_split_is_refused_with_counts(tmp_path):
    cubic = np.arange(20)[None]
    points = np.random.default_rng(0).uniform(size=(20, 3))
    path = tmp_path / "cubic.msh"
    meshio.write(path, meshio.Mesh(points, [("tetra", np.array([[0, 1, 2, 3]])), ("tetra20", cubic)]), "gmsh22")
    with pytest.raises(InputError, match=r"cubic\.msh: cells of type tetra20.*1 tetra, 1 tetra20.*allowed: tetra,"):
        read(path)
    warped = CUBE.copy()
    warped[7] = [0.5, 0.2, -0.5]
    path = written(tmp_path / "warped.vtu", warped, [("hexahedron", np.arange(8)[None])])
    with pytest.raises(InputError, match=r"hexahedron 0 .*too warped to be split.*\(1 such cells\)"):
        read(path)
    beyond = written(tmp_path / "beyond.vtk", CUBE, [("hexahedron", np.arange(8)[None] + 3)])
    with pytest.raises(InputError, match=r"hexahedron 0 has nodes .*must be 0 to 7"):
        read(beyond)


def test_tetrahedra_straight_on_a_quadrilateral_must_have_its_diagonal(tmp_path):
    """Two tetrahedra on the face x = 1 of a hexahedron: fits if they share the diagonal of its smallest node."""
    points = np.array([*CUBE, [2, 0.5, 0.5]])
    hexahedron = ("hexahedron", np.arange(8)[None])
    fits = [hexahedron, ("tetra", np.array([[1, 2, 6, 8], [1, 6, 5, 8]]))]
    assert len(read(written(tmp_path / "fits.vtu", points, fits)).tets) == 8
    crossed = [hexahedron, ("tetra", np.array([[1, 2, 5, 8], [2, 6, 5, 8]]))]
    with pytest.raises(InputError, match=r"face of nodes \[1, 2, 6, 5\] along another diagonal .*\(1 such faces\)"):
        read(written(tmp_path / "crossed.vtu", points, crossed))


def test_nodes_without_cells_are_dropped_with_a_line(tmp_path, caplog):
    points = np.array([[9.0, 9, 9], *CUBE, [np.nan, 0, 0], [7, 7, 7]])
    cells = [("vertex", np.array([[0]])), ("tetra", np.array([[1, 2, 4, 5], [7, 4, 2, 5]]))]
    with caplog.at_level(logging.WARNING):
        mesh = check(read(written(tmp_path / "points.vtk", points, cells)))
    assert np.array_equal(mesh.rest, CUBE[[0, 1, 3, 4, 6]]) and mesh.dropped == 6
    assert "6 of 11 nodes dropped, which are no corner of a cell" in caplog.text and len(caplog.records) == 1


def test_springs_by_number_need_the_numbers_of_the_file(tmp_path):
    points = np.array([[9.0, 9, 9], *CUBE])
    written(tmp_path / "points.vtk", points, [("tetra", np.array([[1, 2, 4, 5]]))])
    scene = tmp_path / "scene.toml"
    scene.write_text(
        'dt = 0.01\n[[object]]\nname = "a"\nmesh = { file = "points.vtk" }\n'
        "effects.mass_spring = { springs = [[1, 2]], stiffness = 10 }\n"
    )
    with pytest.raises(InputError, match=r"object 'a'.*springs name nodes by number, but 5 nodes of points\.vtk"):
        Simulation(load(scene))
