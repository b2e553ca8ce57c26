# SPDX-License-Identifier: MIT
"""Obstacles with a cutting edge: what it sweeps is removed, beside the steps."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sim_server.mechanics.cut_shapes import met_by_blade
from sim_server.mechanics.removal import removed_from
from sim_server.scene.model import Scene
from sim_server.scene.pose import Pose, quaternion, turned
from sim_server.service.blades import Blades
from sim_server.simulation import Simulation
from tests.cutting.cut_scenes import table

DT, SPEED = 0.02, 1.0
BLADE = {
    "name": "scalpel", "shape": "box", "size": [0.01, 0.2, 0.5], "moved": "client", "max_speed": SPEED,
    "edge": [[0, -0.15, -0.4], [0, -0.15, 0.4]], "pose": {"translate": [1.05, 0.8, 0.25]},
}  # fmt: skip


def made(device: str = "cpu", **blade: Any) -> Simulation:
    """A bar along x, 0.5 m high, under a blade; nothing pulls at it."""
    given = table(own={"corotational": {"young": 2e6, "poisson": 0.3}}, effects={"contact": {"between": False}})
    given["solver"] = {"preconditioner": "block_jacobi"}
    return Simulation(Scene.model_validate(given | {"obstacle": [BLADE | blade]}, context={"folder": "."}), device)


def removed(sim: Simulation) -> list[int]:
    return removed_from(sim.parameters.scene, sim.world.bodies[0]).tolist()


def met(sim: Simulation, rest: np.ndarray) -> np.ndarray:
    """Elements that the edge sweeps as it goes down to 0.3 m."""
    swept = np.array([[1.05, 0.65, -0.15], [1.05, 0.65, 0.65], [1.05, 0.3, 0.65], [1.05, 0.3, -0.15]])
    body = sim.world.bodies[0]
    return met_by_blade(rest[body.nodes], body.mesh.tets, swept)


def advance(sim: Simulation, looks: Blades, steps: int, batch: int = 1) -> None:
    for _ in range(steps // batch):
        sim.engine.run(batch)
        looks.due = 0.0  # whatever the clock says
        looks.look()


@pytest.mark.parametrize("batch", [1, 5])
def test_an_edge_that_a_client_moves_removes_what_it_sweeps(batch):
    sim = made()
    looks = Blades(sim)
    advance(sim, looks, 10, batch)
    assert removed(sim) == []
    sim.contact.move("scalpel", (1.05, 0.45, 0.25), (1, 0, 0, 0))
    rest = sim.world.x.copy()
    advance(sim, looks, 30, batch)
    found = removed(sim)
    assert len(found) >= 6 and found == met(sim, rest).tolist()
    sim.contact.move("scalpel", (1.05, 0.8, 0.25), (1, 0, 0, 0))
    advance(sim, looks, 30, batch)
    assert set(found) <= set(removed(sim))
    assert (sim.fetch().x[:, 1] > -0.5).all() and (sim.engine.records()["status"] == 0).all()


def test_it_cuts_where_it_comes_to_rest_between_two_elements():
    """Less than half an element further than it cut last."""
    sim = made(edge=[[0, -0.15, -0.4], [0, -0.15, 0.4]])
    looks = Blades(sim)
    sim.contact.move("scalpel", (1.05, 0.64, 0.25), (1, 0, 0, 0))
    advance(sim, looks, 20)
    assert removed(sim), "its edge is 1 cm below the upper side"


def test_a_reset_brings_it_back_without_a_cut():
    sim = made()
    looks = Blades(sim)
    advance(sim, looks, 1)
    sim.contact.move("scalpel", (1.05, 0.7, 0.25), (1, 0, 0, 0))
    advance(sim, looks, 10)
    sim.contact.move("scalpel", (-1.0, 0.2, 0.25), (1, 0, 0, 0))
    sim.engine.run(2)
    sim.contact.restart([0], sim.engine.step * DT)
    looks.restart()
    advance(sim, looks, 5)
    assert removed(sim) == []


def test_keyframes_move_an_edge_too():
    frames = [{"time": 0, "translate": [1.05, 0.8, 0.25]}, {"time": 0.4, "translate": [1.05, 0.45, 0.25]}]
    sim = made(moved=None, max_speed=None, pose={}, keyframes=frames)
    looks = Blades(sim)
    rest = sim.world.x.copy()
    advance(sim, looks, 30)
    assert removed(sim) == met(sim, rest).tolist()


def test_points_turn_with_the_pose():
    rotation = np.array(quaternion(Pose(rotate=(0.0, 0.0, 90.0)).rotate))
    np.testing.assert_allclose(
        turned(np.array([[1.0, 0, 0], [0, 2, 3]]), rotation), [[0, 1, 0], [-2, 0, 3]], atol=1e-12
    )


@pytest.mark.parametrize(
    ("blade", "why"),
    [
        ({"moved": None, "max_speed": None}, "an obstacle cuts as it moves"),
        ({"edge": [[0, 0, 0], [0, 0, 0]]}, "the same point"),
        ({"edge": [[0, 0, 0]]}, "edge"),
        ({"edge": [[0, 0, float("nan")], [0, 0, 1]]}, "finite"),
    ],
)
def test_edges_that_cannot_cut_are_refused(blade, why):
    with pytest.raises(ValidationError, match=why):
        made(**blade)


def test_an_edge_without_an_object_to_cut_is_refused():
    given = table(effects={"contact": {"between": False}}) | {"obstacle": [BLADE]}
    del given["object"][0]["effects"]["cutting"]
    with pytest.raises(ValidationError, match="no object lists cutting = true"):
        Scene.model_validate(given, context={"folder": "."})
