# SPDX-License-Identifier: MIT
"""Bars against the loops that define them, surfaces, poses."""

import itertools
from collections import Counter

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import bar, check, pose_matrix, posed
from sim_server.mesh.surface import surface_triangles, volumes


def bar_by_loops(cells, size):
    """The definition: nodes x fastest, Kuhn paths in the order of itertools, last two nodes swapped if inverted."""
    nx, ny, nz = cells
    counts = itertools.product(range(nz + 1), range(ny + 1), range(nx + 1))
    nodes = np.array([(i * size[0] / nx, j * size[1] / ny, k * size[2] / nz) for k, j, i in counts])
    tets = []
    for k, j, i in itertools.product(range(nz), range(ny), range(nx)):
        for order in itertools.permutations(range(3)):
            at, path = [i, j, k], []
            for axis in (None, *order):
                if axis is not None:
                    at[axis] += 1
                path.append((at[2] * (ny + 1) + at[1]) * (nx + 1) + at[0])
            a, b, c, d = nodes[path]
            if np.dot(np.cross(b - a, c - a), d - a) < 0:
                path[2], path[3] = path[3], path[2]
            tets.append(path)
    return nodes, np.array(tets)


@pytest.mark.parametrize(
    ("cells", "size", "tets", "nodes"),
    [
        ([3, 3, 10], [1, 1, 4], 540, 176),
        ([5, 5, 20], [1, 1, 4], 3000, 756),
        ([7, 7, 25], [1, 1, 4], 7350, 1664),
        ([10, 10, 40], [1, 1, 4], 24000, 4961),
        ([20, 5, 5], [10, 2, 2], 3000, 756),
        ([1, 2, 3], [0.3, 0.2, 0.7], 36, 24),
    ],
)
def test_bar_counts_volume_and_winding(cells, size, tets, nodes):
    mesh = bar(cells, size)
    assert mesh.tets.shape == (tets, 4) and mesh.tets.dtype == np.int32
    assert mesh.rest.shape == (nodes, 3) and mesh.rest.dtype == np.float64
    assert np.allclose(volumes(mesh.rest, mesh.tets), np.prod(size) / tets, rtol=1e-9)
    assert mesh.rest.min(axis=0).tolist() == [0, 0, 0] and mesh.rest.max(axis=0) == pytest.approx(size)
    assert check(mesh) is mesh


@pytest.mark.parametrize(("cells", "size"), [([3, 3, 10], [1, 1, 4]), ([4, 2, 3], [1.5, 0.7, 2.0])])
def test_bar_is_the_one_of_the_loops(cells, size):
    nodes, tets = bar_by_loops(cells, size)
    mesh = bar(cells, size, "kuhn")
    assert np.array_equal(mesh.rest, nodes)
    assert np.array_equal(mesh.tets, tets)


@pytest.mark.parametrize(
    ("cells", "size", "words"),
    [
        ([0, 1, 1], [1, 1, 1], "bar = [0, 1, 1]"),
        ([1, 1], [1, 1, 1], "three counts"),
        ([1000, 1000, 1000], [1, 1, 1], "at most 10000000 tets"),
        ([1, 1, 1], [1, -1, 1], "size = [1, -1, 1]: must be three lengths > 0"),
        ([1, 1, 1], [1, float("inf"), 1], "three lengths"),
    ],
)
def test_bad_bars(cells, size, words):
    with pytest.raises(InputError) as error:
        bar(cells, size)
    assert words in str(error.value)


def test_surface_is_closed_outward_and_complete():
    mesh = bar([4, 3, 2], [2.0, 1.5, 1.0])
    triangles = surface_triangles(mesh.tets)
    assert triangles.dtype == np.int32
    assert len(triangles) == 2 * 2 * (4 * 3 + 3 * 2 + 4 * 2)
    edges = Counter((a, b) for t in triangles.tolist() for a, b in itertools.pairwise([*t, t[0]]))
    assert set(edges.values()) == {1}  # each directed edge once
    assert all((b, a) in edges for a, b in edges)  # and its reverse: every edge in two triangles
    a, b, c = (mesh.rest[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    outward = (a + b + c) / 3 - mesh.rest.mean(axis=0)
    assert (np.einsum("ij,ij->i", normals, outward) > 0).all()
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(2.0 * 1.5 * 1.0)  # divergence theorem
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(2 * (2 * 1.5 + 1.5 * 1 + 2 * 1))


def test_surface_of_one_tet():
    triangles = surface_triangles(np.array([[0, 1, 2, 3]]))
    assert triangles.tolist() == [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


@pytest.mark.parametrize(
    ("rotate", "matrix"),
    [
        ([0, 0, 0], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ([90, 0, 0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
        ([0, 90, 0], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
        ([0, 0, 90], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ([90, 90, 0], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]),  # y to z, and then z to x: y ends as x
        ([90, 0, 90], [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),  # x to y, y to z, z to x
        (
            [40, 0, 70],  # columns: images of the axes; Rz(70) Rx(40) with cos and sin of 40 and 70 degrees
            [
                [0.3420201433, -0.7198463104, 0.6040227736],
                [0.9396926208, 0.2620026302, -0.2198463104],
                [0.0, 0.6427876097, 0.7660444431],
            ],
        ),
    ],
)
def test_pose_turns_about_the_fixed_axes_x_then_y_then_z(rotate, matrix):
    assert np.allclose(pose_matrix(rotate), matrix, atol=1e-10)


def test_pose_moves_after_turning_and_is_rigid():
    moved = posed(np.array([[1.0, 0, 0], [0, 2, 0]]), [0, 0, 90], [10, 20, 30])
    assert np.allclose(moved, [[10, 21, 30], [8, 20, 30]])
    turn = pose_matrix([11, -200, 345])
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-15) and np.linalg.det(turn) == pytest.approx(1)


def test_the_mirrored_split_is_the_default_conforms_and_fills_the_box():
    mesh = bar((3, 4, 5), (1, 2, 3))
    volume = volumes(mesh.rest, mesh.tets)
    assert len(mesh.tets) == 6 * 60 and volume.min() > 0
    assert np.isclose(volume.sum(), 6)
    assert len(surface_triangles(mesh.tets)) == 4 * (3 * 4 + 4 * 5 + 3 * 5)  # no face inside is left open
    kuhn = bar((3, 4, 5), (1, 2, 3), "kuhn")
    assert np.array_equal(mesh.rest, kuhn.rest)
    assert not np.array_equal(mesh.tets, kuhn.tets)
