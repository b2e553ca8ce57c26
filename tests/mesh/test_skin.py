# SPDX-License-Identifier: MIT
"""A fine surface embedded in a mesh moves with it; what cannot be one is refused."""

import logging
from pathlib import Path

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import Mesh
from sim_server.mesh import bar as bar_mesh
from sim_server.mesh.skin import MOST_WEIGHT, embed, read_skin
from sim_server.mesh.surface_file import read_surface
from sim_server.recording import messages
from sim_server.scene import load
from sim_server.simulation import Simulation
from tests.scenes import jittered_bar

SIZE = (2.0, 1.0, 1.0)
MAP, SHIFT = np.array([[1.1, 0.3, 0], [-0.2, 0.9, 0.4], [0.1, 0, 1.3]]), np.array([1.0, -2, 3])
SCENE = """
dt = 0.02
[effects]
gravity = {{ g = [0, -9.81, 0] }}
[[object]]
name = "liver"
mesh = {{ file = "liver.vtu", scale = 0.001 }}
{skin}
pose = {{ rotate = [40, 0, 70], translate = [1, 2, 3] }}
[object.effects]
corotational = {{ young = 1e4, poisson = 0.4 }}
fixed = {{ where = "X < 0.01" }}
"""


@pytest.fixture
def mesh() -> Mesh:
    return Mesh(*jittered_bar((5, 3, 3), SIZE))


def moved(nodes: np.ndarray, weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("sc,scd->sd", weights, x[nodes])


def test_an_affine_motion_moves_each_vertex_exactly_inside_and_outside(mesh: Mesh) -> None:
    points = np.random.default_rng(0).uniform((-0.1, -0.1, -0.1), (2.1, 1.1, 1.1), (3000, 3))
    nodes, weights, outside = embed(points, mesh)
    expected = np.linalg.norm(points - np.clip(points, 0, SIZE), axis=1)
    np.testing.assert_allclose(outside, expected, atol=1e-12)
    inside = outside == 0
    assert 500 < inside.sum() < 2500
    assert weights[inside].min() > -1e-9 and abs(weights).max() <= MOST_WEIGHT
    np.testing.assert_allclose(moved(nodes, weights, mesh.rest), points, atol=1e-12)
    np.testing.assert_allclose(moved(nodes, weights, mesh.rest @ MAP.T + SHIFT), points @ MAP.T + SHIFT, atol=1e-12)


def test_vertices_on_nodes_edges_and_faces_are_inside(mesh: Mesh) -> None:
    corners = mesh.rest[mesh.tets]
    points = np.concatenate([mesh.rest, corners[:, :2].mean(axis=1), corners[:, 1:].mean(axis=1)])
    nodes, weights, outside = embed(points, mesh)
    assert not outside.any() and weights.min() > -1e-9
    np.testing.assert_allclose(moved(nodes, weights, mesh.rest), points, atol=1e-12)


def test_beside_small_tetrahedra_a_large_one_is_found() -> None:
    """The nearest middle of a tetrahedron is that of another one."""
    small = bar_mesh((4, 4, 4), (0.1, 0.1, 0.1), "kuhn")
    large = np.array([[-10.0, 0, 0], [0, 0, 0], [-5, 5, 0], [-5, 0, 5]]) - [0.01, 0, 0]
    mesh = Mesh(
        np.concatenate([small.rest, large]), np.concatenate([small.tets, [[125, 126, 127, 128]]]).astype(np.int32)
    )
    point = 0.97 * large[1] + 0.01 * (large[0] + large[2] + large[3])
    nodes, weights, outside = embed(point[None], mesh)
    assert nodes.tolist() == [[125, 126, 127, 128]] and outside[0] == 0
    np.testing.assert_allclose(weights, [[0.01, 0.97, 0.01, 0.01]], atol=1e-12)


def test_weights_at_flat_tetrahedra_are_bounded() -> None:
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-3]]), np.array([[0, 1, 2, 3]], np.int32))
    nodes, weights, outside = embed(np.array([[0.3, 0.3, 0.05], [0.3, 0.3, 0.002]]), flat)
    np.testing.assert_allclose(abs(weights).max(axis=1), [MOST_WEIGHT, 2], rtol=1e-9)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    np.testing.assert_allclose(outside, [0.049, 0.001], atol=1e-12)
    np.testing.assert_allclose(moved(nodes, weights, flat.rest)[1], [0.3, 0.3, 0.002], atol=1e-12)


