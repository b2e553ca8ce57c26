# SPDX-License-Identifier: MIT
"""Distances from closed surfaces of files, their grids, and what of a file is refused."""

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from sim_server.errors import InputError
from sim_server.mechanics.signed_distance import closed_surface, grid_around, signed_distance_grid, signed_distances
from sim_server.mesh import bar as bar_mesh
from sim_server.mesh.surface import surface_triangles
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.reference import shapes
from tests.scenes import bar, random_rotations

SIZE = np.array([0.6, 0.3, 0.2])


def box(cells: tuple[int, int, int] = (4, 3, 2)) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a box about the origin."""
    mesh = bar_mesh(cells, SIZE, "kuhn")
    return mesh.rest - SIZE / 2, surface_triangles(mesh.tets).astype(np.int64)


def ball(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the unit sphere, and the outward triangles of their hull."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    triangles = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = np.swapaxes(points[triangles], 0, 1)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - points.mean(axis=0)) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return points, triangles


def notched() -> tuple[np.ndarray, np.ndarray]:
    """A cube of 2 x 2 x 2 cells without one of them: an edge and a corner that lead inward."""
    mesh = bar_mesh((2, 2, 2), (2, 2, 2), "kuhn")
    tets = mesh.tets[~(mesh.rest[mesh.tets].mean(axis=1) > 1).all(axis=1)]
    return mesh.rest, surface_triangles(tets).astype(np.int64)


def by_sampling(points: np.ndarray, corners: np.ndarray, count: int = 60) -> np.ndarray:
    """Distances of points from the nearest of many points on each triangle: never too small."""
    u, v = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    keep = u + v <= 1 + 1e-12
    weights = np.stack([1 - u[keep] - v[keep], u[keep], v[keep]], axis=1)
    samples = np.einsum("sc,tck->tsk", weights, corners).reshape(-1, 3)
    return np.array([np.linalg.norm(samples - p, axis=1).min() for p in points])


def test_distances_from_a_box_are_exact():
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (4000, 3))
    found = signed_distances(closed_surface(*box()), points)
    np.testing.assert_allclose(found, shapes.box(points, SIZE / 2), atol=1e-15)


def test_distances_from_a_hull_are_those_of_samples_and_of_its_planes():
    hull, triangles = ball(60)
    surface, points = closed_surface(hull, triangles), np.random.default_rng(2).uniform(-1.5, 1.5, (300, 3))
    found = signed_distances(surface, points)
    sampled = by_sampling(points, surface.corners)
    assert (np.abs(found) <= sampled + 1e-12).all() and (sampled - np.abs(found)).max() < 0.02
    planes = ConvexHull(hull).equations
    inside = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    assert np.array_equal(found < 0, inside < 0)
    np.testing.assert_allclose(found[inside < 0], inside[inside < 0], atol=1e-14)


def test_the_side_is_right_also_at_edges_and_corners_that_lead_inward():
    points, triangles = notched()
    probes = np.random.default_rng(3).uniform(-0.5, 2.5, (5000, 3))
    found = signed_distances(closed_surface(points, triangles), probes)
    solid = ((probes > 0) & (probes < 2)).all(axis=1) & ~(probes > 1).all(axis=1)
    assert np.array_equal(found < 0, solid)


@given(
    seed=st.integers(0, 1000), count=st.integers(4, 60), scale=st.floats(1e-3, 1e3),
    shift=st.tuples(*[st.floats(-10, 10)] * 3),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_distances_move_turn_and_grow_with_the_surface(seed, count, scale, shift):
    hull, triangles = ball(count, seed)
    probes, (turn,) = np.random.default_rng(seed).uniform(-2, 2, (50, 3)), random_rotations(1, seed)
    found = signed_distances(closed_surface(hull, triangles), probes)
    moved = closed_surface(scale * (hull @ turn.T + shift), triangles)
    again = signed_distances(moved, scale * (probes @ turn.T + shift))
    np.testing.assert_allclose(again / scale, found, atol=1e-12)
    steps = np.abs(found[:, None] - found) - np.linalg.norm(probes[:, None] - probes, axis=2)
    assert steps.max() < 1e-12  # no steeper than 1


def test_coincident_points_are_one_and_a_surface_wound_inward_is_turned_over():
    points, triangles = box()
    soup = points[triangles].reshape(-1, 3)
    loose = closed_surface(soup, np.arange(len(soup)).reshape(-1, 3))
    inward = closed_surface(points, triangles[:, ::-1])
    probes = np.random.default_rng(4).uniform(-0.6, 0.6, (500, 3))
    expected = signed_distances(closed_surface(points, triangles), probes)
    for surface in (loose, inward):
        np.testing.assert_allclose(signed_distances(surface, probes), expected, atol=1e-15)


def test_a_grid_holds_the_surface_with_its_margin():
    surface = closed_surface(*box())
    grid = grid_around(surface, 0.04, 0.05)
    last = grid.first + grid.spacing * (np.array(grid.values.shape) - 1)
    assert (grid.first <= -SIZE / 2 - 0.13).all() and (last >= SIZE / 2 + 0.13).all()
    i, j, k = 3, 4, 5
    node = grid.first + grid.spacing * np.array([i, j, k])
    assert grid.values[i, j, k] == pytest.approx(shapes.box(node[None], SIZE / 2)[0], abs=1e-15)
    assert grid.values.min() < 0 and grid.radius == pytest.approx(np.linalg.norm(SIZE) / 2)


def with_a_flat_triangle(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One corner of the first triangle goes to the middle of the other two."""
    moved = points.copy()
    moved[triangles[0, 0]] = points[triangles[0, 1:]].mean(axis=0)
    return moved, triangles


