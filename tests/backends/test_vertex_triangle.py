# SPDX-License-Identifier: MIT
"""kernels/vertex_triangle.cuh: nearest points, sides of closed surfaces, where paths meet triangles, against NumPy."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tests.reference.triangles import NEVER, distances, entries, is_inside
from tests.texts import compiled

D = 0.01  # thickness [m]
DEEP = 5

TEXT = """#include "kernel.h"
#include "vertex_triangle.cuh"
struct Probe {
    int n;
    double thickness;
    const double* p;        // (n, 3)
    const double* path;     // (n, 3)
    const double* corner;   // (n, 3, 3)
    int* found;             // (n,)
    double* nearest;        // (n, 3) weights
    double* entry;          // (n,)
    double* distance;       // (n,)
    double* certainty;      // (n,)
    double* normal;         // (n, 3)
    double* weight;         // (n, 3)
};
KERNEL(probe, Probe) {
    const double *a = p.corner + 9 * i, *b = a + 3, *c = a + 6;
    Touch t = {};
    nearest_on_triangle(p.p + 3 * i, a, b, c, p.nearest + 3 * i);
    p.found[i] = meet(p.p + 3 * i, p.path + 3 * i, a, b, c, p.thickness, t);
    p.entry[i] = t.entry;
    p.distance[i] = t.distance;
    p.certainty[i] = t.certainty;
    for (int k = 0; k < 3; ++k) {
        p.normal[3 * i + k] = t.normal[k];
        p.weight[3 * i + k] = t.weight[k];
    }
}
"""
FLAT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -1]])  # normal +y


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    with compiled(TEXT, tmp_path_factory.mktemp("texts")) as modules:
        yield modules["double"]


@dataclass
class Answer:
    found: np.ndarray
    nearest: np.ndarray
    entry: np.ndarray
    distance: np.ndarray
    certainty: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


def ask(module: Any, p: Any, corners: Any, path: Any = (0.0, 0, 0), thickness: float = D) -> Answer:
    """p, path: (n, 3) or (3,). corners: (n, 3, 3) or (3, 3)."""
    n = max(len(np.atleast_2d(p)), len(np.atleast_2d(path)), len(np.reshape(corners, (-1, 3, 3))))
    given = {"p": (p, (n, 3)), "path": (path, (n, 3)), "corner": (corners, (n, 3, 3))}
    arrays = {k: np.ascontiguousarray(np.broadcast_to(v, shape), float) for k, (v, shape) in given.items()}
    out = {k: np.zeros((n, 3)) for k in ("nearest", "normal", "weight")}
    out |= {k: np.zeros(n) for k in ("entry", "distance", "certainty")}
    found = np.zeros(n, np.int32)
    module.bind("probe", n, thickness=thickness, **arrays, found=found, **out)()
    return Answer(found == 1, **out)


def point(weight: np.ndarray, corners: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("na,nac->nc", weight, np.broadcast_to(corners, (len(weight), 3, 3))))


def triangles(kind: str, count: int, random: np.random.Generator) -> np.ndarray:
    corners = random.uniform(-1, 1, (count, 3, 3))
    if kind == "needles":
        corners[:, 2] = corners[:, 1] + random.normal(0, 1e-4, (count, 3))
    if kind == "caps":
        corners[:, 2] = 0.25 * corners[:, 0] + 0.75 * corners[:, 1] + random.normal(0, 1e-4, (count, 3))
    return corners


@pytest.mark.parametrize("kind", ["any", "needles", "caps"])
def test_nearest_points_are_those_of_the_reference(module, kind):
    random = np.random.default_rng(3)
    corners, p = triangles(kind, 4000, random), random.uniform(-1.5, 1.5, (4000, 3))
    weight = ask(module, p, corners).nearest
    assert np.isfinite(weight).all() and (weight >= -1e-12).all()
    np.testing.assert_allclose(weight.sum(axis=1), 1, atol=1e-12)
    away = np.linalg.norm(p - point(weight, corners), axis=1)
    np.testing.assert_allclose(away, distances(p, corners), atol=1e-12 if kind == "any" else 1e-7)


def test_nearest_points_of_each_of_the_seven_regions(module):
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    cases = {
        (-1, -1, 1): (1, 0, 0), (4, -1, 1): (0, 1, 0), (-1, 5, 1): (0, 0, 1), (1, -2, 1): (0.5, 0.5, 0),
        (2, 2, 1): (0, 0.5, 0.5), (-3, 0.5, 1): (0.75, 0, 0.25), (0.5, 0.5, 1): (0.5, 0.25, 0.25),
        (0, 0, 0): (1, 0, 0), (1, 0, 0): (0.5, 0.5, 0),
    }  # fmt: skip
    weight = ask(module, list(cases), corners).nearest
    np.testing.assert_allclose(weight, list(cases.values()), atol=1e-14)


@pytest.mark.parametrize("kind", ["edge", "corner on an edge", "point"])
def test_a_triangle_without_area_is_never_met(module, kind):
    """Rounding leaves it an area, and its nearest point may then be anywhere on its line."""
    random = np.random.default_rng(0)
    corners = random.uniform(-1, 1, (500, 3, 3))
    part = {"edge": 1.0, "corner on an edge": random.uniform(-1, 2, (500, 1)), "point": 0.0}[kind]
    if kind == "point":
        corners[:, 1] = corners[:, 0]
    corners[:, 2] = corners[:, 0] + part * (corners[:, 1] - corners[:, 0])
    for p in (corners[:, 0], corners[:, 2], corners.mean(axis=1)):
        assert not ask(
            module, p + random.normal(0, D / 2, (500, 3)), corners, random.normal(0, 1, (500, 3))
        ).found.any()


# --- sides of closed surfaces -------------------------------------------------------------------------------------


def box_surface(cells: int, half: np.ndarray) -> np.ndarray:
    """Triangles (t, 3, 3), outward, of a box around the origin; diagonals change direction from cell to cell."""
    found = []
    step = np.linspace(-1, 1, cells + 1)
    for axis in range(3):
        for sign in (-1, 1):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            for i in range(cells):
                for j in range(cells):
                    q = np.full((4, 3), float(sign))
                    q[:, u], q[:, v] = step[[i, i + 1, i + 1, i]], step[[j, j, j + 1, j + 1]]
                    q = (q if sign > 0 else q[::-1]) * half
                    q = np.roll(q, (i + j) % 2, axis=0)
                    found += [q[[0, 1, 2]], q[[0, 2, 3]]]
    return np.array(found)


def bumpy_surface(random: np.random.Generator) -> np.ndarray:
    """A box whose corners are moved onto a ball with dents and spikes, so that it has valleys and sharp tips."""
    surface = box_surface(4, np.ones(3))
    nodes, index = np.unique(surface.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    radius = random.uniform(0.4, 1.0, (len(nodes), 1))
    return np.asarray((radius * nodes / np.linalg.norm(nodes, axis=1, keepdims=True))[index.ravel()].reshape(-1, 3, 3))


def signed_distance(module: Any, p: np.ndarray, surface: np.ndarray) -> float:
    """Of the nearest triangle; of those as near the one with the largest certainty."""
    t = ask(module, p, surface, thickness=1.0)  # everything here is nearer than DEEP times it
    near = abs(t.distance) <= abs(t.distance).min() + 1e-12
    return float(t.distance[near][t.certainty[near].argmax()])


def test_the_most_certain_of_the_nearest_triangles_tells_inside_from_outside_of_a_box(module):
    half, random = np.array([0.5, 0.3, 0.2]), np.random.default_rng(5)
    surface = box_surface(3, half)
    anywhere = random.uniform(-0.8, 0.8, (300, 3))
    at_edges = np.sign(random.normal(size=(300, 3))) * half * (1 + random.normal(0, 0.02, (300, 3)))
    at_edges[::2, 0] = random.uniform(-half[0], half[0], 150)
    for p in np.concatenate([anywhere, at_edges]):
        q = abs(p) - half
        expected = np.linalg.norm(np.maximum(q, 0)) + min(q.max(), 0)
        assert signed_distance(module, p, surface) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_it_does_so_of_a_surface_with_valleys_and_spikes(module, seed):
    random = np.random.default_rng(seed)
    surface = bumpy_surface(random)
    tips = surface.reshape(-1, 3)[::2]
    for p in np.concatenate([random.uniform(-1, 1, (200, 3)), tips + random.normal(0, 0.05, tips.shape)]):
        assert (signed_distance(module, p, surface) < 0) == is_inside(p, surface)


# --- where paths meet a triangle ----------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [0.02, 0.5, 30.0, 1e5])
def test_a_vertex_that_falls_on_a_face_is_met_when_and_where_it_comes_near(module, speed):
    random = np.random.default_rng(int(speed))
    weight = random.dirichlet([2, 2, 2], 200)
    height = D + random.uniform(0.01, 0.99, 200) * speed
    aside = random.uniform(-0.02, 0.02, (200, 2))
    path = np.stack([aside[:, 0], -speed * np.ones(200), aside[:, 1]], axis=1)
    when = (height - D) / speed
    start = point(weight, FLAT) + np.array([0, D, 0]) - when[:, None] * path
    t = ask(module, start, FLAT, path)
    assert t.found.all()
    np.testing.assert_allclose(t.entry, when, atol=1e-5 * D / speed + 1e-14)
    np.testing.assert_allclose(t.weight, weight, atol=1e-5)
    np.testing.assert_allclose(t.normal, np.broadcast_to([0, 1, 0], (200, 3)), atol=1e-5)


def test_one_that_leaves_is_not_met_but_has_the_plane_while_it_is_near(module):
    heights = np.array([0.5, 1.0, 1.9, 4.0, 5.1]) * D
    t = ask(module, np.stack([0 * heights + 0.2, heights, 0 * heights - 0.2], axis=1), FLAT, (0.0, 1, 0))
    assert (t.entry == NEVER).all()
    assert t.found.tolist() == [True, True, True, True, False]
    np.testing.assert_allclose(t.distance[:4], heights[:4])
    np.testing.assert_allclose(t.normal[:4], np.broadcast_to([0, 1, 0], (4, 3)), atol=1e-12)


def test_one_that_stops_short_or_comes_from_behind_is_not_met(module):
    short = ask(module, (0.2, 1.0, -0.2), FLAT, (0.0, -(1 - 1.01 * D), 0))
    behind = ask(module, (0.2, -1.0, -0.2), FLAT, (0.0, 3, 0))
    assert not short.found.any() and not behind.found.any()


def test_one_that_is_near_and_approaches_is_met_at_once_and_inside_too_as_far_as_is_deep(module):
    heights = np.array([1.0, 0.3, 1e-6, -1e-6, -1.0, -4.9, -5.1]) * D
    p = np.stack([0 * heights + 0.2, heights, 0 * heights - 0.2], axis=1)
    t = ask(module, p, FLAT, (0.3, -0.1, 0.0))
    assert t.found.tolist() == [True] * 6 + [False]
    assert (t.entry[:6] == 0).all()
    np.testing.assert_allclose(t.distance[:6], heights[:6], atol=1e-15)
    np.testing.assert_allclose(t.normal[:6], np.broadcast_to([0, 1, 0], (6, 3)), atol=1e-12)
    leaving = ask(module, p, FLAT, (0.3, 0.1, 0.0))
    assert (leaving.entry[:6] == NEVER).all() and leaving.found[:6].all()


@pytest.mark.parametrize("aim", ["anywhere", "edges", "low"])
def test_paths_from_the_front_are_met_when_they_first_come_near_and_not_if_they_pass_by(module, aim):
    """Also those that graze the triangle at its edges and corners, or fly along it lower than the thickness."""
    random = np.random.default_rng(11)
    count = 500
    weight = random.dirichlet([1, 1, 1], count)
    if aim != "anywhere":
        weight[np.arange(count), random.integers(0, 3, count)] = 0
        weight /= weight.sum(axis=1, keepdims=True)
    way = random.normal(size=(count, 3))
    way[:, 1] = abs(way[:, 1]) * (0.01 if aim == "low" else 1)
    way *= 0.4 / np.linalg.norm(way, axis=1, keepdims=True)
    target = point(weight, FLAT) + random.normal(0, 2 * D if aim != "anywhere" else 10 * D, (count, 3)) * [1, 0.2, 1]
    start = target + way
    flat = np.broadcast_to(FLAT, (count, 3, 3))
    path = -1.5 * way
    expected, closest = entries(start, path, flat, D)
    t = ask(module, start, FLAT, path)
    far = (distances(start, flat) > DEEP * D) & (start[:, 1] >= 0)
    clear = far & (abs(closest - D) > 1e-2 * D)  # the others touch, or just do not
    met, passed = clear & (expected <= 1), clear & (expected > 1)
    assert np.count_nonzero(met) > 30 and (np.count_nonzero(passed) > 20 or aim == "low")
    assert t.found[met].all() and not t.found[passed].any()
    np.testing.assert_allclose(t.entry[met], expected[met], atol=1e-6)
    off = (start + expected[:, None] * path - point(t.weight, FLAT))[met]
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), D, rtol=1e-4)
    np.testing.assert_allclose(t.normal[met], off / D, atol=1e-3)
