# SPDX-License-Identifier: MIT
"""Attachments and springs against known answers: one bar of two, masses on a spring, momentum, breaking."""

from typing import Any

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mechanics.ties import nearest_on_triangles
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar

TIGHT = {"preconditioner": "block_jacobi", "tolerance": 1e-11, "max_iterations": 5000}
FLOOR = {"name": "floor", "shape": "plane", "pose": {"translate": [0, -5, 0]}}


def made(*objects: dict, gravity: bool = True, device: str = "cpu", **table: Any) -> Simulation:
    """attachment, spring, obstacle: lists of tables; solver."""
    solver, dt = {**TIGHT, **table.pop("solver", {})}, table.pop("dt", 0.01)
    effects: dict[str, Any] = {"gravity": {"g": [0, -9.81, 0]}} if gravity else {}
    effects |= {"contact": table.pop("contact", True)} if "obstacle" in table else {}
    given = {"name": "ties", "dt": dt, "object": list(objects), "effects": effects, "solver": solver, **table}
    return Simulation(Scene.model_validate(given, context={"folder": "."}), device)


def half(name: str, x: float, fixed: str | None = None, **keys: Any) -> dict:
    """A bar of 1 m along x that begins at x."""
    keys |= {"fixed": fixed} if fixed else {}
    return bar((4, 2, 2), (1, 0.5, 0.5), name=name, pose={"translate": [x, 0, 0]}, **keys)


def glue(**keys: Any) -> dict:
    return {"name": "glue", "object": "b", "where": "X < 0.01", "to": "a", **keys}


def reactions(sim: Simulation) -> np.ndarray:
    return sim.engine.records_and_reactions()[1]


def test_two_bars_end_to_end_are_one():
    """At rest the deflection is that of one bar, whatever the stiffness: the forces are carried, so no gap is left."""
    damping = (10.0, 0.01)
    one = made(bar((8, 2, 2), (2, 0.5, 0.5), fixed="X < 0.01", young=1e6, damping=damping))
    one.engine.run(450)
    keys = {"young": 1e6, "damping": damping}
    for stiffness in (10.0, 1000.0):
        two = made(half("a", 0, "X < 0.01", **keys), half("b", 1, **keys), attachment=[glue(stiffness=stiffness)])
        two.engine.run(450)
        assert two.world.x[:, 1].min() == pytest.approx(one.world.x[:, 1].min(), abs=1e-7)
        force = reactions(two)[-2:, 0, :3]
        weight = 9.81 * two.world.mass[two.world.bodies[1].nodes].sum()
        np.testing.assert_allclose(force, [[0, weight, 0], [0, -weight, 0]], atol=1e-3 * weight)
    tied = two.ties.corner[:, :2], two.ties.weight[:, 1] == -1
    assert tied[1].all(), "equal meshes: node to node"
    gap = two.world.x[tied[0][:, 0]] - two.world.x[tied[0][:, 1]]
    assert np.abs(gap).max() < 1e-7


def test_in_motion_two_bars_are_the_nearer_to_one_the_stiffer_the_attachment():
    one = made(bar((8, 2, 2), (2, 0.5, 0.5), fixed="X < 0.01"))
    one.engine.run(40)
    away = []
    for stiffness in (10.0, 100.0, 1000.0):
        two = made(half("a", 0, "X < 0.01"), half("b", 1), attachment=[glue(stiffness=stiffness)])
        two.engine.run(40)
        away.append(abs(two.world.x[:, 1].min() - one.world.x[:, 1].min()))
    assert away[2] < 0.2 * away[1] < 0.04 * away[0] and away[2] < 1e-4


def masses(device: str = "cpu", **spring: Any) -> Simulation:
    """Two stiff free bars, a spring between the middles of the ends that face each other, 0.5 m apart."""
    ends = [{"object": "a", "at": [1, 0.25, 0.25]}, {"object": "b", "at": [0, 0.25, 0.25]}]
    bars = half("a", 0, young=1e9), half("b", 1.5, young=1e9, density=3000.0)
    given = {"name": "band", "between": ends, "stiffness": 5e4, "rest_length": 0.4, **spring}
    return made(*bars, gravity=False, spring=[given], device=device)