REFUSED = {
    "open": (lambda p, t: (p, t[1:]), r"open: an edge belongs to one triangle only, as that from \(.*\) to .*\(3 such"),
    "not a manifold": (lambda p, t: (p, np.concatenate([t, t[:1]])), "not a manifold: an edge belongs to more than"),
    "wound both ways": (lambda p, t: (p, np.concatenate([t[:1, ::-1], t[1:]])), "wound both ways: .*triangle"),
    "flat": (with_a_flat_triangle, "is flat"),
    "one point": (lambda p, t: (0 * p, t), "all points are one"),
}


@pytest.mark.parametrize(("change", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_a_surface_that_is_not_closed_is_refused_with_the_place(change, said, tmp_path):
    points, triangles = change(*box((1, 1, 1)))
    path = tmp_path / "surface.ply"
    meshio.Mesh(points, [("triangle", triangles)]).write(path)
    with pytest.raises(InputError, match=rf"surface .*surface\.ply: .*{said}"):
        signed_distance_grid(path, 1.0, 0.05, 0.0)


def test_files_without_faces_and_grids_too_fine_are_refused(tmp_path):
    path = tmp_path / "lines.vtk"
    meshio.Mesh(np.eye(3), [("line", [[0, 1]])]).write(path)
    with pytest.raises(InputError, match="no triangles; cells in it: line; allowed: triangles, quads, volume cells"):
        signed_distance_grid(path, 1.0, 0.05, 0.0)
    with pytest.raises(
        InputError, match=r"spacing = 0.0001 m gives a grid of .* nodes: at most 4000000, a spacing above"
    ):
        grid_around(closed_surface(*box()), 1e-4, 0.0)


def of_grid(path, **grid) -> Simulation:
    table = {
        "name": "test",
        "dt": 0.01,
        "effects": {"contact": {"thickness": 0.01}},
        "object": [bar((4, 4, 4), (1, 1, 1))],
    }
    shape = {"name": "shape", "pose": {"rotate": [20, 30, 40], "translate": [0.5, 0.4, 0.5]}, **grid}
    return Simulation(Scene.model_validate({**table, "obstacle": [shape]}, context={"folder": path}))


@pytest.mark.parametrize("volume", [False, True])
def test_a_grid_of_a_box_finds_what_the_box_finds(tmp_path, volume):
    mesh = bar_mesh((4, 3, 2), SIZE, "kuhn")
    points, triangles = box()
    cells = [("tetra", mesh.tets)] if volume else [("triangle", triangles)]
    meshio.Mesh(1000 * points, cells).write(tmp_path / "box.vtk")
    given = {"shape": "grid", "file": "box.vtk", "scale": 0.001, "spacing": 0.01}
    found = []
    for sim in (of_grid(tmp_path, **given), of_grid(tmp_path, shape="box", size=SIZE.tolist())):
        random = np.random.default_rng(6)
        sim.world.x[:] = random.uniform([0.1, 0, 0.1], [0.9, 0.8, 0.9], sim.world.x.shape)
        sim.world.v[:] = random.normal(0, 20, sim.world.v.shape)
        sim.engine.assemble()
        found.append(sim.effects["contact"].contact_input())
    grid, exact = found
    there, same = exact.obstacle >= 0, exact.obstacle == grid.obstacle
    assert np.count_nonzero(there) > 10 and same.mean() > 0.97
    nodes = np.arange(len(there)) < exact.body_start[-1]
    alike = there & same & nodes & (np.einsum("ij,ij->i", grid.normal, exact.normal) > 0.99)  # but near edges
    assert np.count_nonzero(alike) > 0.8 * np.count_nonzero(there & nodes)
    np.testing.assert_allclose(grid.gap[alike], exact.gap[alike], atol=0.02)
    np.testing.assert_allclose(grid.entry[alike], exact.entry[alike], atol=0.02)
    # triangles between such nodes lie through the box, deepest in its middle, where its normal is not unique
    triangles = there & same & ~nodes
    assert np.count_nonzero(triangles) > 0.97 * np.count_nonzero(there & ~nodes) > 50
    assert np.quantile(np.abs(grid.gap - exact.gap)[triangles], 0.9) < 0.01  # the spacing


def test_a_file_that_cannot_be_used_is_named_with_its_obstacle(tmp_path):
    points, triangles = box()
    meshio.Mesh(points, [("triangle", triangles[1:])]).write(tmp_path / "open.stl")
    with pytest.raises(InputError, match=r"obstacle 'shape': surface .*open\.stl: the surface is open"):
        of_grid(tmp_path, shape="grid", file="open.stl", spacing=0.05)
