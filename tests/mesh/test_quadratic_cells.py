# SPDX-License-Identifier: MIT
"""Strain cells, constants and masses of quadratic tetrahedra."""

import meshio
import numpy as np
import pytest

from sim_server import backends
from sim_server.mechanics.world import World
from sim_server.mesh.quadratic_cells import quadratic_cells
from sim_server.mesh.shape_functions import MASS_PARTS, quadratic_gradients, quadratic_shapes
from sim_server.scene import load
from tests.mesh.test_quadratic_mesh import jittered


def gradients_of(cells, x):
    """F of each cell, (m, 3, 3)."""
    owner = np.repeat(np.arange(len(cells.volume)), np.diff(cells.start))
    found = np.zeros((len(cells.volume), 3, 3))
    np.add.at(found, owner, x[cells.nodes][:, :, None] * cells.gradients[:, None])
    return found


@pytest.mark.parametrize("curved", [0.0, 0.08])
def test_cells_have_one_gradient_for_an_affine_motion(curved):
    mesh = jittered(curved=curved)
    cells = quadratic_cells(mesh.rest, mesh.quadratic)
    map = np.eye(3) + np.random.default_rng(7).uniform(-0.5, 0.5, (3, 3))
    assert np.allclose(gradients_of(cells, mesh.rest @ map.T + 3), map, atol=1e-11)


def test_cells_number_their_elements():
    mesh = jittered()
    cells = quadratic_cells(mesh.rest, mesh.quadratic)
    m = len(mesh.quadratic)
    assert np.array_equal(cells.start, np.arange(0, 40 * m + 1, 10)) and cells.patches == m
    assert np.array_equal(np.bincount(cells.patch), np.full(m, 4))
    assert np.array_equal(np.sort(cells.element[::4]), 8 * np.arange(m)) and (np.diff(cells.patch) >= 0).all()
    nodes = cells.nodes.reshape(-1, 10)
    assert np.array_equal(nodes, mesh.quadratic[cells.element // 8])
    assert np.isin(mesh.tets[cells.element], nodes).all() and np.isclose(cells.volume.sum(), 12)
    for name, kind in (("start", np.int32), ("nodes", np.int32), ("element", np.int32), ("patch", np.int32)):
        assert getattr(cells, name).dtype == kind and cells.gradients.dtype == cells.volume.dtype == np.float64


def test_parts_of_the_mass_are_the_scaled_diagonal_of_the_consistent_matrix():
    """Integrals of the squares of the shape functions, by a rule of Gauss and Jacobi on the collapsed cube."""
    points, weights = np.polynomial.legendre.leggauss(6)
    u, v, w = (axis.ravel() for axis in np.meshgrid(*[(points + 1) / 2] * 3, indexing="ij"))
    a, b, c = u, v * (1 - u), w * (1 - u) * (1 - v)
    weight = np.einsum("i,j,k->ijk", *[weights / 2] * 3).ravel() * (1 - u) ** 2 * (1 - v)
    values = quadratic_shapes(np.stack([1 - a - b - c, a, b, c], axis=1))[0]
    diagonal = (weight[:, None] * values**2).sum(axis=0)
    assert np.isclose(weight.sum(), 1 / 6) and np.allclose(MASS_PARTS, diagonal / diagonal.sum(), rtol=1e-12)


SCENE = """
dt = 0.01
[effects]
gravity = true
[[object]]
name = "a"
mesh = { file = "q.vtu", scale = 0.1 }
DENSITY
elements = "ELEMENTS"
[object.effects]
corotational = { young = [{ where = "X < 0.1", young = 1e5 }, { young = 1e6 }], poisson = 0.3 }
fixed = { where = "Z < 0.01" }
"""


def scene_of(folder, mesh, density="density = 500", elements="auto"):
    meshio.write(folder / "q.vtu", meshio.Mesh(mesh.rest, [("tetra10", mesh.quadratic)]))
    (folder / "scene.toml").write_text(SCENE.replace("DENSITY", density).replace("ELEMENTS", elements))
    return load(folder / "scene.toml")


def test_auto_keeps_nodes_on_edges_where_the_effect_has_such_elements(tmp_path):
    mesh = jittered()
    kept = scene_of(tmp_path, mesh).objects[0].load_mesh()
    assert np.array_equal(kept.quadratic, mesh.quadratic) and np.allclose(kept.rest, 0.1 * mesh.rest)
    corners = mesh.quadratic[:, :4]
    for elements in ("linear", "patch", "smoothed"):
        assert np.array_equal(scene_of(tmp_path, mesh, elements=elements).objects[0].load_mesh().tets, corners)
    others = ("object.a.effects.corotational.rotation=qr", "integrator.scheme=central_difference")
    for other in others:
        found = load(tmp_path / "scene.toml", ["object.a.elements=auto", other]).objects[0].load_mesh()
        assert found.quadratic is None and np.array_equal(found.tets, corners)


def world_of(folder, mesh, *given, **options):
    return World(scene_of(folder, mesh, *given, **options), backends.create("cpu", "float64"))


@pytest.mark.parametrize("curved", [0.0, 0.08])
def test_masses_are_positive_and_sum_to_the_whole(tmp_path, curved):
    mesh = jittered(curved=curved)
    world = world_of(tmp_path, mesh)
    parts = quadratic_gradients(world.bodies[0].mesh.rest, mesh.quadratic)[0]
    expected = np.zeros(world.nodes)
    np.add.at(expected, mesh.quadratic, 500 * parts.sum(axis=1)[:, None] * MASS_PARTS)
    assert np.allclose(world.mass, expected, rtol=1e-12) and (world.mass > 0).all()
    assert np.isclose(world.mass.sum(), 500 * parts.sum())
    assert np.isclose(world_of(tmp_path, mesh, "mass = 7").mass.sum(), 7)
    assert np.allclose(world_of(tmp_path, mesh, 'mass = 7\nmasses = "equal"').mass, 7 / len(mesh.rest))


def test_constants_are_those_at_the_centroid_of_the_element(tmp_path):
    mesh = jittered((2, 2, 2))
    body = world_of(tmp_path, mesh).bodies[0]
    assert body.elements == "quadratic"
    expected = 0.1 * mesh.rest[mesh.quadratic[:, :4]].mean(axis=1)
    assert np.allclose(body.centroids.reshape(-1, 8, 3), expected[:, None])


def test_quadratic_elements_of_a_bar_have_nodes_added(tmp_path):
    scene_of(tmp_path, jittered())
    bars = ["object.a.mesh={bar = [2, 1, 1], size = [2, 1, 1]}"]
    linear = load(tmp_path / "scene.toml", bars).objects[0].load_mesh()
    mesh = load(tmp_path / "scene.toml", [*bars, "object.a.elements=quadratic"]).objects[0].load_mesh()
    assert linear.quadratic is None and np.array_equal(mesh.quadratic[:, :4], linear.tets)
    assert np.array_equal(mesh.rest[: len(linear.rest)], linear.rest)
    assert len(mesh.rest) == 5 * 3 * 3 and np.array_equal(np.unique(2 * mesh.rest % 1), [0.0])
