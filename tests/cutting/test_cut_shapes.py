# SPDX-License-Identifier: MIT
"""Which elements cuts take, against searches by samples and known stretches."""

import numpy as np
import pytest

from sim_server.mechanics.cut_shapes import in_sphere, met_by_blade, torn
from sim_server.mechanics.numbers import numbers_of, text_of
from sim_server.mesh import bar
from sim_server.mesh.faces import Faces
from sim_server.mesh.shape_functions import shape_gradients
from sim_server.mesh.surface import surface_triangles

MESH = bar((4, 3, 3), (1.0, 0.8, 0.7))


def barycentric(points, corners):
    """Barycentric coordinates (4, points) of points in a tetrahedron (4, 3)."""
    return np.linalg.solve(np.vstack([corners.T, np.ones(4)]), np.vstack([points.T, np.ones(len(points))]))


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.parametrize("seed", range(6))
def test_a_blade_takes_what_its_surface_meets(seed, corners):
    random = np.random.default_rng(seed)
    x = MESH.rest + random.uniform(-0.03, 0.03, MESH.rest.shape)
    a, b, c = (
        random.uniform(-0.1, 0.9, (3, 3)) if seed else np.array([[0.4, 0.3, 0.2], [0.41, 0.3, 0.2], [0.4, 0.31, 0.2]])
    )
    quadrangle = np.array([a, b, b + c - a, c])[: corners if corners == 4 else 3]
    found = met_by_blade(x, MESH.tets, quadrangle)
    u, v = (each.ravel() for each in np.meshgrid(*[np.linspace(0, 1, 90)] * 2))
    if corners == 3:
        inside = u + v <= 1
        weights = np.stack([1 - u - v, u, v], axis=1)[inside]
    else:
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
    points = weights @ quadrangle
    met = [k for k, t in enumerate(MESH.tets) if (barycentric(points, x[t]) >= 0).all(axis=0).any()]
    assert set(met) <= set(found.tolist()), "nothing that a sample is in is missed"
    near = [k for k, t in enumerate(MESH.tets) if (barycentric(points, x[t]) >= -0.1).all(axis=0).any()]
    assert set(found.tolist()) <= set(near)
    assert len(found) or seed == 5


def test_a_blade_in_the_plane_of_faces_takes_what_it_touches():
    """Those on both sides, as an element that only touches the surface counts."""
    blade = np.array([[0.5, -1, -1], [0.5, 3, -1], [0.5, -1, 3]])
    found = met_by_blade(MESH.rest, MESH.tets, blade)
    x = MESH.rest[MESH.tets][:, :, 0]
    assert np.array_equal(found, np.flatnonzero((x.min(axis=1) <= 0.5) & (x.max(axis=1) >= 0.5)))


def test_a_sphere_takes_elements_by_their_centroids():
    found = in_sphere(MESH.rest, MESH.tets, np.array([0.5, 0.4, 0.35]), 0.3)
    away = np.linalg.norm(MESH.centroids - [0.5, 0.4, 0.35], axis=1)
    assert np.array_equal(found, np.flatnonzero(away <= 0.3)) and 0 < len(found) < len(MESH.tets)


def test_what_is_stretched_too_far_is_torn_whichever_way_it_turns():
    _, gradients = shape_gradients(MESH.rest, MESH.tets)
    turned, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))
    x = MESH.rest * [1.5, 0.8, 0.8] @ turned.T
    everywhere = np.ones(len(MESH.tets), bool)
    assert not len(torn(x, MESH.tets, gradients, everywhere, 1.51))
    found = torn(x, MESH.tets, gradients, everywhere, 1.49)
    nodes = MESH.tets[found]
    assert len(found) and len(np.unique(nodes)) == nodes.size, "no two that share a node"
    touched = np.isin(MESH.tets, nodes).any(axis=1)
    assert touched.all(), "every other one has a neighbour among them"
    without = everywhere.copy()
    without[found] = False
    assert not set(torn(x, MESH.tets, gradients, without, 1.49)) & set(found)


def test_positions_that_are_no_numbers_tear_nothing():
    _, gradients = shape_gradients(MESH.rest, MESH.tets)
    x = MESH.rest.copy()
    x[5], x[9] = np.nan, 1e300
    torn(x, MESH.tets, gradients, np.ones(len(MESH.tets), bool), 1.5)


def test_texts_of_numbers_are_read_back():
    for numbers in ([], [0], [3, 4, 5], [9, 1, 2, 3, 20, 1], list(range(0, 40, 2))):
        assert numbers_of(text_of(numbers), 50).tolist() == sorted(set(numbers))
    assert text_of([3, 7, 8, 9, 12]) == "3 7-9 12"
    with pytest.raises(ValueError, match="no element 9999999"):
        numbers_of("0-9999999 " * 5000 + "50", 50)


@pytest.mark.parametrize("share", [1.0, 0.7, 0.3, 0.0])
def test_surfaces_are_those_of_the_mesh_that_is_left(share):
    there = np.random.default_rng(0).random(len(MESH.tets)) < share
    ours = Faces.of(MESH.tets).surface(there)
    expected = surface_triangles(MESH.tets[there]) if there.any() else np.zeros((0, 3), int)

    def known(triangles):
        return sorted(tuple(np.roll(t, -t.argmin()).tolist()) for t in triangles)

    assert known(ours) == known(expected)
