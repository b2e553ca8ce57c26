# SPDX-License-Identifier: MIT
"""Rows between bodies (kernels/pair_detection.cuh) against all vertices x all triangles, and what rows remember."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from sim_server.backends.contact import Contact, Surfaces
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.contact.scenes import block
from tests.reference.triangles import NEVER, distances, entries, is_inside, normals
from tests.scenes import random_rotations

H = 0.01
D = 0.002
DEEP = 5
G = np.array([0.4, -9.81, -0.2])
CELLS, SIZE = (3, 2, 3), (0.09, 0.06, 0.09)


def scene(*objects: dict, friction: list | None = None, thickness: float = D) -> Simulation:
    """Blocks of (3, 2, 3) cells, or other objects, in contact, where nothing has been assembled yet."""
    contact = {"thickness": thickness} | ({"friction": friction} if friction else {})
    table: dict[str, Any] = {
        "name": "test", "dt": H, "object": list(objects), "effects": {"gravity": {"g": G.tolist()}, "contact": contact},
        "solver": {"preconditioner": "block_jacobi"},
    }  # fmt: skip
    return Simulation(Scene.model_validate(table, context={"folder": "."}))


def blocks(*names: str, at: Any = None, **table: Any) -> list[dict]:
    """Blocks far from each other, or `at` places."""
    places = at or [(k, 0, 0) for k in range(len(names))]
    return [block(cells=CELLS, size=SIZE, name=n, at=p, **table) for n, p in zip(names, places, strict=True)]


@dataclass
class Detected:
    """Rows between bodies of the step under way, by vertex and other body."""

    sim: Simulation

    @property
    def input(self) -> Contact:
        found: Contact = self.sim.contact.contact_input()
        return found

    @property
    def surfaces(self) -> Surfaces:
        assert self.input.surfaces is not None
        return self.input.surfaces

    @property
    def first(self) -> int:
        return len(self.input.obstacle) // 2

    def rows(self) -> dict[tuple[int, int], int]:
        """Row by (node, other body)."""
        sites = self.input.corner[: self.first : 2, 0]
        used = [r for r in range(self.first, 2 * self.first) if self.input.obstacle[r] >= 0]
        found = {(int(sites[(r - self.first) // 2]), int(self.input.obstacle[r])): r for r in used}
        assert len(found) == len(used)  # no body twice
        return found

    def assemble(self) -> dict[tuple[int, int], int]:
        self.sim.engine.assemble()
        return self.rows()

    def displacements(self) -> np.ndarray:
        """Of all nodes by gravity alone."""
        world = self.sim.world
        return np.asarray(H * (world.v + H * G * (world.free > 0)[:, None]))

    def triangles(self, body: int) -> np.ndarray:
        """Nodes (t, 3) of a body's surface."""
        b, t = self.sim.world.bodies[body], self.surfaces.triangle
        return np.asarray(t[(t[:, 0] >= b.first) & (t[:, 0] < b.last)])


@dataclass
class Expected:
    entry: float
    distance: float  # at the start of the step; negative inside
    normals: np.ndarray  # (n, 3), one of which is the row's
    place: np.ndarray  # of the vertex as it is met [m], from the triangle as at the start


