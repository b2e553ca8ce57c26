# SPDX-License-Identifier: MIT
"""kernels/contact_passes.cuh: where a point whose way enters obstacles is set back to."""

import itertools
from typing import Any

import numpy as np
import pytest

from sim_server.backends.declarations import Declarations
from tests.texts import compiled

KIND = Declarations("kernels/shapes.cuh").enumeration("ShapeKind")
RADIUS, REST = 0.05, [1.0, 0, 0, 0]
TEXT = """#include "kernel.h"
#include "contact_passes.cuh"
struct Probe {
    int n;               // points
    int count;           // obstacles
    int rounds;
    const int* kind;
    const double* size;
    const double* grid;
    const int* place;
    const int* cells;
    const double* begin;
    const double* end;
    const double* from;  // (n, 3)
    double* to;          // (n, 3) in, out
    double* entered;     // (n,) out: in how many rounds a way entered something
};
KERNEL(probe, Probe) {
    const ObstacleTable t = {p.kind, p.size, p.grid, p.place, p.cells, p.begin, p.end};
    auto entry = [&](int o, const double* from, const double* to, double* begin, double* end) {
        return entry_of_way(t, o, 0, from, to, begin, end);
    };
    for (int round = 0; round < p.rounds; ++round) {
        double back[3];
        if (!place_in_front(t, p.count, p.from + 3 * i, p.to + 3 * i, back, entry)) continue;
        for (int k = 0; k < 3; ++k) p.to[3 * i + k] = back[k];
        p.entered[i] += 1;
    }
}
"""


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    with compiled(TEXT, tmp_path_factory.mktemp("set_back")) as modules:
        yield modules["double"]


def set_back(
    text: Any, balls: list[tuple[Any, Any]], start: np.ndarray, stop: np.ndarray, rounds: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Of points over a floor and balls, each from a place to another one: where they end, and the rounds."""
    poses = [[[0.0, 0, 0, *REST], [*map(float, begin), *REST], [*map(float, end), *REST]] for begin, end in balls]
    begin = np.array([[0.0, 0, 0, *REST], *(pose[1] for pose in poses)])
    end = np.array([[0.0, 0, 0, *REST], *(pose[2] for pose in poses)])
    m, n = len(begin), len(start)
    kind = np.array([KIND["PLANE"], *[KIND["SPHERE"]] * (m - 1)], np.int32)
    size = np.array([[0.0] * 4, *[[RADIUS, 0, 0, 0]] * (m - 1)])
    out, entered = stop.copy(), np.zeros(n)
    text.bind(
        "probe", n, count=m, rounds=rounds, kind=kind, size=size, grid=np.zeros(1), place=np.zeros(m, np.int32),
        cells=np.zeros((m, 3), np.int32), begin=begin, end=end, to=out, entered=entered, **{"from": start},
    )()  # fmt: skip
    return out, entered


def above(n: int, seed: int = 0) -> np.ndarray:
    """Points over the floor, outside a ball at 0.1 m above it."""
    p = np.random.default_rng(seed).uniform([-0.08, 0.001, -0.08], [0.08, 0.08, 0.08], (3 * n, 3))
    return p[np.linalg.norm(p - [0, 0.1, 0], axis=1) > 1.01 * RADIUS][:n]


THRUST = ((0, 0.1, 0), (0, -0.1, 0))  # through the floor


def test_of_obstacles_that_stand_the_first_one_sets_back_by_a_part_of_the_way(text):
    start = above(500)
    stop = start + np.random.default_rng(1).normal(0, 0.1, start.shape)
    out, entered = set_back(text, [((0, 0.1, 0), (0, 0.1, 0))], start, stop)
    hit = entered > 0
    part = np.linalg.norm(out - start, axis=1) / np.linalg.norm(stop - start, axis=1)
    assert hit.sum() > 100 and (part[hit] < 0.9 + 1e-12).all() and (out[~hit] == stop[~hit]).all()
    assert (out[hit, 1] > 0).all() and (np.linalg.norm(out[hit] - [0, 0.1, 0], axis=1) > RADIUS).all()
    assert np.abs(np.cross(out - start, stop - start)).max() < 1e-12  # on the way
    again, entered = set_back(text, [((0, 0.1, 0), (0, 0.1, 0))], start, stop, rounds=5)
    assert (again == out).all() and entered.max() == 1


def test_a_ball_that_moves_takes_points_along(text):
    start = above(500)
    out, entered = set_back(text, [((0, 0.1, 0), (0.1, 0.1, 0))], start, start.copy())
    hit = entered > 0
    assert hit.sum() > 20 and (out[hit, 0] > start[hit, 0]).all()
    assert (np.linalg.norm(out - [0.1, 0.1, 0], axis=1) > RADIUS).all()


def test_where_two_close_over_a_point_it_stays_on_the_side_where_it_began(text):
    """However often it is set back: in front of the ball is below the floor."""
    start = above(500)
    first, entered = set_back(text, [THRUST], start, start.copy())
    hit = entered > 0
    assert hit.sum() > 50 and (first[:, 1] > 0).all()
    for rounds in range(2, 9):
        out, entered = set_back(text, [THRUST], start, start.copy(), rounds)
        assert (out[:, 1] > 0).all() and (entered[hit] == rounds).any()
        assert np.linalg.norm(out - start, axis=1).max() < 0.1 < THRUST[0][1] - THRUST[1][1]


def test_of_two_that_move_the_slower_one_has_it(text):
    """A ball comes down fast, one from the other side slowly, until both are where the points were."""
    start = np.random.default_rng(3).uniform([-0.01, 0.39, -0.01], [0.01, 0.41, 0.01], (50, 3))
    fast, slow = ((0, 0.6, 0), (0, 0.3, 0)), ((0, 0.33, 0), (0, 0.36, 0))
    for balls, rounds in itertools.product(([fast, slow], [slow, fast]), (1, 2, 3, 4)):
        out, entered = set_back(text, balls, start, start.copy(), rounds)
        assert (entered > 0).all()
        assert (np.linalg.norm(out - slow[1], axis=1) > RADIUS).all() and (out[:, 1] > slow[1][1]).all()
