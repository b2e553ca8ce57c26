# SPDX-License-Identifier: MIT
"""Bodies that touch themselves (kernels/own_surface.cuh, backends/cpu/native/own_contact.h)."""

import logging
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.kinds import KINDS
from sim_server.mesh import bar as bar_mesh
from sim_server.mesh.own_surface import edges_through_triangles, nearby_nodes
from sim_server.mesh.surface import surface_triangles
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.contact.scenes import contact_forces, elastic_forces, floor, fork
from tests.reference.triangles import distances, normals
from tests.scenes import mesh_file
from tests.state import put

EULER = 3  # StepForm in protocol/messages.proto
STATUS = KINDS.enumeration("Status")
EDGE, D = 0.01, 0.001  # of cells; thickness [m]
EXACT = {"preconditioner": "block_jacobi", "tolerance": 1e-11}


def body(mesh: dict, name: str = "body", young: float = 3e5, fixed: str | None = None, **table: Any) -> dict:
    effects: dict[str, Any] = {"corotational": {"young": young, "poisson": 0.3}}
    if fixed:
        effects["fixed"] = {"where": fixed}
    if damping := table.pop("damping", None):
        effects["rayleigh"] = {"mass": damping[0], "stiffness": damping[1]}
    return {"name": name, "mesh": mesh, "elements": "linear", "effects": effects, **table}


def made(
    *objects: dict, gravity: tuple = (0, 0, 0), contact: dict | None = None, solver: dict | None = None,
    dt: float = 1 / 60, device: str = "cpu", **table: Any,
) -> Simulation:  # fmt: skip
    effects = {"gravity": {"g": list(gravity)}, "contact": {"self": True, "thickness": D} | (contact or {})}
    scene = {"name": "test", "dt": dt, "effects": effects, "solver": solver or EXACT, "object": list(objects)} | table
    return Simulation(Scene.model_validate(scene, context={"folder": "."}), device)


def crossings(sim: Simulation) -> int:
    """Number of edges of surfaces that go through triangles that are not nearby, of all bodies."""
    surfaces = sim.contact.contact_input().surfaces
    assert surfaces is not None and surfaces.own
    found = zip(*edges_through_triangles(sim.world.x, surfaces.edge, surfaces.triangle), strict=True)
    start, node = surfaces.own.near_start, surfaces.own.near_node

    def near(edge: int, triangle: int) -> bool:
        return any(
            np.isin(surfaces.triangle[triangle], node[start[p] : start[p + 1]]).any() for p in surfaces.edge[edge]
        )

    return sum(not near(e, t) for e, t in found)


def close(sim: Simulation, speed: float) -> None:
    """Drives the arms of a fork towards each other; its momentum is 0."""
    w, x = sim.world, sim.world.rest
    v = np.zeros_like(w.v)
    v[:, 1] = np.where(x[:, 0] > 2.1 * EDGE, np.where(x[:, 1] > 2.5 * EDGE, -speed, speed), 0)
    put(sim, w.v, v - w.mass @ v / w.mass.sum())


def own_rows(sim: Simulation) -> NDArray[np.integer]:
    """Rows of bodies with themselves."""
    given = sim.contact.contact_input()
    assert given.surfaces is not None
    start, n = given.surfaces.edge_start, int(given.body_start[-1])
    used = np.flatnonzero(given.obstacle[: start[-1]] >= 0)
    return used[used >= start[0] - n]


@pytest.mark.parametrize("speed", [1.0, 10.0, 50.0])
def test_arms_that_are_driven_into_each_other_do_not_pass_and_keep_their_momentum(tmp_path, speed):
    sim = made(body(fork(tmp_path)), contact={"passes": 200})
    close(sim, speed)
    w, size = sim.world, (sim.world.mass * np.linalg.norm(sim.world.v, axis=1)).sum()
    most = 0
    for _ in range(8):
        sim.engine.run(1)
        assert crossings(sim) == 0
        most = max(most, len(own_rows(sim)))
    records = sim.engine.records()
    assert (records["status"] == STATUS["CONVERGED"]).all() and most > 0 and records["contacts"].max() > 0
    assert abs(w.mass @ w.v).max() <= 1e-9 * size
    turning = (w.mass[:, None] * np.cross(w.x, w.v)).sum(axis=0)
    assert abs(turning).max() <= 5e-3 * size * 0.08  # as exact as paths within a step are straight


