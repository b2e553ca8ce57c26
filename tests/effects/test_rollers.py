# SPDX-License-Identifier: MIT
"""Nodes that keep their place along some directions: known answers, exact zeros, and what is refused."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_server.errors import InputError
from sim_server.recording import messages
from sim_server.scene.model import Scene
from sim_server.service.scene_notes import scene_notes
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.worker_assembly import Assembly
from tests.holders.holder_scenes import held_bar
from tests.scenes import bar, scene, solid

PLANES = [{"where": f"{axis.upper()} < 0.01", "along": axis} for axis in "xyz"]
STATIC = {"scheme": "quasi_static", "linearizations": 10}
SCHEMES: list[dict[str, Any]] = [
    {}, {"linearizations": 3}, {"scheme": "newmark"}, {"scheme": "newmark", "linearizations": 3}, {"scheme": "bdf2"},
    {"scheme": "generalized_alpha"}, {"scheme": "generalized_alpha", "linearizations": 2},
    {"scheme": "ros2", "solve": "iterate"}, {"scheme": "central_difference"},
]  # fmt: skip


def roller_bar(fixed: Any, integrator: dict | None = None, gravity: Any = (-3.0, 2.0, 1.0), **table: Any) -> Simulation:
    """A bar of 2 m along x. effects: others; rotate [degrees]; solver: its table; else of `bar`."""
    effects, solver = table.pop("effects", {}), table.pop("solver", {})
    given = bar(damping=(0.5, 0.01), pose={"rotate": list(table.pop("rotate", (0, 0, 0)))}, density=1000, **table)
    given["effects"] |= {"fixed": fixed} | effects
    return Simulation(scene(given, gravity=gravity, integrator=integrator, **solver))


def off_the_planes(sim: Simulation) -> float:
    """Largest velocity along a direction that a node keeps [m/s]."""
    sim.fetch()
    assert sim.world.rollers is not None
    return max(float(np.abs(n @ sim.world.v[i]).max()) for i, n in sim.world.rollers.directions.items())


@pytest.mark.parametrize("integrator", SCHEMES, ids=str)
def test_velocity_along_the_directions_is_zero_exactly(integrator):
    sim = roller_bar(PLANES, integrator)
    Driver(sim).advance(20)
    assert off_the_planes(sim) == 0 and np.abs(sim.world.v).max() > 0.01
    x = sim.world.x - sim.world.rest
    assert all((x[i][np.abs(n[0]) == 1] == 0).all() for i, n in sim.world.rollers.directions.items())


@pytest.mark.parametrize("integrator", SCHEMES, ids=str)
def test_a_pose_gives_the_same_motion(integrator):
    rotate = (20.0, -35.0, 70.0)
    turn = Rotation.from_euler("xyz", rotate, degrees=True)
    tight = {"tolerance": 1e-10} if integrator.get("scheme") != "central_difference" else {}
    first = roller_bar(PLANES, integrator, solver=tight)
    second = roller_bar(PLANES, integrator, turn.apply([-3, 2, 1]).tolist(), rotate=rotate, solver=tight)
    for sim in (first, second):
        Driver(sim).advance(10)
    assert off_the_planes(second) < 1e-12 and off_the_planes(first) == 0
    np.testing.assert_allclose(second.world.x, turn.apply(first.world.x), rtol=0, atol=1e-7)


def test_a_factor_alone_keeps_the_directions():
    """The factor is of another state, and stands in for the matrix."""
    solver = {"preconditioner": "cholesky", "update": "lockstep-6"}
    sim = roller_bar(PLANES, {"scheme": "ros2"}, solver=solver)
    forms = Driver(sim).advance(30)["form"]
    assert (forms == 2).sum() > 20, "steps by the factor"
    assert off_the_planes(sim) == 0 and np.abs(sim.world.v).max() > 0.01
    turned = roller_bar(PLANES, {"scheme": "ros2"}, rotate=(20, -35, 70), solver=solver)
    Driver(turned).advance(30)
    assert off_the_planes(turned) < 1e-6 * np.abs(turned.world.v).max(), "numbers of the factor have 22 bits"


def test_bodies_that_spin_on_a_plane_use_old_factors():
    """Frames turn about the normal: a factor stays of use while the body turns."""
    given = {"preconditioner": "cholesky", "update": "every-40", "tolerance": 1e-8}
    sim = roller_bar({"where": "Z < 0.01", "along": "z"}, gravity=(0.0, 0.0, -1.0), solver=given)
    arm = sim.world.rest - sim.world.rest.mean(axis=0)
    sim.world.v[:] = np.cross([0, 0, 3.0], arm)
    records = Driver(sim).advance(40)
    angle = np.arctan2(*(sim.fetch().x[-1] - sim.world.x[0])[[1, 0]]) - np.arctan2(*(sim.world.rest[-1])[[1, 0]])
    assert abs(angle) > 1 and (records["status"] == 0).all() and records["iterations"][1:].max() < 25


@pytest.mark.parametrize("rotate", [(0, 0, 0), (20, -35, 70)])
def test_a_stretch_between_planes_of_symmetry_is_homogeneous(rotate):
    """Exact: strain F / (E A) along, -nu times that across."""
    turn = Rotation.from_euler("xyz", rotate, degrees=True)
    load = {"traction": {"where": "X > 1.99", "force": turn.apply([50, 0, 0]).tolist()}}
    sim = roller_bar(PLANES, STATIC, (0, 0, 0), effects=load, rotate=rotate, young=1e5, poisson=0.3,
                     solver={"tolerance": 1e-10})  # fmt: skip
    Driver(sim).advance(5)
    u = turn.inv().apply(sim.fetch().x) - sim.world.rest
    strain = 50 / 1e5
    np.testing.assert_allclose(u, sim.world.rest * strain * [1, -0.3, -0.3], atol=1e-7 * strain)


def test_bodies_slide_along_a_plane_without_a_force():
    sim = roller_bar({"where": "X < 0.01", "along": "x"}, gravity=(0.0, -2.0, 1.0), effects={"rayleigh": {"mass": 0}})
    Driver(sim).advance(10)
    sim.fetch()
    np.testing.assert_allclose(sim.world.v, np.tile([0, -2 * 0.2, 0.2], (sim.world.nodes, 1)), atol=1e-7)


def test_the_matrix_is_the_projected_one():
    """S A S + s (1 - S), symmetric and positive definite; a node with two directions moves along a line."""
    sim = roller_bar(
        [{"where": "X < 0.01", "along": [1, 1, 0]}, {"where": "X > 1.99", "along": ["x", "z"]}], solver={"warp": False}
    )
    free = Simulation(scene(bar(damping=(0.5, 0.01), density=1000), warp=False))
    sim.engine.assemble()
    free.engine.assemble()
    n, rest = sim.world.nodes, sim.world.rest
    S = np.tile(np.eye(3), (n, 1, 1))
    S[rest[:, 0] < 0.01] = [[0.5, -0.5, 0], [-0.5, 0.5, 0], [0, 0, 1]]
    S[rest[:, 0] > 1.99] = np.diag([0, 1, 0])
    whole = np.zeros((3 * n, 3 * n))
    for i in range(n):
        whole[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = S[i]
    A, plain = sim.matrix().toarray(), free.matrix().toarray()
    np.testing.assert_allclose(whole @ A @ whole, whole @ plain @ whole, atol=1e-10 * np.abs(plain).max())
    np.testing.assert_allclose(whole @ A @ (np.eye(3 * n) - whole), 0, atol=1e-10 * np.abs(plain).max())
    values = np.linalg.eigvalsh(A)
    assert values[0] > 0 and values[-1] < 1.5 * np.linalg.eigvalsh(plain)[-1]


@pytest.mark.parametrize("preconditioner", ["none", "jacobi", "ssor", "cholesky", "incomplete_cholesky"])
def test_preconditioners_agree(preconditioner):
    known = roller_bar(PLANES, solver={"tolerance": 1e-11, "preconditioner": "block_jacobi"})
    solver = {"tolerance": 1e-11, "preconditioner": preconditioner, "max_iterations": 2000}
    sim = roller_bar(PLANES, solver=solver | ({"update": "lockstep-3"} if "cholesky" in preconditioner else {}))
    for each in (known, sim):
        Driver(each).advance(15)
    assert off_the_planes(sim) == 0
    np.testing.assert_allclose(sim.world.x, known.fetch().x, rtol=0, atol=1e-9)


def test_three_directions_are_a_fixed_node():
    """To the bit those of a clamp."""
    listed = [{"where": "X < 0.01", "along": ["x", "y"]}, {"where": "X < 0.01", "along": [1, 2, 3]}]
    solver = {"preconditioner": "block_jacobi"}  # "auto" chooses by time
    first, second = roller_bar(listed, solver=solver), roller_bar({"where": "X < 0.01"}, solver=solver)
    for sim in (first, second):
        Driver(sim).advance(10)
        sim.fetch()
    assert first.world.rollers is None and np.array_equal(first.world.x, second.world.x)


def test_plane_strain():
    """A body all of whose nodes keep z: a stretched strip is stiffer by 1 / (1 - nu^2)."""
    fixed = [*PLANES[:2], {"where": "true", "along": "z"}]
    load = {"traction": {"where": "X > 1.99", "force": [50, 0, 0]}}
    sim = roller_bar(fixed, STATIC, (0, 0, 0), effects=load, poisson=0.3, solver={"tolerance": 1e-10})
    Driver(sim).advance(5)
    u = sim.fetch().x - sim.world.rest
    np.testing.assert_allclose(u[-1, :2], [2 * 5e-4 * 0.91, -5e-4 * 0.39], rtol=1e-5)


def test_workers_assemble_the_same_matrix():
    sim = roller_bar(PLANES, rotate=(10, 20, 30))
    Driver(sim).advance(5)
    sim.engine.assemble()
    worker = Assembly(messages.scene(sim), messages.topology(sim, sim.world.bodies[0]))
    assert np.array_equal(worker.matrix(sim.fetch().x), sim.system.values)


def test_holders_take_nodes_of_planes():
    """They go where the holder says; the others stay on the planes."""
    holder = {"name": "grip", "where": "X > 1.99", "keyframes": [{"time": 0.1, "translate": [0.1, 0.02, 0]}]}
    given = bar()
    given["effects"]["fixed"] = PLANES
    table = {"name": "held", "dt": 0.01, "object": [given], "holder": [holder | {"object": "bar"}]}
    sim = Simulation(Scene.model_validate(table, context={"folder": "."}))
    Driver(sim).advance(20)
    end = sim.world.rest[:, 0] > 1.99
    np.testing.assert_allclose((sim.fetch().x - sim.world.rest)[end], np.tile([0.1, 0.02, 0], (end.sum(), 1)))
    assert off_the_planes(sim) == 0


def test_what_holds_a_quasi_static_body():
    roller_bar(PLANES, STATIC)
    two = "Z < 0.01", "Y < 0.01"
    with pytest.raises(InputError, match="rollers that leave no rigid motion"):
        roller_bar([{"where": w, "along": w[0].lower()} for w in two], STATIC)
    with pytest.raises(InputError, match="loose"):
        roller_bar({"where": "X < 0.01", "along": ["x", "y"]}, STATIC)
    roller_bar([{"where": "X < 0.01", "along": ["x", "y"]}, {"where": "X > 1.99", "along": "z"}, PLANES[2]], STATIC)


def test_rollers_are_no_free_fall():
    assert scene_notes(roller_bar(PLANES)) == [] and solid(roller_bar(PLANES)).free.sum() == 44
    assert scene_notes(held_bar(gravity=(0, -1, 0)))


@pytest.mark.parametrize(
    ("fixed", "said"),
    [
        ([{"where": "X < -1", "along": "x"}], "holds 0 of 45 nodes"),
        ({"where": "true"}, "holds 45 of 45 nodes"),
        ({"where": "true", "along": ["x", "y", "z"]}, "holds 45 of 45 nodes"),
        ({"where": "true", "along": "w"}, 'must be "x", "y" or "z"'),
        ({"where": "true", "along": [0, 0, 0]}, "vector of three numbers that is not zero"),
        ({"where": "true", "along": [1, 0]}, "vector of three numbers"),
        ([], "needs where = ..., or a list of tables"),
        ({"along": "x"}, "needs where = ..., or a list of tables"),
        ({"tables": PLANES, "along": "x"}, "stands in the tables"),
        ([{"where": "true", "alon": "x"}], "unknown key"),
    ],
)
def test_what_is_refused(fixed, said):
    with pytest.raises((InputError, ValueError), match=said):
        roller_bar(fixed)


@pytest.mark.parametrize("kind", ["contact", "spring"])
def test_contact_and_ties_are_refused(kind):
    given = bar()
    given["effects"]["fixed"] = PLANES
    table = {"name": "test", "dt": 0.02, "object": [given]}
    ends = [{"object": "bar", "at": [2, y, 0]} for y in (0, 1)]
    more = {
        "contact": {"effects": {"contact": {"self": True}}},
        "spring": {"spring": [{"name": "s", "between": ends, "stiffness": 9.0}]},
    }
    with pytest.raises(InputError, match="fixed with along does not go together with the .*" + kind):
        Simulation(Scene.model_validate(table | more[kind], context={"folder": "."}))
