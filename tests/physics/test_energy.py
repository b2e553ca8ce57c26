# SPDX-License-Identifier: MIT
"""The energy that step records tell: against sums made here, and as a balance."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.effects.touch import Touch
from sim_server.simulation import Simulation
from tests.scenes import bar, simulation, solid

G = (0.5, -9.81, 1.0)
EXACT = {"preconditioner": "block_jacobi", "tolerance": 1e-12, "max_iterations": 3000}


def watched(*objects: dict, every: int = 1, **table) -> Simulation:
    """Runs with elastic energies in each `every`-th step."""
    sim = simulation(*objects, **(EXACT | table))
    sim.engine.loop.energy_every = every
    return sim


def touched(sim: Simulation) -> Touch:
    assert sim.touch is not None
    return sim.touch


def kinetic(sim: Simulation, body: int) -> float:
    nodes = sim.world.bodies[body].nodes
    return 0.5 * float((sim.world.mass[nodes, None] * sim.world.v[nodes] ** 2).sum())


def gravity(sim: Simulation, body: int) -> float:
    nodes = sim.world.bodies[body].nodes
    return -float((sim.world.mass[nodes, None] * sim.world.x[nodes] * np.array(G)).sum())


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha"])
def test_each_body_is_told_its_energy_in_each_step(scheme):
    objects = [
        bar((3, 1, 1), name="a", young=2e4, fixed="X < 0.01", damping=(0.2, 0.01)),
        bar((2, 2, 1), name="b", young=5e4, poisson=0.2, pose={"translate": [0.0, 3.0, 0.0]}),
    ]
    integrator = {"scheme": scheme, "linearizations": 8, "tolerance": 1e-8}
    sim = watched(*objects, gravity=G, integrator=integrator, dt=0.01)
    sim.world.v[sim.world.bodies[1].nodes] = np.random.default_rng(0).normal(size=(18, 3))
    start = [kinetic(sim, k) + gravity(sim, k) for k in (0, 1)]  # strained by nothing
    for _ in range(12):
        sim.engine.run(1)
        for k, record in enumerate(sim.engine.records()):
            assert record["kinetic"] == pytest.approx(kinetic(sim, k), rel=1e-12)
            assert record["gravity"] == pytest.approx(gravity(sim, k), rel=1e-12)
            body = solid(sim, k)
            assert record["elastic"] == pytest.approx(body.energy(), rel=1e-9)
            assert record["budget"] == pytest.approx(start[k] - gravity(sim, k), rel=1e-9)
            assert record["work"] == 0 and record["stride"] > 0
    assert record["elastic"] > 0


def test_the_elastic_energy_is_evaluated_where_it_is_wanted_alone():
    sim = watched(bar(young=2e4, fixed="X < 0.01"), gravity=G, every=3)
    sim.engine.run(7)
    known = np.isfinite(sim.engine.records()["elastic"])
    assert known.tolist() == [False, False, True, False, False, True, False]
    sim.engine.loop.energy_every = 0
    sim.engine.run(3)
    records = sim.engine.records()
    assert np.isnan(records["elastic"]).all() and (records["kinetic"] > 0).all()


def dissipated(records: NDArray) -> NDArray:
    return records["budget"] - records["kinetic"] - records["elastic"]


def test_backward_euler_dissipates_in_each_step():
    """In small motions a step M (v' - v) = h f(x') loses sum m |v' - v|^2 / 2 and the energy of x' - x."""
    sim = watched(bar((4, 1, 1), young=1e6, fixed="X < 0.01"), gravity=(0, -1e-3, 0), dt=0.01)
    found, steps, v, x = [], 60, np.zeros_like(sim.world.v), sim.world.x.copy()
    stiffness = solid(sim).tangent()
    for _ in range(steps):
        sim.engine.run(1)
        dv, dx = (sim.world.v - v), (sim.world.x - x).ravel()
        found.append(0.5 * (sim.world.mass[:, None] * dv**2).sum() + 0.5 * dx @ stiffness @ dx)
        v, x = sim.world.v.copy(), sim.world.x.copy()
    records = sim.engine.records()
    lost = np.diff(dissipated(records), prepend=0.0)
    assert (lost > 0).all()
    np.testing.assert_allclose(np.cumsum(found)[1:], dissipated(records)[1:], rtol=2e-3)


def test_newmark_keeps_the_energy_of_small_motions():
    integrator = {"scheme": "newmark", "linearizations": 10, "tolerance": 1e-10}
    sim = watched(bar((4, 1, 1), young=1e6, fixed="X < 0.01"), gravity=(0, -1e-3, 0), dt=0.01, integrator=integrator)
    sim.engine.run(200)
    records = sim.engine.records()
    swing = records["kinetic"].max()
    assert swing > 0 and np.abs(dissipated(records)).max() < 1e-3 * swing


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark"])
@pytest.mark.parametrize("linearizations", [1, 6])
def test_the_work_of_a_push_is_force_times_way(scheme, linearizations):
    touch = {"max_force": 1e4}
    integrator = {"scheme": scheme, "linearizations": linearizations, "tolerance": 1e-8}
    if scheme == "newmark":
        integrator |= {"beta": 0.36, "gamma": 0.7}
    sim = watched(bar(young=2e4, fixed="X < 0.01", tangent="exact", touch=touch), integrator=integrator, dt=0.01)
    force, push, work = np.array([10.0, 300.0, -40.0]), touched(sim).push, 0.0
    taken = push("me", "bar", (2.0, 0.5, 0.5), 0.8, tuple(force), 0.1)
    for step in range(20):
        x = sim.world.x.copy()
        sim.engine.run(1)
        if step < 10:  # so many whole steps
            work += float(((sim.world.x - x)[taken.nodes] @ force).sum()) / len(taken.nodes)
        assert sim.engine.records()["work"][-1] == pytest.approx(work, rel=1e-9)
    assert work > 1


@pytest.mark.parametrize("linearizations", [1, 6])
def test_the_work_of_a_grab_that_moves_is_what_its_spring_gives(linearizations):
    integrator = {"linearizations": linearizations, "tolerance": 1e-8}
    sim = watched(bar(young=2e4, fixed="X < 0.01", touch={"max_force": 1e6}), integrator=integrator, dt=0.01)
    touch, at, stiffness = touched(sim), np.array([2.0, 0.5, 0.5]), 3e4
    grab = touch.grab("me", "bar", tuple(at), 0.8, tuple(at), stiffness, 1e6, 10.0)
    spring = stiffness / len(grab.nodes)
    work = 0.0
    for step in range(30):
        target = at + np.array([0, 0.01 * step, 0.02 * np.sin(0.4 * step)])
        touch.move("me", grab.id, tuple(target))
        before = 0.5 * spring * ((target + grab.offset - sim.world.x[grab.nodes]) ** 2).sum()
        sim.engine.run(1)
        work += before - 0.5 * spring * ((target + grab.offset - sim.world.x[grab.nodes]) ** 2).sum()
        record = sim.engine.records()[-1]
        assert record["work"] == pytest.approx(work, rel=1e-9, abs=1e-9)
        assert dissipated(record) > -1e-9
    assert work > 10
    touch.release("me", grab.id)
    sim.engine.run(5)
    assert sim.engine.records()["work"][-1] == pytest.approx(work, rel=1e-9)


def test_a_grab_at_its_limit_works_with_its_limit():
    sim = watched(bar(young=2e4, fixed="X < 0.01", touch={"max_force": 50.0}), dt=0.01)
    at = np.array([2.0, 1.0, 1.0])
    grab = touched(sim).grab("me", "bar", tuple(at), 0.0, (2.0, 2e3, 1.0), 1e3, 50.0, 10.0)
    sim.engine.run(8)
    way = sim.world.x[grab.nodes[0], 1] - at[1]  # the target is so far away that the pull is along y
    assert sim.engine.records()["work"][-1] == pytest.approx(50 * way, rel=1e-4) and way > 1e-3


def test_a_state_set_between_runs_is_a_new_start():
    sim = watched(bar(young=2e4), bar(young=2e4, name="other"), gravity=G)
    sim.engine.run(3)
    nodes = sim.world.bodies[0].nodes
    sim.world.v[nodes] += 100.0
    start = kinetic(sim, 0) + gravity(sim, 0)
    sim.engine.records()
    sim.engine.run(1)
    set_, other = sim.engine.records()
    assert set_["status"] == other["status"] == 0
    assert set_["budget"] == pytest.approx(start - gravity(sim, 0), rel=1e-6)
    assert other["budget"] == pytest.approx(gravity_at_rest(sim, 1) - gravity(sim, 1), rel=1e-9)


def gravity_at_rest(sim: Simulation, body: int) -> float:
    nodes = sim.world.bodies[body].nodes
    return -float((sim.world.mass[nodes, None] * sim.world.rest[nodes] * np.array(G)).sum())


def test_threads_change_no_energy():
    objects = [bar((4, 2, 2), name=name, young=2e4, fixed="X < 0.01") for name in ("a", "b", "c")]
    found = []
    for threads in (1, 3):
        sim = watched(*objects, gravity=G, threads=threads)
        sim.engine.run(5)
        records = sim.engine.records()
        found.append([records[name].tobytes() for name in ("kinetic", "elastic", "gravity", "budget", "stride")])
    assert found[0] == found[1]