def expected(x: np.ndarray, s: np.ndarray, node: int, triangles: np.ndarray, d: float) -> Expected | str | None:
    """What a vertex has of one other body; text: too close to the limit of a case to tell."""
    corners, count = x[triangles], len(triangles)
    p, path = np.broadcast_to(x[node], (count, 3)), s[node] - s[triangles].mean(axis=1)
    away = distances(p, corners)
    inside, nearest = is_inside(x[node], corners), away.min()
    if any(abs(nearest - limit * d) < 1e-6 * d for limit in (1, 2, DEEP)):
        return "at a limit"
    at = away < nearest + 1e-9 * d
    if inside:
        if nearest > DEEP * d:
            return None
        face = normals(corners[at])
        going = (face * path[at]).sum(axis=1) < 0
        return Expected(0.0 if going.all() else NEVER if not going.any() else np.nan, -nearest, face, x[node])
    front = ((p - corners[:, 0]) * normals(corners)).sum(axis=1) >= 0
    front &= away < np.linalg.norm(path, axis=1) + 1.01 * d  # it cannot come to the others
    if nearest > d and front.any():
        times, closest = entries(p[front], path[front], corners[front], d)
        if (abs(closest - d) < 1e-3 * d).any():
            return "grazes"
        k = int(times.argmin())
        if times[k] <= 1:
            place = x[node] + times[k] * path[front][k]
            h = 1e-6 * d
            slope = [
                float(distances(place[None] + h * e, corners[front][k : k + 1])[0])
                - float(distances(place[None] - h * e, corners[front][k : k + 1])[0]) for e in np.eye(3)
            ]  # fmt: skip
            return Expected(float(times[k]), nearest, np.array([slope]) / (2 * h), place)
    if nearest > 2 * d:
        return None
    h = 1e-5 * d
    one = corners[at][:1]
    slope = [
        float(distances(x[node][None] + h * e, one)[0] - distances(x[node][None] - h * e, one)[0]) for e in np.eye(3)
    ]
    normal = np.array([slope]) / (2 * h)
    going = (path[at] @ normal[0] < 0) & (nearest <= d)
    return Expected(0.0 if going.all() else NEVER if not going.any() else np.nan, nearest, normal, x[node])


def check(found: Detected, d: float = D) -> dict[str, int]:
    """Compares all rows with the reference; returns how many there are of each sort."""
    rows, world, given = found.assemble(), found.sim.world, found.input
    x, s = world.x.copy(), found.displacements()
    sorts = {"near": 0, "inside": 0, "entering": 0, "none": 0}
    seen = set()
    for site, node in enumerate(given.corner[: found.first : 2, 0]):
        body = int(found.surfaces.site_body[site])
        for other in range(len(world.bodies)):
            if other == body:
                continue
            e = expected(x, s, int(node), found.triangles(other), d)
            seen.add((int(node), other))
            if isinstance(e, str):
                continue
            if e is None:
                assert (node, other) not in rows
                sorts["none"] += 1
                continue
            row = rows[node, other]
            sorts["inside" if e.distance < 0 else "entering" if 0 < e.entry <= 1 else "near"] += 1
            corner, weight = given.corner[row], given.weight[row]
            assert corner[0] == node and weight[0] == 1
            assert sorted(corner[1:]) in np.sort(found.triangles(other), axis=1).tolist()
            assert weight.sum() == pytest.approx(0, abs=1e-12) and (weight[1:] <= 1e-12).all()
            if not np.isnan(e.entry):
                assert given.entry[row] == pytest.approx(e.entry, abs=1e-5)
            assert (abs(given.normal[row] - e.normals).max(axis=1) < 1e-3).any()
            off = e.place + weight[1:] @ x[corner[1:]]  # from the point touched
            length = d if 0 < e.entry <= 1 else abs(e.distance)
            assert np.linalg.norm(off) == pytest.approx(length, rel=1e-4, abs=1e-9)
            assert given.gap[row] == pytest.approx(given.normal[row] @ (weight @ x[corner]), abs=1e-12)
            assert given.thickness[row] == pytest.approx(d)
    assert set(rows) <= seen
    return sorts


def scatter(sim: Simulation, random: np.random.Generator, speed: float, apart: float) -> None:
    """Turns the bodies at random, deforms them a little, and puts them side by side, flying towards each other."""
    world = sim.world
    for body, turn in zip(
        world.bodies, random_rotations(len(world.bodies), int(random.integers(1 << 30))), strict=True
    ):
        rest = body.mesh.rest - body.mesh.rest.mean(axis=0)
        centre = random.normal(0, apart, 3)
        world.x[body.nodes] = rest @ turn.T + centre + random.normal(0, 0.001, rest.shape)
        world.v[body.nodes] = -speed * centre / np.linalg.norm(centre) + random.normal(0, 0.3 * speed, rest.shape)


