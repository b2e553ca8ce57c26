# SPDX-License-Identifier: MIT
"""kernels/triangle_shape.cuh, edge_edge.cuh: triangles and shapes, segments, and when they meet, against samples."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from sim_server.mesh.surface import edge_owners
from tests.texts import compiled

D = 0.01  # thickness [m]
NEVER = 2.0
KINDS = {"plane": 0, "sphere": 1, "box": 2, "capsule": 3, "grid": 4}
SIZES = {"plane": [0, 0, 0, 0], "sphere": [0.3, 0, 0, 0], "box": [0.3, 0.2, 0.1, 0], "capsule": [0.1, 0.3, 0, 0]}

TEXT = """#include "kernel.h"
#include "triangle_shape.cuh"
struct Probe {
    int n;
    const int* kind;
    const double* size;
    const double* grid;
    const int* place;
    const int* cells;
    const double* pose;     // (1, 7)
    double inflate;
    double slack;
    double bound;
    const double* begin;    // (n, 9)
    const double* end;      // (n, 9)
    double* least;          // (n,)
    double* weight;         // (n, 3)
    double* entry;          // (n,)
    int* clear;             // (n,)
    double* face;           // (n, 6) of face_touch: obstacle, entry, distance, weights
    double* part;           // (n, 2) of two segments, the first corners of begin and of end
    double* apart;          // (n,)
};
KERNEL(probe, Probe) {
    const ObstacleTable t = {p.kind, p.size, p.grid, p.place, p.cells, p.pose, p.pose};
    const double *begin = p.begin + 9 * i, *end = p.end + 9 * i;
    LeastPoint least = least_on_triangle(t, 0, begin, p.bound), then;
    p.least[i] = least.distance;
    for (int k = 0; k < 3; ++k) p.weight[3 * i + k] = least.weight[k];
    p.entry[i] = entry_of_triangle(t, 0, begin, end, p.inflate, p.slack, then);
    NodeWay ways[3];
    const NodeWay* of[3] = {ways, ways + 1, ways + 2};
    for (int a = 0; a < 3; ++a) ways[a] = way_of(t, 0, begin + 3 * a, end + 3 * a);
    p.clear[i] = stays_clear(t, 0, of, p.inflate);
    const FaceTouch touch = face_touch(t, 0, of, p.inflate);
    double* out = p.face + 6 * i;
    out[0] = touch.obstacle; out[1] = touch.entry; out[2] = touch.distance;
    for (int k = 0; k < 3; ++k) out[3 + k] = touch.weight[k];
    p.apart[i] = nearest_on_segments(begin, begin + 3, end, end + 3, p.part + 2 * i, p.part + 2 * i + 1);
}
"""


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    with compiled(TEXT, tmp_path_factory.mktemp("texts")) as modules:
        yield modules["double"]


@dataclass
class Answer:
    least: np.ndarray
    weight: np.ndarray
    entry: np.ndarray
    clear: np.ndarray
    face: np.ndarray
    part: np.ndarray
    apart: np.ndarray


def box_grid() -> tuple[np.ndarray, np.ndarray]:
    """First node and spacing (4,), and distances of nodes from the box of SIZES."""
    spacing, half = 0.02, np.array(SIZES["box"][:3])
    first = -half - 4 * spacing
    axes = [np.arange(f, -f + spacing / 2, spacing) for f in first]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return np.array([*first, spacing]), box_distance(p)


def box_distance(p: np.ndarray) -> np.ndarray:
    q = abs(p) - SIZES["box"][:3]
    return np.asarray(np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0))


def distance(kind: str, p: np.ndarray) -> np.ndarray:
    """Of points (..., 3)."""
    if kind == "plane":
        return p[..., 1]
    if kind == "sphere":
        return np.asarray(np.linalg.norm(p, axis=-1) - 0.3)
    if kind == "capsule":
        y = np.clip(p[..., 1], -0.3, 0.3)
        return np.asarray(np.linalg.norm(p - y[..., None] * [0, 1, 0], axis=-1) - 0.1)
    return box_distance(p)


def ask(module: Any, kind: str, begin: Any, end: Any = None, inflate: float = D, bound: float = 1e3) -> Answer:
    begin = np.ascontiguousarray(begin, float).reshape(-1, 9)
    end = begin if end is None else np.ascontiguousarray(end, float).reshape(-1, 9)
    n, values, cells = len(begin), np.zeros(1), np.zeros((1, 3), np.int32)
    size = np.array([SIZES.get(kind, [0.0] * 4)], float)
    if kind == "grid":
        size[0], grid = box_grid()
        values, cells[0] = np.ascontiguousarray(grid.ravel()), grid.shape
    out = {
        "least": np.zeros(n), "weight": np.zeros((n, 3)), "entry": np.zeros(n), "clear": np.zeros(n, np.int32),
        "face": np.zeros((n, 6)), "part": np.zeros((n, 2)), "apart": np.zeros(n),
    }  # fmt: skip
    module.bind(
        "probe", n, kind=np.array([KINDS[kind]], np.int32), size=size, grid=values, place=np.zeros(1, np.int32),
        cells=cells, pose=np.array([[0.0, 0, 0, 1, 0, 0, 0]]), inflate=inflate, slack=1e-3 * inflate, bound=bound,
        begin=begin, end=end, **out,
    )()  # fmt: skip
    return Answer(**out)


def samples(count: int) -> np.ndarray:
    """Weights (m, 3) all over a triangle, its edges and corners included."""
    u, v = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
    inside = u + v <= count
    u, v = u[inside] / count, v[inside] / count
    return np.stack([1 - u - v, u, v], axis=1)


def triangles(count: int, random: np.random.Generator, size: float = 0.3, around: float = 0.5) -> np.ndarray:
    return random.uniform(-around, around, (count, 1, 3)) + random.normal(0, size, (count, 3, 3))


@pytest.mark.parametrize("kind", ["plane", "sphere", "box", "capsule", "grid"])
@pytest.mark.parametrize("size", [0.02, 0.1, 0.4])
def test_least_distances_are_those_of_dense_samples(module, kind, size):
    """Outside, across the surface, and inside."""
    corners, weights = triangles(200, np.random.default_rng(1), size), samples(40)
    found = ask(module, kind, corners)
    sampled = distance(kind, np.einsum("sa,nak->nsk", weights, corners)).min(axis=1)
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    slack = 0.012 if kind == "grid" else 1e-7  # of a grid: to half of its spacing
    near = sampled < 0.04 if kind == "grid" else sampled < np.inf  # a grid's own distances end beyond
    assert near.sum() > 30
    assert (found.least[near] <= sampled[near] + slack).all()
    assert (found.least >= sampled - edge / 40 - slack)[near].all()
    assert (found.weight >= -1e-12).all() and np.allclose(found.weight.sum(axis=1), 1)
    at = distance(kind, np.einsum("na,nak->nk", found.weight, corners))
    np.testing.assert_allclose(found.least[near], at[near], atol=slack if kind == "grid" else 1e-9)
    assert (found.least < 0).any() and (found.least > 0.05).any()


def test_of_a_grid_nothing_is_looked_for_above_the_bound(module):
    corners = triangles(200, np.random.default_rng(2), 0.1)
    free, bound = ask(module, "grid", corners).least, ask(module, "grid", corners, bound=0.05).least
    below = free < 0.05 - 1e-3
    assert below.sum() > 20 and (bound[~(free < 0.05)] == 0.05).all()
    np.testing.assert_allclose(bound[below], free[below], atol=0.012)


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "grid"])
def test_moving_triangles_enter_when_samples_first_come_near(module, kind):
    random, weights = np.random.default_rng(3), samples(20)
    begin = triangles(150, random, 0.1, 0.9)
    end = triangles(150, random, 0.1, 0.9)
    found = ask(module, kind, begin, end)
    times = np.linspace(0, 1, 101)
    points = [np.einsum("sa,nak->nsk", weights, begin + t * (end - begin)) for t in times]
    near = np.array([distance(kind, p).min(axis=1) for p in points])  # (times, n), from above
    speed = np.linalg.norm(end - begin, axis=2).max(axis=1)
    far = near[0] > D + 0.02
    first = np.where((near <= D).any(axis=0), times[(near <= D).argmax(axis=0)], NEVER)
    hit, passed = far & (first <= 1), far & (near.min(axis=0) > D + 0.03)
    assert hit.sum() > 10 and passed.sum() > 10
    step = (1 / 100 + 0.02 / speed)[hit] * 1.5  # of time, and of samples
    assert (found.entry[hit] <= first[hit] + 1e-9 + (0.01 if kind == "grid" else 0)).all()
    assert (found.entry[hit] >= first[hit] - step - 0.15).all()
    assert (found.entry[passed] == NEVER).all()
    # nothing is nearer than the thickness, less what rounding and slack are, before the entry
    at = found.entry[hit]
    moved = begin[hit] + at[:, None, None] * (end - begin)[hit]
    reached = distance(kind, np.einsum("sa,nak->nsk", weights, moved)).min(axis=1)
    assert (reached >= D * 0.99 - (0.012 if kind == "grid" else 0)).all()
    assert not found.clear[near.min(axis=0) < D].any()


def test_a_triangle_that_lies_on_a_face_needs_no_row_and_one_over_a_corner_does(module):
    flat = np.array([[-0.05, 0.205, -0.03], [0.05, 0.205, -0.03], [0, 0.205, 0.05]])
    turned = np.array([[0.2, -0.1, -0.1], [-0.1, 0.2, -0.1], [-0.1, -0.1, 0.2]]) / 2  # normal to the diagonal
    found = ask(module, "box", [flat, np.array([0.3, 0.2, 0.1]) + 0.005 + turned]).face
    assert found[0, 0] == -1
    assert found[1, 0] == 0 and found[1, 3:] == pytest.approx([1 / 3] * 3, abs=0.1)
    assert found[1, 2] == pytest.approx(0.005 * 3**0.5, rel=1e-6)
    for kind in ("sphere", "capsule"):
        ball = np.array([[0, 0, 1.0], [0.9, 0, -0.5], [-0.9, 0, -0.5]]) * 0.5 + [0, 0.405, 0]
        row = ask(module, kind, [ball]).face[0]
        assert row[0] == (0 if kind == "capsule" else -1)  # the end of the capsule is at 0.4, the ball's at 0.3


def test_planes_never_need_rows_of_triangles(module):
    corners = triangles(200, np.random.default_rng(5), 0.02, 0.02)
    assert (ask(module, "plane", corners, -corners).face[:, 0] == -1).all()


def test_nearest_points_of_segments_are_those_of_samples(module):
    random = np.random.default_rng(6)
    a, b = random.normal(0, 1, (100, 3, 3)), random.normal(0, 1, (100, 3, 3))
    b[:20, 1] = b[:20, 0] + a[:20, 1] - a[:20, 0]  # parallel
    b[20:30, 1] = b[20:30, 0]  # a point
    found = ask(module, "plane", a, b)
    s = np.linspace(0, 1, 201)
    p = a[:, :1] + s[:, None] * (a[:, 1:2] - a[:, :1])
    q = b[:, :1] + s[:, None] * (b[:, 1:2] - b[:, :1])
    sampled = np.array([np.linalg.norm(x[:, None] - y[None], axis=2).min() for x, y in zip(p, q, strict=True)])
    assert (found.apart <= sampled + 1e-9).all() and (found.apart >= sampled - 0.03).all()
    ends = (a[:, 0] + found.part[:, :1] * (a[:, 1] - a[:, 0])) - (b[:, 0] + found.part[:, 1:] * (b[:, 1] - b[:, 0]))
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), found.apart, atol=1e-12)


def test_each_edge_of_a_surface_has_one_owner():
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    owns = edge_owners(tetrahedron)
    edges = [
        tuple(sorted((t[k], t[(k + 1) % 3]))) for t, bits in zip(tetrahedron, owns, strict=True) for k in range(3)
        if bits >> k & 1
    ]  # fmt: skip
    assert len(edges) == len(set(edges)) == 6 and owns[0] == 7
