# SPDX-License-Identifier: MIT
"""Tetrahedra in shapes: their angles, their volume, and that they fit together."""

from itertools import combinations, pairwise

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import Mesh, check
from sim_server.mesh.stuffing import stuffed
from sim_server.mesh.surface import FACES, surface_triangles, volumes
from sim_server.scene.shapes import Shape

ONE = np.ones(3)
LEAST, MOST = 10.7, 164.8  # degrees, Labelle and Shewchuk 2007


def angles(x, tets) -> np.ndarray:
    """Dihedral angles, (m, 6) [degrees]."""
    normals = [np.cross(x[tets[:, b]] - x[tets[:, a]], x[tets[:, c]] - x[tets[:, a]]) for a, b, c in FACES]
    units = [n / np.linalg.norm(n, axis=1, keepdims=True) for n in normals]
    between = [np.arccos((a * b).sum(axis=1).clip(-1, 1)) for a, b in combinations(units, 2)]
    return 180 - np.degrees(np.stack(between, axis=1))


def of(shape: dict, edge: float) -> Mesh:
    """The mesh of a shape."""
    made = Shape.model_validate(shape)
    return Mesh(*stuffed(made.distances, *made.bounds(), edge))


@pytest.mark.parametrize("seed", range(4))
def test_angles_are_bounded_however_the_surface_runs(seed):
    """Of sums of waves as short as an edge, cut by a sphere or a cube: holes, thin parts, points."""
    rng = np.random.default_rng(seed)
    k, phase, height = rng.normal(size=(40, 3)) * rng.uniform(2, 15), rng.uniform(0, 6.3, 40), rng.normal(size=40)

    def distances(p):
        order = 2 if seed % 2 else np.inf
        return np.maximum(np.cos(p @ k.T + phase) @ height / 6, np.linalg.norm(p, order, axis=1) - 1)

    x, tets = stuffed(distances, -ONE, ONE, 0.25)
    assert len(tets) > 500 and volumes(x, tets).min() > 0
    found = angles(x, tets)
    assert found.min() > LEAST and found.max() < MOST


def test_volume_converges_to_that_of_a_sphere():
    """At second order in the edge; the surface is closed and its nodes are on the sphere."""
    off = []
    for edge in (0.5, 0.25, 0.125):
        mesh = check(of({"sphere": {"radius": 1.0, "center": [3.0, 1.0, 2.0]}}, edge))
        off.append(1 - mesh.volumes.sum() / (4 / 3 * np.pi))
        triangles = surface_triangles(mesh.tets)
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
        radius = np.linalg.norm(mesh.rest[np.unique(triangles)] - [3, 1, 2], axis=1)
        np.testing.assert_allclose(radius, 1, atol=1e-6)
    assert 0 < off[2] < 0.005
    assert all(3.5 < coarse / fine < 4.5 for coarse, fine in pairwise(off))


def test_a_box_along_the_lattice_is_exact():
    mesh = check(of({"box": {"size": [2.0, 1.0, 0.5]}}, 0.25))
    assert np.isclose(mesh.volumes.sum(), 1, rtol=1e-6) and np.allclose(np.ptp(mesh.rest, axis=0), [2, 1, 0.5])


def test_distances_of_shapes():
    points = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 4], [2, 2, 1]])
    sphere, box = {"sphere": {"radius": 1.0}}, {"box": {"size": [2.0, 4.0, 6.0]}}
    capsule = {"capsule": {"begin": [-1.0, 0, 0], "end": [1.0, 0, 0], "radius": 0.5}}

    def distances(shape):
        return Shape.model_validate(shape).distances(points)

    np.testing.assert_allclose(distances(sphere), [-1, 1, 4, 2])
    np.testing.assert_allclose(distances(box), [-1, 1, 2**0.5, 1])
    rounded = distances({"box": {"size": [2.0, 4.0, 6.0], "round": 0.5}})
    np.testing.assert_allclose(rounded, [-1, 1, 4.5**0.5 - 0.5, 2.5**0.5 - 0.5])
    np.testing.assert_allclose(distances(capsule), [-0.5, 0.5, 4.5, 6**0.5 - 0.5])
    both = [sphere, capsule]
    np.testing.assert_allclose(distances({"union": both}), [-1, 0.5, 4, 6**0.5 - 0.5])
    # equal parts: a - smooth / 4; parts farther apart than that: as without
    np.testing.assert_allclose(distances({"union": [sphere, sphere], "smooth": 0.4}), [-1.1, 0.9, 3.9, 1.9])
    np.testing.assert_allclose(distances({"union": both, "smooth": 0.04}), distances({"union": both}))


def test_a_smooth_union_is_one_part_with_no_crease():
    dumbbell = {
        "union": [{"sphere": {"radius": 0.5}}, {"sphere": {"radius": 0.5, "center": [0.9, 0.0, 0.0]}}],
        "smooth": 0.3,
    }
    blended, plain = check(of(dumbbell, 0.2)), check(of({**dumbbell, "smooth": 0.0}, 0.2))
    assert blended.volumes.sum() > 1.02 * plain.volumes.sum()
    assert angles(blended.rest, blended.tets).min() > LEAST


@pytest.mark.parametrize(("edge", "word"), [(9.0, "too coarse"), (1e-4, "too fine")])
def test_edges_that_do_not_fit_are_refused(edge, word):
    with pytest.raises(InputError, match=word):
        of({"sphere": {"radius": 0.1, "center": [0.33, 0.0, 0.0]}}, edge)
