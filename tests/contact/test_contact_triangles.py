# SPDX-License-Identifier: MIT
"""Obstacles that are smaller than the triangles of a surface do not pass between its nodes, at any speed."""

import logging

import numpy as np
import pytest

from sim_server.mesh.surface import surface_triangles
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import D, over
from tests.contact_scene import table
from tests.reference.contact import Rows

SMALL = {"cells": (2, 2, 2), "size": (0.1, 0.1, 0.1), "young": 3e5}  # edges of 0.05 m
JACOBI = {"preconditioner": "block_jacobi"}
TIP = np.array([0.062, 0.0, 0.029])  # over it nodes of the block are at least 0.02 m away
OBSTACLES = {
    "corner": {"shape": "box", "size": [0.1, 0.1, 0.1]},
    "edge": {"shape": "box", "size": [0.002, 0.1, 4]},
    "rod": {"shape": "capsule", "radius": 0.002, "length": 4},
    "ball": {"shape": "sphere", "radius": 0.005},
}
POSES = {  # the highest point of each is at TIP
    "corner": {"rotate": [45, 0, 35.264389682754654], "translate": [0.062, -0.05 * 3**0.5, 0.029]},
    "edge": {"translate": [0.062, -0.05, 0.029], "rotate": [0, 20, 0]},
    "rod": {"translate": [0.062, -0.002, 0.029], "rotate": [90, 20, 0]},
    "ball": {"translate": [0.062, -0.005, 0.029]},
}


def obstacle(name: str) -> dict:
    return {"name": name, "friction": 0.5, "pose": POSES[name]} | OBSTACLES[name]


def contains(sim: Simulation, p: np.ndarray) -> bool:
    """Whether a point is in an element of the block."""
    corners = sim.world.x[sim.world.bodies[0].tets]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    weights = np.einsum("tij,tj->ti", np.linalg.inv(edges), p - corners[:, 0])
    return bool(((weights > 0).all(axis=1) & (weights.sum(axis=1) < 1)).any())


def tops(name: str) -> np.ndarray:
    """Points of the obstacle just under its surface, on its highest part near the block."""
    if name not in ("edge", "rod"):
        return TIP[None] - [0, 1e-9, 0]
    along = np.array([np.sin(np.radians(20)), 0, np.cos(np.radians(20))])
    return TIP - [0, 1e-9, 0] + np.linspace(-0.2, 0.2, 81)[:, None] * along


def check(sim: Simulation, name: str) -> None:
    inside = [p for p in tops(name) if contains(sim, p)]
    assert not inside, inside


@pytest.mark.parametrize("name", OBSTACLES)
@pytest.mark.parametrize("dt", [0.005, 1 / 60, 0.03])
@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
def test_nothing_passes_between_nodes(name, speed, dt):
    hard = SMALL | {"young": 3e5 * max(1, speed / 10) ** 2}  # so that elements are not turned inside out
    sim = over(obstacle(name), velocity=(0.1 * speed, -speed, 0.05 * speed), dt=dt, at=(0, 0.05, 0), **hard)
    assert not contains(sim, TIP)
    touched = False
    for _ in range(int(0.05 / speed / dt) + 12):
        sim.engine.run(1)
        check(sim, name)
        touched = touched or sim.engine.records()["contacts"].any()
    assert touched and np.isfinite(sim.world.v).all()


@pytest.mark.parametrize("name", OBSTACLES)
@pytest.mark.parametrize("speed", [3.0, 30.0])
def test_nothing_passes_that_comes_from_below(name, speed):
    """The obstacle flies, by keyframes."""
    pose, stop = POSES[name], 0.15 / speed
    low = [p - q for p, q in zip(pose["translate"], (0, 0.1, 0), strict=True)]
    keys = [{"time": 0, "translate": low}, {"time": stop, "translate": [low[0], low[1] + 0.15, low[2]]}]
    keys = [key | {"rotate": pose.get("rotate", [0, 0, 0])} for key in keys]
    table = {"name": name, "friction": 0.5, "keyframes": keys} | OBSTACLES[name]
    sim = over(table, gravity=(0, 0, 0), dt=0.01, at=(0, 0.02, 0), **SMALL)
    for _ in range(int(stop / 0.01) + 5):
        sim.engine.run(1)
        height = sim.contact.contact_input().obstacles.end[0, 1] - pose["translate"][1]
        assert not [p for p in tops(name) if contains(sim, p + np.array([0, height, 0]))]


