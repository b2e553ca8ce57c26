# SPDX-License-Identifier: MIT
"""What is said of a scene that is legal but perhaps not meant so."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.scene.model import Scene
from sim_server.service.scene_notes import connected_parts, scene_notes
from sim_server.simulation import Simulation
from tests.scenes import bar, jittered_bar, mesh_file, simulation

GRAVITY = (0, -9.81, 0)
SCENES = Path(__file__).parents[2] / "deploy" / "scenes"
FALLING = "without fixed nodes: in free fall under gravity"


def small(name: str, **table) -> dict:
    return bar((1, 1, 1), (1, 1, 1), name=name, **table)


@pytest.mark.parametrize("scene", sorted(SCENES.glob("*.toml")), ids=lambda path: path.name)
def test_nothing_is_said_of_the_scenes_that_come_along(scene):
    assert scene_notes(Simulation.load(scene)) == []


def test_free_fall_is_said_once_for_all_bodies():
    bodies = [small(f"b{k}") for k in range(5)]
    assert scene_notes(simulation(*bodies, gravity=GRAVITY)) == [f"objects 'b0', 'b1', 'b2' and 2 more {FALLING}"]
    assert scene_notes(simulation(small("a", touch={}), gravity=GRAVITY)) == [f"object 'a' {FALLING}"]
    assert scene_notes(simulation(*bodies)) == []  # nothing pulls
    assert scene_notes(simulation(small("a", fixed="X < 0.1"), gravity=GRAVITY)) == []


def test_nothing_is_said_of_bodies_that_fall_onto_an_obstacle():
    effects = {"gravity": {"g": list(GRAVITY)}, "contact": {}}
    floor = {"name": "floor", "shape": "plane"}
    table = {"name": "test", "dt": 0.02, "effects": effects, "object": [small("a")], "obstacle": [floor]}
    assert scene_notes(Simulation(Scene.model_validate(table, context={"folder": "."}))) == []


def test_a_body_without_elasticity_is_said():
    assert scene_notes(simulation(small("a", young=None), small("b"), gravity=GRAVITY)) == [
        f"object 'a' without elasticity: each node moves by itself; object 'b' {FALLING}"
    ]
    assert scene_notes(simulation(small("a", young=None, fixed="X < 0.1"))) == [
        "object 'a' without elasticity: each node moves by itself"
    ]


def test_springs_hold_a_part_that_tetrahedra_leave_loose(tmp_path):
    rest, tets = jittered_bar((1, 1, 1), (1, 1, 1), seed=0)
    two = np.concatenate([rest, rest + np.array([3.0, 0, 0])]), np.concatenate([tets, tets + len(rest)])
    body = bar(mesh=mesh_file(tmp_path, *two), name="a", fixed="X < 0.01")
    assert scene_notes(simulation(body, gravity=GRAVITY)) == [
        "object 'a' with parts that no element connects to a fixed node: these fall"
    ]
    body["effects"]["mass_spring"] = {"springs": [[0, len(rest)]], "stiffness": 10.0}
    assert scene_notes(simulation(body, gravity=GRAVITY)) == []


def test_nearly_incompressible_materials_are_said():
    [line] = scene_notes(simulation(small("a", poisson=0.4999)))
    assert "lock" in line
    lines = scene_notes(simulation(small("a", poisson=0.3), small("b", poisson=0.49999999)))
    assert len(lines) == 2 and lines[0].startswith("object 'b' with a Poisson's ratio of 0.49999999: above 0.4999")
    assert lines[1].startswith("object 'b' with a Poisson's ratio of 0.49999999 and linear tetrahedra")


@pytest.mark.parametrize("pairs", [0, 50, 150, 400])
def test_parts_are_those_of_scipy(pairs):
    """By the names of their lowest nodes."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    nodes = 200
    ends = np.random.default_rng(pairs).integers(0, nodes, (pairs, 2), dtype=np.int32)
    chain = np.stack([np.arange(149, 100, -1), np.arange(148, 99, -1)], axis=1, dtype=np.int32)
    ends = np.concatenate([ends, chain])
    count, part = connected_components(coo_array((np.ones(len(ends)), ends.T), shape=(nodes, nodes)), directed=False)
    lowest = np.array([np.flatnonzero(part == k)[0] for k in range(count)])
    assert np.array_equal(connected_parts(nodes, ends), lowest[part])
