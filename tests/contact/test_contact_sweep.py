# SPDX-License-Identifier: MIT
"""No surface node passes an obstacle, at any speed, however thin the obstacle and however long the step."""

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.contact.scenes import D, block, floor, over, thrust

SMALL = {"cells": (2, 2, 2), "size": (0.1, 0.1, 0.1), "young": 3e5}


def surface(sim: Simulation) -> np.ndarray:
    given = sim.contact.contact_input()
    nodes: np.ndarray = sim.world.x[np.unique(given.corner[: given.body_start[-1], 0])]
    return nodes


def plate(thickness: float, **table) -> dict:
    return {
        "name": "plate",
        "shape": "box",
        "size": [4, thickness, 4],
        "pose": {"translate": [0, -thickness / 2, 0]},
    } | table


@pytest.mark.parametrize("dt", [0.005, 1 / 60, 0.03])
@pytest.mark.parametrize("speed", [1.0, 3.0, 10.0, 30.0, 100.0])
@pytest.mark.parametrize("thin", [0.002, 0.02])
def test_plates(thin, speed, dt):
    sim = over(plate(thin), velocity=(0.2 * speed, -speed, 0), dt=dt, at=(0, 0.05, 0), **SMALL)
    steps = int(0.05 / speed / dt) + 15
    for _ in range(steps):
        sim.engine.run(1)
        assert (surface(sim)[:, 1] > 0).all()
    assert np.isfinite(sim.world.v).all()


@pytest.mark.parametrize("dt", [0.005, 0.03])
@pytest.mark.parametrize("speed", [3.0, 30.0, 100.0])
def test_a_plate_that_comes_to_the_block(speed, dt):
    """Swung by keyframes, and turned meanwhile."""
    stop = 0.2 / speed
    keys = [{"time": 0, "translate": [0, -0.1, 0]}, {"time": stop, "translate": [0, 0.1, 0], "rotate": [0, 0, 8]}]
    table = plate(0.002, keyframes=keys)
    del table["pose"]
    sim = over(table, dt=dt, at=(0, 0.02, 0), gravity=(0, 0, 0), **SMALL)
    rows = sim.contact.contact_input()
    for _ in range(int(stop / dt) + 5):
        sim.engine.run(1)
        x, y, z, w, *q = rows.obstacles.end[0]
        normal = 2 * (np.cross(q, np.cross(q, [0, 1, 0]) + w * np.array([0, 1, 0]))) + [0, 1, 0]
        assert ((surface(sim) - [x, y, z]) @ normal > 0.001).all()


@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
def test_a_sphere_and_a_capsule(speed):
    shapes = [
        {"name": "ball", "shape": "sphere", "radius": 0.05, "pose": {"translate": [0.05, -0.06, 0.05]}},
        {"name": "rod", "shape": "capsule", "radius": 0.02, "length": 1,
         "pose": {"translate": [0, -0.3, 0.05], "rotate": [90, 0, 0]}},
    ]  # fmt: skip
    sim = over(*shapes, velocity=(0, -speed, 0), at=(0, 0, 0), **SMALL)
    for _ in range(40):
        sim.engine.run(1)
        x = surface(sim)
        assert (np.linalg.norm(x - [0.05, -0.06, 0.05], axis=1) > 0.05).all()
        assert (np.linalg.norm((x - [0, -0.3, 0])[:, :2], axis=1)[abs(x[:, 2] - 0.05) < 0.5] > 0.02).all()


def test_what_is_clipped_is_counted_and_stays_outside():
    """Passes that are too few to stop it."""
    sim = over(
        plate(0.002), velocity=(0, -100, 0), at=(0, 0.05, 0),
        contact={"thickness": D, "passes": 1, "stiffness": 0.01}, **SMALL,
    )  # fmt: skip
    sim.engine.run(5)
    records = sim.engine.records()
    assert records["clipped"].any()
    assert (surface(sim)[:, 1] > 0).all()


def test_a_block_that_a_ball_is_thrust_through_stays_on_the_floor_and_comes_back():
    """The ball ends below the floor, and has no place in front of both for what it takes along."""
    sim = over(floor(), thrust(), cells=(3, 3, 3), size=(0.1, 0.1, 0.1), young=1e5, dt=0.01, at=(0, 0.006, 0))
    records = []
    for _ in range(10):
        sim.engine.run(1)
        records.append(sim.engine.records()[0])
        assert (surface(sim)[:, 1] > 0).all()
    assert 0 < records[1]["clipped"] < len(surface(sim)) and not any(r["status"] for r in records[3:])
    x = sim.world.x[sim.world.bodies[0].tets]
    volume, rest = (np.linalg.det(p[:, 1:] - p[:, :1]) for p in (x, sim.world.rest[sim.world.bodies[0].tets]))
    assert (volume > 0.9 * rest).all()


def test_a_node_between_two_plates_that_close():
    keys = [{"time": 0, "translate": [0, 0.1, 0]}, {"time": 1, "translate": [0, 0.062, 0]}]
    lid = {"name": "lid", "shape": "box", "size": [4, 0.02, 4], "keyframes": keys}
    sim = over(plate(0.02), lid, objects=[block(cells=(2, 2, 2), size=(0.1, 0.06, 0.1), at=(0, D, 0))])
    for _ in range(90):
        sim.engine.run(1)
        y = surface(sim)[:, 1]
        top = sim.contact.contact_input().obstacles.end[1, 1] - 0.01
        assert (y > 0).all() and (y < top).all()
    _, forces = sim.engine.records_and_reactions()
    weight = sim.world.mass.sum() * 9.81
    assert forces[-1, 0, 1] + forces[-1, 1, 1] == pytest.approx(-weight, rel=1e-2)
    assert forces[-1, 1, 1] > weight


@pytest.mark.parametrize("away", [0.5, 10.0])
def test_a_plate_that_comes_from_far_away_in_one_step(away):
    dt = 1 / 60
    keys = [{"time": 3 * dt, "translate": [0, -away, 0]}, {"time": 4 * dt, "translate": [0, 0.05, 0]}]
    table = {"name": "plate", "shape": "box", "size": [4, 0.002, 4], "keyframes": keys}
    sim = over(table, at=(0, 0.02, 0), gravity=(0, 0, 0), dt=dt, **SMALL)
    sim.engine.run(4)
    assert (surface(sim)[:, 1] > 0.051).all()


def test_obstacles_far_away_change_nothing_to_the_bit():
    balls = [
        {"name": f"ball{k}", "shape": "sphere", "radius": 0.1, "pose": {"translate": [5 + k, 0, 0]}} for k in range(5)
    ]

    def tumbled(*obstacles: dict) -> np.ndarray:
        sim = over(*obstacles, at=(0, 0.05, 0), rotate=(30, 20, 40), velocity=(0, -3, 0))
        sim.engine.run(40)
        return sim.world.x

    assert np.array_equal(tumbled(plate(0.02)), tumbled(plate(0.02), *balls))