@pytest.mark.parametrize("name", ["corner", "ball", "rod", "edge"])
def test_a_block_that_rests_on_a_spike_between_guides_carries_its_weight_there(name):
    """Walls of planes keep it upright."""
    walls = [
        {"name": f"wall{k}", "shape": "plane", "friction": 0, "pose": {"rotate": turn, "translate": at}}
        for k, (turn, at) in enumerate([
            ([0, 0, -90], [-D, 0, 0]), ([0, 0, 90], [0.1 + D, 0, 0]),
            ([90, 0, 0], [0, 0, -D]), ([-90, 0, 0], [0, 0, 0.1 + D]),
        ])
    ]  # fmt: skip
    sim = over(obstacle(name), *walls, at=(0, D, 0), contact={"thickness": D}, **SMALL)
    Driver(sim).advance(200)
    check(sim, name)
    sim.engine.run(1)
    _, forces = sim.engine.records_and_reactions()
    weight = sim.world.mass.sum() * 9.81
    assert abs(sim.world.v).max() < 1e-3
    assert -forces[-1, 0, 1] == pytest.approx(weight, rel=1e-2)
    rows = Rows.of(sim)
    assert (rows.corner[:, 3] == -1).all() and (rows.corner[:, 1] >= 0).any()


def test_where_nothing_small_is_near_no_triangle_has_a_row():
    """A block on a table: its corners are enough."""
    table = {"name": "table", "shape": "box", "size": [1, 0.1, 1], "pose": {"translate": [0, -0.05, 0]}}
    sim = over(table, at=(0, D, 0), velocity=(0.2, 0, 0))
    given, faces = sim.contact.contact_input(), sim.contact.contact_input().faces
    for _ in range(60):
        sim.engine.run(1)
        assert (given.obstacle[faces.start[0] : faces.start[-1]] == -1).all()
    assert (given.force > 0).any()


def test_an_object_that_begins_on_a_spike_is_told(caplog):
    with caplog.at_level(logging.WARNING):
        over(obstacle("corner"), at=(0, -0.02, 0), **SMALL)
    said = [r.getMessage() for r in caplog.records if "between its nodes" in r.getMessage()]
    assert len(said) == 1 and "object 'bar' begins inside obstacle 'corner' between its nodes: 0.0" in said[0]
    caplog.clear()
    over(obstacle("corner"), at=(0, 0.001, 0), **SMALL)
    assert not caplog.records


def test_planes_need_no_rows_of_triangles_at_all():
    assert over().contact.contact_input().faces is None


def test_obstacles_with_triangles_far_away_change_nothing_to_the_bit():
    """A ball far from a block over a floor, and none."""

    def ends(*obstacles: dict) -> np.ndarray:
        floor = {"name": "floor", "shape": "plane", "friction": 0.5}
        sim = over(floor, *obstacles, at=(0, 0.05, 0), rotate=(30, 20, 40), velocity=(0, -3, 0))
        sim.engine.run(40)
        return sim.world.x

    ball = {"name": "ball", "shape": "sphere", "radius": 0.01, "friction": 0.5, "pose": {"translate": [9, 0, 0]}}
    assert np.array_equal(ends(), ends(ball))


def test_a_triangle_row_is_joined_to_its_corners_by_weights_of_its_nearest_point():
    sim = over(obstacle("ball"), at=(0, 0.5 * D, 0), **SMALL)
    sim.engine.assemble()
    given = sim.contact.contact_input()
    first, last = given.faces.start[[0, -1]]
    used = [r for r in range(first, last) if given.obstacle[r] >= 0]
    assert len(used) == 1
    row, triangle = used[0], given.faces.triangle[used[0] - first]
    assert given.corner[row].tolist() == [*triangle, -1]
    above = TIP + np.array([0, 0.5 * D, 0])
    assert given.weight[row, :3] @ sim.world.x[triangle] == pytest.approx(above, abs=1e-9)
    assert given.gap[row] == pytest.approx(0.5 * D) and given.normal[row] == pytest.approx([0, 1, 0], abs=1e-9)
    assert given.thickness[row] == D and given.entry[row] == 0
    sites = given.corner[: given.body_start[-1] : 2, 0].tolist()
    stiffness = [given.stiffness[2 * sites.index(n)] for n in triangle]
    assert given.stiffness[row] == pytest.approx(given.weight[row, :3] @ stiffness)
    assert triangle.tolist() in surface_triangles(sim.world.bodies[0].mesh.tets).tolist()


def test_sweeps_know_gravity_wherever_the_scene_lists_it() -> None:
    given = table()
    given["effects"] = dict(reversed(given["effects"].items()))
    assert list(given["effects"]) == ["contact", "gravity"]
    contact = Simulation(Scene.model_validate(given)).contact
    assert contact is not None
    faces = contact.contact_input().faces
    assert faces is not None and faces.gravity.tolist() == [0, -9.81, 0]