@pytest.mark.parametrize(
    ("sort", "speed", "apart"), [("inside", 0.02, 0.025), ("near", 1.0, 0.035), ("entering", 8.0, 0.07)]
)
def test_rows_of_two_blocks_are_those_of_the_reference(sort, speed, apart):
    random, total = np.random.default_rng(7), dict.fromkeys(("near", "inside", "entering", "none"), 0)
    found = Detected(scene(*blocks("a", "b")))
    for _ in range(3):
        scatter(found.sim, random, speed, apart)
        for key, count in check(found).items():
            total[key] += count
    assert total["none"] > 30 and total[sort] > 3


def test_rows_where_blocks_have_fixed_nodes_on_either_side():
    random, total, held = np.random.default_rng(8), 0, 0
    found = Detected(scene(*blocks("a", "b", at=[(0, 0, 0), (1, 0, 0)], fixed="X < 0.05")))
    fixed = np.flatnonzero(found.sim.world.free == 0)
    for _ in range(4):
        scatter(found.sim, random, 0.5, 0.03)
        found.sim.world.v[fixed] = 0
        sorts = check(found)
        assert not {node for node, _ in found.rows()} & set(fixed.tolist())
        rows = list(found.rows().values())
        held += np.count_nonzero(np.isin(found.input.corner[rows, 1:], fixed).all(axis=1))
        assert (found.input.stiffness[rows] > 0).all()
        total += sorts["near"] + sorts["inside"] + sorts["entering"]
    assert total > 10 and held > 3


def over_a_block(at: tuple[float, float, float], lower: dict | None = None) -> Detected:
    """A small block over a large one, whose top is at y = 0; at: of the small one's lowest corner."""
    low = {"cells": (4, 2, 4), "size": (0.16, 0.06, 0.16), "at": (-0.08, -0.06, -0.08)} | (lower or {})
    small = block(name="a", cells=(1, 1, 1), size=(0.01, 0.01, 0.01), at=at)
    return Detected(scene(small, block(name="b", **low)))


def nodes_of(found: Detected, body: int, height: float) -> list[int]:
    b, x = found.sim.world.bodies[body], found.sim.world.x
    return [k for k in range(b.first, b.last) if abs(x[k, 1] - height) < 1e-9]


def test_a_vertex_is_held_by_a_face_all_of_whose_corners_are_fixed():
    """Also far from the nodes that move."""
    found = over_a_block((-0.07, D, -0.07), {"fixed": "X < 0.09"})
    feet = nodes_of(found, 0, D)
    rows = found.assemble()
    assert {(node, 1) for node in feet} <= set(rows)
    for node in feet:
        row = rows[node, 1]
        assert found.input.gap[row] == pytest.approx(D) and found.input.normal[row] == pytest.approx([0, 1, 0])
        own = found.input.stiffness[2 * found.surfaces.node_site[node]]
        assert found.input.stiffness[row] == pytest.approx(own)


@pytest.mark.parametrize("beyond", [2.1, 3.0, 4.5])
def test_a_vertex_beside_an_edge_is_outside_although_it_is_below_the_other_face(beyond):
    """The face above is nearer than DEEP, and the vertex, which stops before it reaches the block, is behind it."""
    found = over_a_block((0.08 + beyond * D, -0.5 * D, 0))
    found.sim.world.v[found.sim.world.bodies[0].nodes] = [-(beyond - 1.5) * D / H, 0, 0]
    assert found.assemble() == {}


