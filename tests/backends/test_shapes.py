# SPDX-License-Identifier: MIT
"""kernels/shapes.cuh: distances, normals, poses and times of entry, against NumPy and dense samples of paths."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_server.backends.declarations import Declarations
from tests.reference import shapes as reference
from tests.texts import compiled

KIND = Declarations("kernels/shapes.cuh").enumeration("ShapeKind")
NEVER = 2.0

TEXT = """#include "kernel.h"
#include "shapes.cuh"
struct Probe {
    int n;                // points
    const int* kind;
    const double* size;
    const double* grid;
    const int* place;
    const int* cells;
    const double* pose;   // (1, 7)
    double inflate;
    const double* from;   // (n, 3)
    const double* to;     // (n, 3)
    double* distance;     // (n,) of from
    double* normal;       // (n, 3)
    double* entry;        // (n,)
    double* world;        // (n, 3) from, taken to the world and back into the frame by `local`
    double* local_again;  // (n, 3)
};
KERNEL(probe, Probe) {
    ObstacleTable t = {p.kind, p.size, p.grid, p.place, p.cells, p.pose, p.pose};
    p.distance[i] = distance_to(t, 0, p.from + 3 * i, p.normal + 3 * i);
    p.entry[i] = entry_time(t, 0, p.from + 3 * i, p.to + 3 * i, p.inflate);
    world_point(p.pose, p.from + 3 * i, p.world + 3 * i);
    local_point(p.pose, p.world + 3 * i, p.local_again + 3 * i);
}
"""


@dataclass
class Shape:
    """A shape as kernels have it, and its distances as the reference has them."""

    kind: str
    size: tuple[float, float, float, float]
    distance: Callable[[np.ndarray], np.ndarray]
    values: np.ndarray

    def ask(self, module: Any, start: Any, stop: Any = None, inflate: float = 0.0, pose: Any = None) -> dict:
        start = np.ascontiguousarray(np.atleast_2d(start), float)
        stop = start if stop is None else np.ascontiguousarray(np.atleast_2d(stop), float)
        n = len(start)
        out = {name: np.zeros((n, 3)) for name in ("normal", "world", "local_again")}
        out |= {name: np.zeros(n) for name in ("distance", "entry")}
        shape = np.array(self.values.shape if self.kind == "GRID" else (0, 0, 0), np.int32)
        module.bind(
            "probe", n, kind=np.array([KIND[self.kind]], np.int32), size=np.array(self.size), grid=self.values.ravel(),
            place=np.zeros(1, np.int32), cells=shape, pose=np.array(pose or [0, 0, 0, 1, 0, 0, 0], float),
            inflate=inflate, **{"from": start}, to=stop, **out,
        )()  # fmt: skip
        return out


def no_values() -> np.ndarray:
    return np.zeros((1, 1, 1))


def box(x: float, y: float, z: float) -> Shape:
    half = np.array([x, y, z]) / 2
    return Shape("BOX", (*half, 0.0), lambda p: reference.box(p, half), no_values())


def two_walls() -> Shape:
    """A grid of distances of two spheres and a plate: not convex."""
    first, spacing = np.array([-0.7, -0.6, -0.5]), 0.05
    nodes = np.stack(np.meshgrid(*(first[k] + spacing * np.arange(c) for k, c in enumerate((29, 25, 21)))), axis=-1)
    points = np.swapaxes(nodes, 0, 1).reshape(-1, 3)
    balls = [np.linalg.norm(points - c, axis=1) - 0.2 for c in ([-0.35, 0, 0], [0.3, 0.1, 0])]
    plate = reference.box(points - [0.0, -0.4, 0.0], np.array([0.6, 0.05, 0.3]))
    values = np.minimum.reduce([*balls, plate]).reshape(29, 25, 21)
    return Shape("GRID", (*first, spacing), lambda p: reference.grid(p, first, spacing, values), values)


SHAPES = {
    "plane": Shape("PLANE", (0.0, 0.0, 0.0, 0.0), reference.plane, no_values()),
    "sphere": Shape("SPHERE", (0.3, 0.0, 0.0, 0.0), lambda p: reference.sphere(p, 0.3), no_values()),
    "box": box(0.8, 0.2, 0.5),
    "thin plate": box(1.0, 0.002, 1.0),
    "capsule": Shape("CAPSULE", (0.15, 0.4, 0.0, 0.0), lambda p: reference.capsule(p, 0.15, 0.4), no_values()),
    "grid": two_walls(),
}
CONVEX = [name for name in SHAPES if name != "grid"]


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    with compiled(TEXT, tmp_path_factory.mktemp("texts")) as modules:
        yield modules["double"]


def points(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3))


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_those_of_the_reference(module, name):
    p = points(3000)
    np.testing.assert_allclose(SHAPES[name].ask(module, p)["distance"], SHAPES[name].distance(p), atol=1e-14)


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_unit_slopes_of_the_distance(module, name):
    shape, p, h = SHAPES[name], points(3000, 2), 1e-6
    normal = shape.ask(module, p)["normal"]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-14)
    slope = np.stack([(shape.distance(p + h * e) - shape.distance(p - h * e)) / (2 * h) for e in np.eye(3)], axis=1)
    slope /= np.linalg.norm(slope, axis=1)[:, None]
    apart = np.linalg.norm(slope - normal, axis=1)
    assert np.mean(apart > 1e-6) < 2e-3  # of those within h of a kink


@pytest.mark.parametrize("name", CONVEX)
def test_the_nearest_point_is_on_the_surface(module, name):
    shape, p = SHAPES[name], points(2000, 3)
    out = shape.ask(module, p)
    nearest = p - out["distance"][:, None] * out["normal"]
    np.testing.assert_allclose(shape.distance(nearest), 0, atol=1e-14)


@pytest.mark.parametrize("corner", [(0.4, 0.1, 0.25), (-0.4, 0.1, -0.25), (0.4, 0.1, 0.0), (0.4, 0.0, 0.0)])
def test_on_corners_edges_and_faces_of_a_box_the_normal_leads_out(module, corner):
    shape = SHAPES["box"]
    out = shape.ask(module, [corner])
    assert out["distance"][0] == 0
    assert np.linalg.norm(out["normal"][0]) == 1
    assert shape.distance(np.array([corner]) + 1e-3 * out["normal"])[0] == pytest.approx(1e-3)


def test_centres_have_a_normal(module):
    for shape in SHAPES.values():
        out = shape.ask(module, [0.0, 0.0, 0.0])
        assert np.linalg.norm(out["normal"][0]) == pytest.approx(1)


def test_poses_take_points_to_the_world_and_back(module):
    random = np.random.default_rng(4)
    for _ in range(5):
        q = random.normal(size=4)
        q /= np.linalg.norm(q)
        at, p = random.normal(size=3), points(50, 5)
        out = SHAPES["plane"].ask(module, p, pose=[*at, *q])
        np.testing.assert_allclose(out["world"], p @ reference.rotation(q).T + at, atol=1e-14)
        np.testing.assert_allclose(out["local_again"], p, atol=1e-14)


def first_entry(shape: Shape, start: np.ndarray, along: np.ndarray, inflate: float, samples: int = 4000) -> float:
    """First sampled time at which the distance is at most `inflate`, after one at which it was more."""
    times = np.linspace(0, 1, samples + 1)
    above = shape.distance(start + times[:, None] * along) - inflate
    after = np.flatnonzero(above > 0)
    found = np.flatnonzero((above <= 0) & (np.arange(samples + 1) > (after[0] if len(after) else samples)))
    return float(times[found[0]]) if len(found) else NEVER


@pytest.mark.parametrize("inflate", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("name", SHAPES)
def test_entries_are_those_of_a_sampled_path(module, name, inflate):
    shape, start, stop, samples = SHAPES[name], points(150, 6), 1.5 * points(150, 7), 4000
    found = shape.ask(module, start, stop, inflate)["entry"]
    hits = 0
    for a, b, t in zip(start, stop, found, strict=True):
        if shape.distance(a[None])[0] <= inflate:
            continue
        sampled = first_entry(shape, a, b - a, inflate, samples)
        if sampled == NEVER and t != NEVER:  # a graze between two samples
            assert shape.distance((a + t * (b - a))[None])[0] <= inflate + 1e-12
        elif name == "grid" and t == NEVER != sampled:
            times = np.linspace(0, 1, samples)
            assert shape.distance(a + times[:, None] * (b - a)).min() > inflate - 0.05 / 20
        else:
            assert t == pytest.approx(sampled, abs=1.01 / samples)
        hits += t != NEVER
    assert hits > 3


@pytest.mark.parametrize("name", SHAPES)
def test_a_start_within_enters_at_once_if_it_goes_deeper_and_never_if_it_leaves(module, name):
    shape, inflate = SHAPES[name], 0.02
    p = points(4000, 8)
    out = shape.ask(module, p)
    within = out["distance"] <= inflate
    p, normal = p[within], out["normal"][within]
    assert len(p) > 10
    side = 0.3 * np.cross(normal, [0.3, 0.5, -0.4])
    assert (shape.ask(module, p, p - 0.01 * normal + 0.01 * side, inflate)["entry"] == 0).all()
    assert (shape.ask(module, p, p, inflate)["entry"] == NEVER).all()
    if name != "grid":
        assert (shape.ask(module, p, p + 0.5 * normal + side, inflate)["entry"] == NEVER).all()


def test_in_a_grid_a_path_that_leaves_one_wall_enters_the_next(module):
    shape, inflate = SHAPES["grid"], 0.02
    start, stop = np.array([-0.35, 0.21, 0.0]), np.array([-0.35, 5.0, 0.0])  # above a ball, up and away
    assert shape.ask(module, start, stop, inflate)["entry"] == NEVER
    start, stop = np.array([-0.14, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])  # from one ball into the other
    entry = shape.ask(module, start, stop, inflate)["entry"][0]
    assert entry == pytest.approx(first_entry(shape, start, stop - start, inflate), abs=1e-3)
    start, stop = np.array([-0.5, -0.335, 0.2]), np.array([-0.5, -0.334, -0.2])  # along the plate
    assert shape.ask(module, start, stop, inflate)["entry"] == NEVER


@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0, 1e4])
@pytest.mark.parametrize("dt", [0.005, 1 / 60, 0.03])
def test_a_thin_plate_is_found_at_any_speed(module, speed, dt):
    shape, random = SHAPES["thin plate"], np.random.default_rng(9)
    for inflate in (0.0, 1e-4, 1e-3):
        start = np.stack([random.uniform(-0.4, 0.4, 300), random.uniform(0.0011, 0.5, 300) + inflate,
                          random.uniform(-0.4, 0.4, 300)], axis=1)  # fmt: skip
        along = np.stack([random.normal(size=300) * 0.05, np.full(300, -speed * dt), random.normal(size=300) * 0.05], 1)
        reaches = start[:, 1] - 0.001 - inflate < speed * dt
        expected = np.where(reaches, (start[:, 1] - 0.001 - inflate) / (speed * dt), NEVER)
        np.testing.assert_allclose(shape.ask(module, start, start + along, inflate)["entry"], expected, rtol=1e-9)


NUMBER = st.floats(-2, 2)
POINT = st.tuples(NUMBER, NUMBER, NUMBER)


@given(
    name=st.sampled_from(CONVEX), start=POINT, stop=POINT, far=st.floats(1, 1e4),
    inflate=st.one_of(st.just(0.0), st.floats(1e-6, 0.3)),
)  # fmt: skip
@settings(max_examples=300, deadline=None)
def test_a_path_is_above_until_it_enters_and_at_the_bound_there(module, name, start, stop, far, inflate):
    shape, a = SHAPES[name], np.array(start)
    b = far * np.array(stop)
    if shape.distance(a[None])[0] <= inflate:
        return
    entry = shape.ask(module, a, b, inflate)["entry"][0]
    slack = 1e-13 * (1 + far)
    times = np.linspace(0, min(entry, 1), 200)
    assert (shape.distance(a + times[:, None] * (b - a)) > inflate - slack).all()
    if entry != NEVER:
        assert 0 <= entry <= 1
        assert shape.distance((a + entry * (b - a))[None])[0] <= inflate + slack
