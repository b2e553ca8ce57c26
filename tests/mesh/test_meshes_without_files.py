# SPDX-License-Identifier: MIT
"""Meshes of arrays and of shapes: a scene holds them, and with it logs, replays and whoever reads it again."""

import json
import logging
from pathlib import Path

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import bar
from sim_server.mesh.arrays import mesh_of, packed, unpacked
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from sim_server.scene import Scene, load, where
from sim_server.simulation import Simulation
from sim_server.updates.worker_assembly import Assembly

BOX = bar([3, 1, 1], [3.0, 1.0, 1.0])
LEFT, AT_END = BOX.centroids[:, 0] < 1.5, BOX.rest[:, 0] == 0
GROUPS = {"tumour": LEFT, "end": {"nodes": np.flatnonzero(AT_END)}}
STEPS = 4


def table(mesh: object) -> dict:
    """A scene of one object that is held at the group "end"."""
    effects = {"corotational": {"young": [{"group": "tumour", "young": 2e4}, {"young": 1e4}], "poisson": 0.3},
               "fixed": {"group": "end"}}  # fmt: skip
    made = {"name": "a", "mesh": mesh, "effects": effects, "elements": "linear", "pose": {"rotate": [10, 20, 30]}}
    return {"name": "test", "dt": 0.02, "effects": {"gravity": True}, "solver": {"preconditioner": "block_jacobi"},
            "object": [made]}  # fmt: skip


def record(sim: Simulation, path: Path) -> None:
    """Makes steps with a log."""
    with Recorder(path) as recorder:
        recorder.scene(messages.scene(sim))
        body = sim.world.bodies[0]
        recorder.topology(messages.topology(sim, body))
        recorder.state(messages.state(body, 0, 0.0, sim.world.x, sim.world.v), block=True)
        sim.engine.run(STEPS)
        for step in messages.steps(sim, sim.engine.records()):
            recorder.step(step, block=True)
        world = sim.fetch()
        recorder.state(messages.state(body, STEPS, STEPS * 0.02, world.x, world.v), block=True)


def repeat(path: Path) -> None:
    """Makes the steps of a log again, and compares them."""
    with Recording(path) as recording:
        found = Replay(recording).run()
    assert found.same and found.solves_compared == STEPS, found.lines()


def test_a_scene_of_arrays_is_logged_and_repeated_to_the_bit(tmp_path):
    scene = Scene.model_validate(table({"points": BOX.rest, "tets": BOX.tets, "groups": GROUPS}))
    assert Scene.model_validate(json.loads(json.dumps(scene.resolved()))).resolved() == scene.resolved()
    sim = Simulation(scene)
    assert np.array_equal(sim.effects["corotational"].elastic[0][0], np.where(LEFT, 2e4, 1e4))
    assert np.array_equal(sim.world.free == 0, AT_END)
    sent, topology = messages.published(messages.scene(sim)), messages.topology(sim, sim.world.bodies[0])
    assert len(sent.resolved) < len(messages.scene(sim).resolved) - 200  # the topology has the mesh
    sim.engine.assemble()
    same = Assembly(sent, topology).matrix(sim.world.x.copy())
    assert same.tobytes() == sim.system.values.tobytes()
    record(sim, tmp_path / "run.mcap")
    repeat(tmp_path / "run.mcap")


def test_a_mesh_stands_for_itself_and_its_text_keeps_all_of_it():
    quadratic = mesh_of(BOX.rest, BOX.tets, GROUPS, "liver").with_mid_nodes()
    for mesh in (mesh_of(BOX.rest, BOX.tets, {**GROUPS, "face": {"faces": [[0, 4, 1]]}}, "liver"), quadratic):
        again = Scene.model_validate(table(mesh)).objects[0].load_mesh()
        assert again.name == "liver" and packed(again) == packed(mesh)
        assert np.array_equal(again.rest, mesh.rest) and np.array_equal(again.tets, mesh.tets)
        for name in mesh.groups:
            assert np.array_equal(again.nodes_of(name), mesh.nodes_of(name))
    assert again.quadratic is not None and np.array_equal(again.elements_of("tumour"), np.repeat(LEFT, 8))
    given = mesh_of(again.rest, again.quadratic, {"tumour": LEFT})
    assert np.array_equal(given.tets, again.tets) and np.array_equal(given.elements_of("tumour"), np.repeat(LEFT, 8))


