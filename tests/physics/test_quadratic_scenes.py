# SPDX-License-Identifier: MIT
"""Quadratic bodies in scenes: workers, contact, skins, pushes and grabs, holders, frames for viewers."""

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from clients.log.frames import mesh_of
from clients.log.von_mises import StressField
from protocol.refused import Refused
from sim_server.mesh.surface import surface_triangles
from sim_server.recording import messages
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.worker_assembly import Assembly
from tests.contact.scenes import LOCKSTEP
from tests.mesh.test_quadratic_mesh import jittered
from tests.scenes import bar

POSE = {"translate": [0.1, 0.05, -0.2], "rotate": [0, 30, 90]}
FLOOR = {"name": "floor", "shape": "plane"}


def made(folder: Path, *, solver: dict | None = None, effects: dict | None = None, **table: Any) -> Simulation:
    """A body of curved elements, 0.3 m x 0.2 m x 0.2 m, in a file of gmsh."""
    mesh = jittered((3, 2, 2), curved=0.05)
    meshio.write(folder / "q.msh", meshio.Mesh(mesh.rest, [("tetra10", mesh.quadratic)]), "gmsh")
    regions = [{"where": "X < 0.15", "young": 1e5}, {"young": 3e5}]
    body = {"name": "a", "mesh": {"file": "q.msh", "scale": 0.1}} | table.pop("object", {})
    body["effects"] = {"corotational": {"young": regions, "poisson": 0.45}, "touch": True} | (effects or {})
    scene = {"name": "test", "dt": 0.01, "effects": {"gravity": True}, "object": [body]} | table
    scene["solver"] = {"preconditioner": "block_jacobi"} | (solver or {})
    return Simulation(Scene.model_validate(scene, context={"folder": str(folder)}))


def test_workers_assemble_the_matrix_of_a_mesh_that_is_posed(tmp_path):
    sim = made(tmp_path, object={"pose": POSE}, effects={"fixed": {"where": "X < 0.01"}})
    message = messages.topology(sim, sim.world.bodies[0])
    built = Assembly(messages.scene(sim), message)
    sim.world.x += 0.005 * np.random.default_rng(1).normal(size=sim.world.x.shape)
    sim.engine.assemble()
    assert built.matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()


@pytest.mark.parametrize("spoil", ["beyond", "cut", "none"])
def test_workers_refuse_elements_that_do_not_fit(tmp_path, spoil):
    sim = made(tmp_path)
    message = messages.topology(sim, sim.world.bodies[0])
    elements = sim.world.bodies[0].mesh.quadratic.copy()
    elements[3, 5] = len(sim.world.rest)
    message.quadratic = {"beyond": elements.tobytes(), "cut": message.quadratic[:-4], "none": b""}[spoil]
    with pytest.raises(Refused):
        Assembly(messages.scene(sim), message)


def test_a_bar_lies_on_the_floor_on_all_nodes_of_a_face():
    """Their forces sum to its weight; a quadratic face of a body in equilibrium hangs on its mid-nodes."""
    table = bar((3, 2, 2), (0.3, 0.2, 0.2), elements="quadratic", poisson=0.45, pose={"translate": [0, 0.004, 0]})
    table["effects"]["rayleigh"] = {"mass": 2.0, "stiffness": 0.01}
    effects = {"gravity": True, "contact": True}
    given = {"name": "test", "dt": 0.01, "effects": effects, "object": [table], "obstacle": [FLOOR], "solver": LOCKSTEP}
    sim = Simulation(Scene.model_validate(given, context={"folder": "."}))
    driver = Driver(sim)
    assert (driver.advance(150)["status"] == 0).all()
    driver.advance(1)
    weight = 9.81 * sim.world.mass.sum()
    assert -driver.reactions[0, 0, 1] == pytest.approx(weight, rel=1e-4)
    rows = sim.contact.contact_input()
    closed = rows.corner[rows.force > 0, 0]
    corners = sim.world.bodies[0].mesh.quadratic[:, :4]
    below = np.flatnonzero(sim.world.rest[:, 1] == 0)
    assert len(below) == 35 and np.isin(closed, below).all()
    assert (~np.isin(closed, corners)).sum() == (~np.isin(below, corners)).sum()
    assert abs(sim.world.v).max() < 1e-6 and sim.world.x[:, 1].min() > 0


def test_nodes_on_edges_are_pushed_and_held(tmp_path):
    """The force of a holder of a face is what the push and the weight of the body make."""
    holder = {"name": "end", "object": "a", "where": "X < 0.001"}
    sim = made(tmp_path, holder=[holder], solver=LOCKSTEP, effects={"rayleigh": {"mass": 5.0, "stiffness": 0.02}})
    mesh, held = sim.world.bodies[0].mesh, np.flatnonzero(sim.world.held)
    assert np.array_equal(held, np.flatnonzero(mesh.rest[:, 0] < 0.001)) and np.isin(held, mesh.quadratic[:, 4:]).any()
    middle = int(mesh.quadratic[mesh.rest[mesh.quadratic[:, :4], 0].max(axis=1).argmax(), 9])
    push = sim.touch.push("anna", "a", tuple(sim.world.x[middle]), 0.0, (0.0, 2.0, 1.0), np.inf)
    assert push.nodes.tolist() == [middle]
    driver = Driver(sim)
    driver.advance(300)
    weight = 9.81 * sim.world.mass.sum()
    assert np.abs(sim.world.v).max() < 1e-4
    assert np.allclose(driver.reactions[-1, -1, :3], [0, 2 - weight, 1], atol=1e-5 * weight)
    assert np.array_equal(sim.world.x[held], mesh.rest[held])


def test_a_skin_of_the_surface_moves_with_it(tmp_path):
    mesh = jittered((3, 2, 2), curved=0.05)
    meshio.write(tmp_path / "skin.obj", meshio.Mesh(mesh.rest, [("triangle", surface_triangles(mesh.tets))]))
    sim = made(tmp_path, object={"skin": "skin.obj"})
    body = sim.world.bodies[0]
    used = np.unique(surface_triangles(body.mesh.tets))
    x = body.mesh.rest + 0.01 * np.random.default_rng(2).normal(size=body.mesh.rest.shape)
    assert np.allclose(np.einsum("sc,scd->sd", body.skin.weights, x[body.skin.nodes]), x[used], atol=1e-8)


def test_viewers_get_tetrahedra_with_the_stress_of_a_linear_motion(tmp_path):
    sim = made(tmp_path)
    message = messages.topology(sim, sim.world.bodies[0])
    mesh = mesh_of(message)
    assert len(mesh.tets) == len(mesh.young) == 8 * len(message.quadratic) // 40
    assert all(len(set(part)) == 1 for part in mesh.young.reshape(-1, 8).tolist())
    stress = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson).tets(mesh.rest * [1, 1, 1.1])
    assert np.allclose(stress, mesh.young / (1 + mesh.poisson) * 0.1, rtol=1e-5)
