# SPDX-License-Identifier: MIT
"""Named points of a body, and the box around it."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sim_server.mechanics.named_points import NAMES, NamedPoints
from sim_server.mechanics.world import World
from tests.scenes import bar, simulation

H = 0.02


def world(**table: object) -> World:
    return simulation(bar(**({"young": 1e5, "touch": True} | table)), dt=H).world  # type: ignore[arg-type]


def points(in_world: World) -> NamedPoints:
    found = NamedPoints(in_world, in_world.bodies[0])
    found.now()
    return found


def test_the_tip_is_at_the_end_that_is_not_held() -> None:
    w = world(fixed="X < 0.01")
    found = points(w)
    x, tip = found.now(), found.named("tip")
    assert tip[0] == x[:, 0].max() == 2.0
    w.x += [0.0, 5.0, 0.0]
    w.x[:, 0] *= -1  # wherever it goes, it is the same node
    assert found.named("tip") == (-2.0, tip[1] + 5, tip[2])


def test_the_tip_of_what_is_held_at_both_ends_is_in_the_middle() -> None:
    x, *_ = points(world(fixed="X < 0.01 or X > 1.99")).named("tip")
    assert x == 1.0


def test_the_tip_of_what_nothing_holds_is_at_its_border() -> None:
    found = points(world())
    x = found.now()
    middle = x.mean(axis=0)
    away = np.linalg.norm(np.array(found.named("tip")) - middle)
    assert away == pytest.approx(np.linalg.norm(x - middle, axis=1).max())


def test_sides_are_free_nodes_as_the_body_lies_now() -> None:
    w = world(fixed="X < 0.01")
    found = points(w)
    w.x[:] = w.x[:, [2, 0, 1]] + 7.0  # turned: its length along y
    x = found.now()[found.free]
    for name, axis, sign in (("right", 0, 1), ("left", 0, -1), ("top", 1, 1), ("bottom", 1, -1), ("front", 2, 1),
                             ("back", 2, -1)):  # fmt: skip
        assert found.named(name)[axis] == sign * (sign * x[:, axis]).max(), name
    assert found.named("bottom")[1] > 7.0, "its lowest nodes are fixed"
    assert found.box() == ((7.0, 7.0, 7.0), (8.0, 9.0, 8.0))
    assert found.distance((7.5, 8.0, 7.5)) == 0 and found.distance((10.0, 8.0, 8.0)) == 2.0


def test_the_tip_is_where_it_is_once_it_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """To find it takes time at the first use, in which a body of a server moves on."""
    w = world(fixed="X < 0.01")
    found = points(w)
    search = cKDTree.query

    def slow(self: cKDTree, at: np.ndarray) -> object:
        w.x += [0.0, 5.0, 0.0]
        return search(self, at)

    monkeypatch.setattr("scipy.spatial.cKDTree", type("Slow", (cKDTree,), {"query": slow}))
    assert found.named("tip")[1] >= 5.0


def test_other_names_are_refused() -> None:
    with pytest.raises(ValueError, match="no point 'nose'; known: tip, right, left, top, bottom, front, back"):
        points(world()).named("nose")
    assert len(NAMES) == 7