def write_scene(folder: Path, skin: str) -> Path:
    box = bar_mesh((4, 2, 2), (2000, 1000, 1000), "kuhn")
    meshio.write(folder / "liver.vtu", meshio.Mesh(box.rest, [("tetra", box.tets)]))
    (folder / "scene.toml").write_text(SCENE.format(skin=skin))
    return folder / "scene.toml"


FAR = np.array([[0.0, 600, 100], [2000, 600, 100], [2000, 1550, 100]])
QUAD = np.array([[0.0, 100, 100], [2000, 100, 100], [2000, 1050, 100], [0, 1050, 100], [9e9, 9e9, 9e9]])


@pytest.mark.parametrize(
    ("suffix", "top", "warned"),
    [("obj", 1050, ""), ("stl", 1050, ""),
     ("ply", 1150, "2 of 4 vertices lie outside the mesh, up to 0.15 m (7.5 % of its size)\n")],
)  # fmt: skip
def test_a_file_is_scaled_and_posed_as_its_mesh(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, suffix: str, top: float, warned: str
) -> None:
    quad = np.where(QUAD == 1050, top, QUAD)
    used = quad[:4] if suffix == "stl" else quad
    meshio.write(tmp_path / f"liver.{suffix}", meshio.Mesh(used, [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))]))
    path = write_scene(tmp_path, f'skin = "liver.{suffix}"')
    with caplog.at_level(logging.WARNING):
        simulation = Simulation.load(path)
    assert caplog.text.endswith(warned) and bool(caplog.text) == bool(warned)
    (body,) = simulation.world.bodies
    message = messages.topology(simulation, body)
    assert len(message.skin_weights) == 4 * 4 * 8 and len(message.skin_triangles) == 2 * 3 * 4
    assert body.skin is not None
    at_rest = moved(body.skin.nodes, body.skin.weights, body.mesh.rest)
    np.testing.assert_allclose(np.sort(at_rest, axis=0), np.sort(quad[:4] / 1000, axis=0), atol=1e-6)
    # No step depends on it
    without = Simulation.load(write_scene(tmp_path, ""))
    for each in (simulation, without):
        each.engine.run(5)
    assert simulation.world.x.tobytes() == without.world.x.tobytes()


@pytest.mark.parametrize(
    ("name", "points", "cells", "said"),
    [
        ("gone.obj", None, None, "object 'liver', skin.*no such file"),
        ("bad.obj", None, "v 0 0 0\nv 1 0\n", r"skin .*bad.obj, line 2: 'v 1 0': must be v X Y Z, or f and at least"),
        ("none.obj", None, "v 0 0 0\n", "none.obj: no triangles"),
        ("out.obj", None, "v 0 0 0\nf 1 2 3\n", "out.obj: numbers of points must be 0 to 0"),
        ("bad.stl", None, "nonsense", "object 'liver': skin .*bad.stl: cannot be read"),
        ("line.vtk", QUAD, ("line", [[0, 1]]), "no triangles; cells in it: line; allowed: triangles, quads, volume"),
        ("nan.vtk", QUAD * np.nan, ("triangle", [[0, 1, 2]]), "points of shape .*: must be finite"),
        ("far.vtk", FAR, ("triangle", [[0, 1, 2]]),
         r"skin .*far.vtk: a vertex at .* lies 0\.55 m or more outside the mesh \(1 such v.*\); allowed: 0\.2 m, 10%"),
    ],
)  # fmt: skip
def test_bad_files(tmp_path: Path, name: str, points: np.ndarray | None, cells: object, said: str) -> None:
    path = tmp_path / name
    if isinstance(cells, str):
        path.write_text(cells)
    elif cells is not None:
        meshio.write(path, meshio.Mesh(points, [(cells[0], np.array(cells[1]))]))  # type: ignore[index]
    scene = write_scene(tmp_path, f'skin = "{name}"')
    with pytest.raises(InputError, match=said):
        Simulation(load(scene))


def test_an_obj_file_with_polygons_textures_and_normals(tmp_path: Path) -> None:
    text = "o a\nv 0 0 0\nv 1 0 0 # c\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2//1 3/1 4\nf -4 -3 -1\n"
    (tmp_path / "a.obj").write_text(text)
    points, triangles = read_surface(tmp_path / "a.obj")
    assert points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 3]]


def test_too_many_vertices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mesh: Mesh) -> None:
    meshio.write(tmp_path / "a.vtk", meshio.Mesh(QUAD, [("quad", np.array([[0, 1, 2, 3]]))]))
    monkeypatch.setattr("sim_server.mesh.skin.MOST_VERTICES", 3)
    with pytest.raises(InputError, match=r"a\.vtk: 4 vertices; allowed: at most 3"):
        read_skin(tmp_path / "a.vtk", 0.001, mesh)