@pytest.mark.parametrize("depth", [0.5, 2.5, 4.5, 5.5])
@pytest.mark.parametrize("up", [0.0, 1e-3])
def test_a_vertex_inside_is_pushed_out_by_the_nearest_face_if_it_is_not_too_deep(depth, up):
    """Also one at rest, and where a face that is further away leans over it."""
    found = over_a_block((-0.005, -depth * D, -0.005))
    world = found.sim.world
    top = nodes_of(found, 1, 0.0)
    world.x[top, 1] += up * world.x[top, 0]
    feet = nodes_of(found, 0, -depth * D)
    rows = found.assemble()
    assert {node for node, _ in rows if node in feet} == (set(feet) if depth < 5 else set())
    for node in feet if depth < 5 else ():
        row = rows[node, 1]
        assert found.input.gap[row] == pytest.approx(-depth * D, abs=0.01 * up)
        assert found.input.normal[row] == pytest.approx([0, 1, 0], abs=2 * up)


def test_a_vertex_that_flies_into_an_edge_does_not_go_through():
    """Diagonally, so that it is over neither face when it comes near."""
    random = np.random.default_rng(1)
    found = over_a_block((0, 0.5, 0))
    world, small = found.sim.world, found.sim.world.bodies[0]
    rest = world.x[small.nodes] - world.x[small.nodes].mean(axis=0)
    for _ in range(40):
        target = np.array([0.08, 0.0, random.uniform(-0.06, 0.06)])
        way = np.array([random.uniform(0.3, 1), random.uniform(0.3, 1), 0.0]) * 0.1
        node = int(random.integers(len(rest)))
        world.x[small.nodes] = rest - rest[node] + target + way + random.normal(0, 0.2 * D, 3)
        world.v[:] = -H * G * (world.free > 0)[:, None]
        world.v[small.nodes] -= 2 * way / H
        row = found.assemble()[small.first + node, 1]
        assert 0.4 < found.input.entry[row] < 0.5
        assert found.input.normal[row] @ way > 0


def slide(found: Detected, body: int, by: tuple[float, float, float]) -> None:
    found.sim.world.x[found.sim.world.bodies[body].nodes] += by


def test_a_vertex_that_slides_to_another_triangle_of_the_body_keeps_its_forces():
    found = over_a_block((0.003, D, 0.004))
    rows = found.assemble()
    node = nodes_of(found, 0, D)[0]
    before, given = rows[node, 1], found.input
    triangle = given.corner[before].copy()
    given.force[before], given.traction[before] = 3.0, [0.5, 0.0, -0.25]
    slide(found, 0, (0.025, 0, -0.03))
    after = found.assemble()[node, 1]
    assert not np.array_equal(given.corner[after], triangle)
    assert given.force[after] == 3.0
    np.testing.assert_allclose(given.traction[after], [0.5, 0, -0.25], atol=1e-14)