def test_a_spring_between_free_bodies_keeps_momentum():
    sim = masses()
    sim.world.v[sim.world.bodies[0].nodes] = [0.1, 0.4, 0.0]
    mass = sim.world.mass
    linear, angular = mass @ sim.world.v, np.cross(sim.world.x, mass[:, None] * sim.world.v).sum(axis=0)
    sim.engine.run(100)
    most = np.abs(mass[:, None] * sim.world.v).sum()
    assert np.abs(mass @ sim.world.v - linear).max() < 1e-11 * most
    assert np.abs(np.cross(sim.world.x, mass[:, None] * sim.world.v).sum(axis=0) - angular).max() < 0.01 * most
    assert np.abs(sim.world.v[sim.world.bodies[1].nodes]).max() > 0.01


def test_two_masses_on_a_spring_swing_as_the_scheme_has_it():
    """Backward Euler of the distance of two rigid masses, step by step."""
    sim = masses()
    a, b = (sim.world.mass[body.nodes].sum() for body in sim.world.bodies)
    reduced, k, h = a * b / (a + b), 5e4, 0.01
    stretch, rate, middle = 0.1, 0.0, [sim.world.x[body.nodes].mean(axis=0)[0] for body in sim.world.bodies]
    for _ in range(60):
        sim.engine.run(1)
        rate = (rate - h * k / reduced * stretch) / (1 + h * h * k / reduced)
        stretch += h * rate
        now = [sim.world.x[body.nodes].mean(axis=0)[0] for body in sim.world.bodies]
        assert (now[1] - now[0]) - (middle[1] - middle[0]) == pytest.approx(stretch - 0.1, abs=1e-3)
    assert reactions(sim)[-2:, 0, 0].sum() == pytest.approx(0, abs=1e-9)


def test_a_spring_breaks_at_its_force_within_a_step():
    sim = masses(rest_length=0.5, breaking=300.0)
    sim.world.v[sim.world.bodies[1].nodes] = [0.5, 0, 0]
    forces, broken = [], sim.ties.broken
    for _ in range(40):
        sim.engine.run(1)
        forces.append(reactions(sim)[0, 0, 0])
    first = int(np.argmax(np.abs(forces) > 300.0))
    assert 0 < first < 30 and broken.tolist() == [first + 1]
    assert not np.any(forces[first + 1 :]) and np.abs(forces[:first]).max() <= 300.0
    speed = sim.world.mass[sim.world.bodies[1].nodes] @ sim.world.v[sim.world.bodies[1].nodes]
    before = speed.copy()
    sim.engine.run(5)
    after = sim.world.mass[sim.world.bodies[1].nodes] @ sim.world.v[sim.world.bodies[1].nodes]
    np.testing.assert_allclose(after, before, atol=1e-9 * np.abs(before).max())


def test_a_spring_at_a_held_node_does_no_work_on_the_body():
    """It pulls at the holder, whose work is that on the body."""
    keys = [{"time": 0.0}, {"time": 0.3, "translate": [0.0, 0.3, 0]}]
    holder = {"name": "holder", "object": "a", "where": "X > 0.99", "keyframes": keys}
    ends, work = [{"object": "a", "at": [1, 0.25, 0.25]}, {"object": "b", "at": [0, 0.25, 0.25]}], []
    for stiffness in (1e-3, 1e5):
        spring = {"name": "band", "between": ends, "stiffness": stiffness}
        bodies = half("a", 0, "X < 0.01"), half("b", 1.5, "X < 0.9")
        sim = made(*bodies, holder=[holder], spring=[spring], gravity=False)
        sim.engine.run(30)
        work.append(sim.engine.records()["work"][-2])
    assert work[1] == pytest.approx(work[0], rel=1e-9) and work[0] > 1


def test_an_attachment_tears_where_it_carries_most():
    """A bar that is glued to a wall by its end: the rows above carry its weight; they break one after another."""
    strong = made(half("a", 0, "X < 0.01"), half("b", 1), attachment=[glue()])
    torn = made(half("a", 0, "X < 0.01"), half("b", 1), attachment=[glue(breaking=400.0)])
    for sim in (strong, torn):
        sim.engine.run(60)
    assert not strong.ties.broken.any()
    steps = torn.ties.broken[torn.ties.broken > 0]
    assert len(steps) >= 2 and (np.diff(np.sort(steps)) >= 0).all()
    assert torn.world.x[torn.world.bodies[1].nodes, 1].min() < strong.world.x[strong.world.bodies[1].nodes, 1].min()