def test_lists_in_a_scene_file_are_arrays(tmp_path):
    text = 'dt = 0.1\n[[object]]\nname = "a"\n[object.mesh]\npoints = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]\n'
    text += "tets = [[0, 1, 3, 2]]\ngroups = { one = [0], top = { nodes = [3] } }\n"
    (tmp_path / "scene.toml").write_text(text)
    mesh = load(tmp_path / "scene.toml").objects[0].load_mesh()
    assert mesh.tets.tolist() == [[0, 1, 2, 3]]  # wound to positive volume
    assert where.nodes('group("top")', mesh).tolist() == [False, False, False, True]


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        ({"points": BOX.rest}, "needs points and tets, not points"),
        ({"points": BOX.rest, "tets": BOX.tets, "scale": 2.0}, "points and tets stand alone, without scale"),
        ({"points": BOX.rest[:, :2], "tets": BOX.tets}, "node coordinates have shape (16, 2): must be (n, 3)"),
        ({"points": BOX.rest, "tets": BOX.tets + 1}, "node numbers must be 0 to 15"),
        ({"points": BOX.rest, "tets": BOX.tets.astype(float)}, "must be whole numbers of nodes (m, 4) or (e, 10)"),
        ({"points": BOX.rest * np.nan, "tets": BOX.tets}, "coordinates are not finite"),
        ({"points": np.r_[BOX.rest, [[9, 9, 9]]], "tets": BOX.tets}, "node 16 (at (9, 9, 9)): belongs to no tetrahed"),
        ({"points": BOX.rest, "tets": BOX.tets, "groups": {"a": [18]}}, "group 'a' of shape (1,) and type int64: runs"),
        ({"points": BOX.rest, "tets": BOX.tets, "groups": {"a": {"cells": [1]}}}, "allowed: elements, faces, nodes"),
        ({"points": BOX.rest, "tets": BOX.tets, "groups": {"a": {"nodes": [True]}}}, "numbers (k,), or 16 bool"),
        ({"surface": __file__}, "surface = ..., edge = m"),
        ({"sdf": {"sphere": {"radius": 1.0}, "smooth": 1.0}, "edge": 0.1}, "smooth belongs to a union"),
        ({"sdf": {}, "edge": 0.1}, "must be one of sphere, box, capsule, union, not none"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_is_refused(mesh, words):
    with pytest.raises(ValueError) as error:
        Scene.model_validate(table(mesh))
    assert words in str(error.value), str(error.value)


@pytest.mark.parametrize("text", ["", "????", "AAAA", packed(BOX)[:-40] + "A" * 40])
def test_text_that_holds_no_mesh_is_refused(text):
    with pytest.raises(InputError, match="data that holds no mesh"):
        unpacked(text)


def test_a_scene_of_shapes_needs_no_file(tmp_path):
    sdf = {"union": [{"sphere": {"radius": 0.5}}, {"capsule": {"begin": [0, 0, 0], "end": [1, 0, 0], "radius": 0.3}}]}
    made = table({"sdf": {**sdf, "smooth": 0.2}, "edge": 0.25})
    made["object"][0]["effects"] = {"corotational": {"young": 1e4, "poisson": 0.3}, "fixed": {"where": "X < -0.3"}}
    scene = Scene.model_validate(made)
    sim = Simulation(scene)
    record(sim, tmp_path / "run.mcap")
    assert Scene.model_validate(scene.resolved()).resolved() == scene.resolved()
    repeat(tmp_path / "run.mcap")


def test_a_body_as_large_as_one_in_millimetres_is_asked_about(tmp_path, caplog):
    meshio.Mesh(100 * BOX.rest, [("tetra", BOX.tets)]).write(tmp_path / "liver.vtk")
    with caplog.at_level(logging.WARNING):
        for scale in ("", ", scale = 1.0", ", scale = 0.001"):
            text = f'dt = 0.1\n[[object]]\nname = "a"\nmesh = {{ file = "liver.vtk"{scale} }}\n'
            (tmp_path / "scene.toml").write_text(text)
            load(tmp_path / "scene.toml").objects[0].load_mesh()
    (said,) = [r.getMessage() for r in caplog.records]
    assert said.startswith("mesh liver.vtk: its size is 300 x 100 x 100 m. Is the file in mm? Then mesh.scale = 0.001")