def test_traction_turns_with_the_normal():
    found = over_a_block((0.003, D, 0.004))
    node = nodes_of(found, 0, D)[0]
    row, given = found.assemble()[node, 1], found.input
    given.force[row], given.traction[row] = 3.0, [0.5, 0.0, -0.25]
    angle = 0.2
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    found.sim.world.x[:] = found.sim.world.x @ turn.T
    row = found.assemble()[node, 1]
    np.testing.assert_allclose(given.normal[row], turn @ [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(given.traction[row], turn @ [0.5, 0, -0.25], atol=1e-12)


def test_rows_of_a_body_that_goes_away_are_emptied():
    found = over_a_block((0.003, D, 0.004))
    used = list(found.assemble().values())
    given = found.input
    given.force[used], given.traction[used] = 3.0, [0.5, 0.0, -0.25]
    slide(found, 0, (0, 3.0, 0))
    assert found.assemble() == {}
    assert not given.force.any() and not given.traction.any() and (given.entry == NEVER).all()
    slide(found, 0, (0, -3.0, 0))
    assert list(found.assemble().values()) == used and not given.force.any()


def test_a_vertex_of_a_frozen_body_has_no_rows_but_holds_others():
    found = over_a_block((0.003, D, 0.004))
    world = found.sim.world
    before = found.assemble()
    world.free[world.bodies[1].nodes] = 0
    after = found.assemble()
    assert set(after) == {(node, other) for node, other in before if other == 1} and after


def test_a_vertex_has_rows_for_two_bodies_and_they_keep_their_memory_whatever_their_order():
    """A small block in the corner between a floor and a wall, with a third body further away."""
    size = {"cells": (4, 2, 4), "size": (0.16, 0.06, 0.16)}
    found = Detected(scene(
        block(name="a", cells=(1, 1, 1), size=(0.01, 0.01, 0.01), at=(0.5 * D, 0.8 * D, 0)),
        block(name="floor", at=(-0.02, -0.06, -0.08), **size),
        block(name="wall", at=(-0.16, -0.002, -0.08), **size),
        block(name="lid", at=(-0.02, 0.01 + 0.8 * D + 1.5 * D, -0.08), **size),
    ))  # fmt: skip
    given, node = found.input, nodes_of(found, 0, 0.8 * D)[0]
    assert np.allclose(found.sim.world.x[node], [0.5 * D, 0.8 * D, 0])

    def at_node() -> list[int]:
        found.sim.engine.assemble()
        first = found.first + 2 * int(found.surfaces.node_site[node])
        return [int(b) for b in given.obstacle[first : first + 2]]

    found.sim.world.v[found.sim.world.bodies[0].nodes] = [-1, -1, 0]
    assert at_node() == [2, 1]  # both at once: the nearest first
    rows = found.rows()
    given.force[rows[node, 1]], given.force[rows[node, 2]] = 5.0, 7.0
    found.sim.world.v[found.sim.world.bodies[0].nodes] = [1, -1, 0]
    assert at_node() == [1, 2]  # the wall is left
    rows = found.rows()
    assert given.force[rows[node, 1]] == 5.0 and given.force[rows[node, 2]] == 7.0
    np.testing.assert_allclose(given.normal[rows[node, 2]], [1, 0, 0], atol=1e-12)


def test_the_pair_has_its_friction_and_the_mean_of_thickness_and_stiffness():
    pair = {"between": ["b", "a"], "value": 0.07}
    at = [(0, 0, 0), (0, SIZE[1] + D, 0), (0, 2 * (SIZE[1] + D), 0)]
    objects = [o | {"friction": mu} for o, mu in zip(blocks("a", "b", "c", at=at), (0.2, 0.8, 0.45), strict=True)]
    found = Detected(scene(*objects, friction=[pair]))
    rows, given = found.assemble(), found.input
    kinds = set()
    for (node, other), row in rows.items():
        site = found.surfaces.node_site[node]
        between = frozenset((int(found.surfaces.site_body[site]), other))
        kinds.add(between)
        mu = {frozenset((0, 1)): 0.07, frozenset((1, 2)): 0.6}[between]
        assert given.friction[row] == pytest.approx(mu)
        facing = found.surfaces.node_site[given.corner[row, 1:]]
        theirs = -given.weight[row, 1:] @ given.stiffness[2 * facing]
        own = given.stiffness[2 * site]
        assert given.stiffness[row] == pytest.approx(2 / (1 / own + 1 / theirs))
    assert len(kinds) == 2


def test_bodies_of_different_thickness_keep_the_mean_of_both():
    small = block(name="a", cells=(1, 1, 1), size=(0.01, 0.01, 0.01), at=(0, 0.003, 0))
    large = block(name="b", cells=(4, 2, 4), size=(0.16, 0.06, 0.16), at=(-0.08, -0.06, -0.08))
    table = {
        "name": "test", "dt": H, "object": [small, large], "solver": {"preconditioner": "block_jacobi"},
        "effects": {"gravity": {"g": [0, 0, 0]}, "contact": True},
    }  # fmt: skip
    found = Detected(Simulation(Scene.model_validate(table, context={"folder": "."})))
    rows = found.assemble()
    assert rows and found.input.thickness[list(rows.values())] == pytest.approx((0.001 + 0.003) / 2)