def test_nodes_stick_to_an_obstacle_that_moves():
    keys = [{"time": 0, "translate": [0, 2, 0]}, {"time": 0.5, "translate": [0.2, 2.3, 0], "rotate": [0, 0, 30]}]
    tool = {"name": "tool", "shape": "sphere", "radius": 0.1, "keyframes": keys}
    stuck = {"name": "stuck", "object": "a", "where": "X > 0.99", "to": "tool"}
    sim = made(half("a", 0), obstacle=[FLOOR, tool], attachment=[stuck], contact={"thickness": 0.01})
    begun = sim.world.x.copy()
    sim.engine.run(120)
    nodes = sim.world.rest[:, 0] > 0.99
    turn = np.array([[3**0.5 / 2, -0.5, 0], [0.5, 3**0.5 / 2, 0], [0, 0, 1]])
    expected = (begun[nodes] - [0, 2, 0]) @ turn.T + [0.2, 2.3, 0]
    np.testing.assert_allclose(sim.world.x[nodes], expected, atol=0.02)
    assert sim.reaction_names == ["floor", "tool", "stuck"] and abs(reactions(sim)[-1, 2, :3]).max() > 100


def test_attached_bodies_come_to_rest_on_a_floor():
    """With contact: both rest, and the floor carries both weights."""
    floor = {"name": "floor", "shape": "plane", "pose": {"translate": [0, -0.002, 0]}}
    sim = made(half("a", 0), half("b", 1), obstacle=[floor], attachment=[glue()], solver={"tolerance": 1e-8})
    sim.engine.run(260)
    names, force = sim.reaction_names, reactions(sim)[-2:]
    assert names == ["floor", "glue"]
    assert force[:, 0, 1].sum() == pytest.approx(-9.81 * sim.world.mass.sum(), rel=1e-3)
    assert np.abs(sim.world.v).max() < 5e-3
    first, second = (set(map(tuple, np.round(sim.world.x[b.nodes], 3))) for b in sim.world.bodies)
    assert len(first & second) >= 5, "nodes of the ends lie on each other"


def test_nearest_points_of_triangles_are_those_of_many_samples():
    rng = np.random.default_rng(3)
    triangles, x = rng.normal(size=(20, 3, 3)), rng.normal(size=3)
    weights, distance = nearest_on_triangles(x, triangles)
    assert (weights > -1e-12).all() and np.allclose(weights.sum(axis=1), 1)
    np.testing.assert_allclose(np.linalg.norm(np.einsum("mk,mkx->mx", weights, triangles) - x, axis=1), distance)
    samples = rng.dirichlet((0.5, 0.5, 0.5), size=4000)
    nearest = np.linalg.norm(np.einsum("sk,mkx->msx", samples, triangles) - x, axis=2).min(axis=1)
    assert (distance <= nearest + 1e-12).all() and np.allclose(distance, nearest, atol=0.1)


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"attachment": [glue(to="c")]}, "no other object and no obstacle 'c'"),
        ({"attachment": [glue(to="b")]}, "no other object and no obstacle 'b'"),
        ({"attachment": [glue(where="X < -1")]}, "has no node of object 'b'"),
        ({"attachment": [glue(where="X > 0.9")]}, "since what is attached is drawn together"),
        ({"attachment": [glue(), glue()]}, "more than once: glue"),
        ({"attachment": [glue()], "integrator": {"scheme": "newmark"}}, "allowed: 'backward_euler'"),
        ({"spring": [{"name": "s", "between": [{"object": "a", "at": [0, 0, 0]}] * 2, "stiffness": 1.0}]}, "needs two"),
    ],
)
def test_tables_that_cannot_be_are_refused(tables, said):
    with pytest.raises((InputError, ValueError), match=said):
        made(half("a", 0), half("b", 1), **tables)


def test_a_factor_that_knows_attachments_is_not_corrected_for_them():
    solver = {"preconditioner": "cholesky", "factor_precision": "float64", "tolerance": 1e-8, "update": "never"}
    held = half("b", 0, "X > 0.99", young=1e6)
    found = []
    for woodbury in (32, 0):
        sim = made(held, obstacle=[FLOOR], attachment=[glue(to="floor")], solver=solver | {"woodbury": woodbury})
        driver = Driver(sim)
        driver.step_with_fresh_factors()
        found.append(driver.advance(10)["iterations"].tolist())
        assert sim.engine.corrected(0) == 0
    assert found[0] == found[1]


def test_glued_bars_that_fall_far_in_a_step_do_not_touch_each_other():
    """With contact listed: they move by half an element in a step, together."""
    sim = made(half("a", 0), half("b", 1), attachment=[glue()], obstacle=[FLOOR | {"pose": {"translate": [0, -90, 0]}}])
    sim.world.v[:] = (0, -12, 0)
    records = Driver(sim).advance(20)
    assert not records["clipped"].any() and not records["contacts"].any() and records["passes"].max() <= 1