def test_without_the_key_they_pass(tmp_path):
    sim = made(body(fork(tmp_path)), contact={"self": False}, obstacle=[floor(pose={"translate": [0, -10, 0]})])
    close(sim, 10.0)
    surface = surface_triangles(sim.world.bodies[0].mesh.tets)
    edges = surface[:, :2]
    passed = 0
    for _ in range(4):
        sim.engine.run(1)
        passed += len(edges_through_triangles(sim.world.x, edges, surface)[0])
    assert passed > 0


def test_rows_are_those_of_all_vertices_and_triangles_that_are_not_nearby(tmp_path):
    """Who is nearer than the thickness, in front, at the start of each step."""
    sim = made(body(fork(tmp_path), young=3e4, damping=(5.0, 0.01)))
    close(sim, 2.0)
    given, w = sim.contact.contact_input(), sim.world
    mesh, triangles = w.bodies[0].mesh, surface_triangles(w.bodies[0].mesh.tets)
    start, node = nearby_nodes(mesh.tets, mesh.rest, triangles, 2 * D)
    found = 0
    for _ in range(6):
        sim.engine.assemble()
        rows = own_rows(sim)
        rows = rows[rows < given.surfaces.edge_start[0]]
        got = {int(given.corner[r, 0]) for r in rows if given.gap[r] < 0.999 * D}
        corners, want = w.x[triangles], set()
        for p in np.unique(triangles):
            far = ~np.isin(triangles, node[start[p] : start[p + 1]]).any(axis=1)
            away = distances(np.broadcast_to(w.x[p], (far.sum(), 3)), corners[far])
            side = ((w.x[p] - corners[far][:, 0]) * normals(corners[far])).sum(axis=1)
            if ((away < 0.999 * D) & (side > 0)).any():
                want.add(int(p))
        assert want == got
        found += len(want)
        sim.engine.solve()
    assert found > 10


def test_an_arm_at_rest_on_the_other_one_is_in_balance(tmp_path):
    """Elastic forces (reference), weight and contact add up to nothing at each free node."""
    soft = body(fork(tmp_path), young=4e3, fixed="Y < 0.001", damping=(20.0, 0.0))
    sim = made(soft, gravity=(0, -9.81, 0), contact={"passes": 50, "tolerance": 1e-7}, dt=0.02)
    sim.engine.run(400)
    w, force = sim.world, contact_forces(sim)
    weight = 9.81 * w.mass.sum()
    arm = (w.rest[:, 1] > 3 * EDGE - 1e-6) & (w.rest[:, 0] > 2.1 * EDGE)
    assert abs(w.v).max() < 1e-6 and force[arm, 1].sum() > 0.05 * weight
    assert abs(force.sum(axis=0)).max() < 1e-12 * weight  # each side gets what the other gives
    left = force + elastic_forces(sim, 4e3, 0.3) + w.mass[:, None] * (0, -9.81, 0)
    assert abs(left[w.free > 0]).max() < 1e-4 * weight


def test_a_strip_that_falls_on_itself_comes_to_rest_on_itself():
    pose = {"rotate": [0, 0, 88], "translate": [0, 0.001, 0]}
    strip = body(
        {"bar": [24, 1, 2], "size": [0.24, 0.005, 0.02], "split": "kuhn"}, young=3e3, damping=(4.0, 0.004), pose=pose
    )
    lockstep = {"preconditioner": "cholesky", "update": "lockstep-3"}
    sim = made(strip, gravity=(0, -9.81, 0), dt=0.01, solver=lockstep, obstacle=[floor()])
    for _ in range(20):
        sim.engine.run(20)
        assert crossings(sim) == 0
    given = sim.contact.contact_input()
    assert abs(sim.world.v).max() < 1e-4 and (given.force[own_rows(sim)] > 0).any()


def test_same_motion_with_each_preconditioner(tmp_path):
    mesh, found = fork(tmp_path), []
    for solver in (
        {"preconditioner": "block_jacobi"}, {"preconditioner": "cholesky", "update": "lockstep-3"},
        {"preconditioner": "cholesky", "update": "lockstep-3", "woodbury": 0},
    ):  # fmt: skip
        sim = made(body(mesh), contact={"passes": 200, "tolerance": 1e-8}, solver=solver | {"tolerance": 1e-11})
        close(sim, 1.0)
        sim.engine.run(10)
        found.append(sim.world.x.copy())
    assert max(abs(x - found[0]).max() for x in found[1:]) < 1e-7


@pytest.mark.parametrize("bend", ["rolled", "twisted", "pressed"])
def test_a_thin_body_does_not_detect_its_own_other_side(bend):
    """Bent by three quarters of a circle, twisted by two turns, or to half its length, with the largest thickness."""
    mesh = {"bar": [30, 1, 3], "size": [0.3, 0.01, 0.03], "split": "kuhn"}
    sim = made(body(mesh), contact={"thickness": 0.004})
    w, x = sim.world, sim.world.rest
    if bend == "rolled":
        radius, angle = 0.3 / (1.5 * np.pi), x[:, 0] / 0.3 * 1.5 * np.pi
        moved = np.stack([(radius - x[:, 1]) * np.sin(angle), radius - (radius - x[:, 1]) * np.cos(angle), x[:, 2]], 1)
    elif bend == "twisted":
        a, y, z = x[:, 0] / 0.3 * 4 * np.pi, x[:, 1] - 0.005, x[:, 2] - 0.015
        moved = np.stack([x[:, 0], np.cos(a) * y - np.sin(a) * z, np.sin(a) * y + np.cos(a) * z], 1)
    else:
        moved = x * (0.5, 1.3, 1.3)
    put(sim, w.x, moved)
    sim.engine.assemble()
    assert not len(own_rows(sim))


def test_friction_holds_what_lies_on_itself_and_is_bounded(tmp_path):
    """The traction of a row is at most mu times its normal force; a pair of a body with itself may be named."""
    pairs = [{"between": ["body", "body"], "value": 0.2}]
    sim = made(body(fork(tmp_path)), contact={"friction": pairs})
    close(sim, 3.0)
    put(sim, sim.world.v, sim.world.v + np.where(sim.world.rest[:, 1:2] > 0.025, [0.5, 0, 0.5], 0))
    given, slides = sim.contact.contact_input(), 0
    for _ in range(8):
        sim.engine.run(1)
        rows = own_rows(sim)
        rows = rows[given.force[rows] > 0]
        pull = np.linalg.norm(given.traction[rows], axis=1)
        assert (pull <= 0.2 * given.force[rows] * (1 + 2e-2) + 1e-9).all()
        slides += int((pull > 0.15 * given.force[rows]).sum())
    assert slides


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha", "ros2"])
def test_bodies_of_other_schemes_take_backward_euler_while_they_touch_themselves(tmp_path, scheme):
    sim = made(body(fork(tmp_path)), integrator={"scheme": scheme}, contact={"passes": 60}, dt=0.002)
    close(sim, 2.0)
    for _ in range(5):
        sim.engine.run(1)
        assert crossings(sim) == 0
    records = sim.engine.records()
    touching, euler = records["contacts"] > 0, records["form"] == EULER
    assert touching.any() and euler[touching].all() and not euler.all()


def test_two_bodies_that_touch_each_other_and_themselves(tmp_path):
    mesh = fork(tmp_path)
    one, other = body(mesh, "one"), body(mesh, "other", pose={"translate": [0.03, 0, 0.021], "rotate": [0, 0, 0]})
    sim = made(one, other, contact={"passes": 200})
    close(sim, 5.0)
    v = sim.world.v.copy()
    v[sim.world.bodies[1].nodes, 2] -= 2.0
    put(sim, sim.world.v, v)
    w, before = sim.world, sim.world.mass @ v
    pairs = selves = 0
    for _ in range(6):
        sim.engine.run(1)
        assert crossings(sim) == 0
        given, rows = sim.contact.contact_input(), own_rows(sim)
        owner = np.where(given.corner[rows, 0] < w.bodies[1].first, 0, 1)
        selves += int((given.obstacle[rows] == owner).sum())
        pairs += int((given.obstacle[rows] != owner).sum())
    assert pairs and selves and abs(w.mass @ w.v - before).max() < 1e-9 * (w.mass @ abs(v)).sum()


def test_a_body_that_begins_through_itself_is_told(tmp_path, caplog):
    mesh = bar_mesh((8, 1, 1), (0.08, 0.01, 0.01), "kuhn")
    rest = mesh.rest.copy()
    angle = rest[:, 0] / 0.08 * 2.2 * np.pi  # rolled up until its ends are in each other
    rest[:, 0], rest[:, 1] = (0.012 + rest[:, 1]) * np.sin(angle), -(0.012 + rest[:, 1]) * np.cos(angle)
    turned = bar_mesh((8, 1, 1), (0.08, 0.01, 0.01), "kuhn").tets[:, [0, 2, 1, 3]]
    with caplog.at_level(logging.WARNING):
        made(body(mesh_file(tmp_path, rest, turned)))
    assert "'body' begins passing through itself" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        made(body(fork(tmp_path)))
    assert "passing through" not in caplog.text
