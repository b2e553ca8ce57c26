# SPDX-License-Identifier: MIT
"""Several linearizations of a step of backward Euler in contact: accuracy, forces, fast bodies, bodies on bodies."""

from typing import Any

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import LOCKSTEP, D, block, floor, over
from tests.contact.test_contact_answers import reactions, weight
from tests.contact.test_contact_bodies import collision, inside, momenta, stack
from tests.contact.test_contact_sweep import SMALL, plate, surface
from tests.state import put

STATUS = KINDS.enumeration("Status")
TIGHT = {"preconditioner": "block_jacobi", "tolerance": 1e-12, "max_iterations": 3000, "projection": "none"}
LAW = {"thickness": D, "tolerance": 1e-11, "passes": 100}


def soft(**table: Any) -> dict:
    """A block of a law that is not linear."""
    made = block(young=None, **table)
    made["effects"]["stable_neo_hookean"] = {"young": 3e5, "poisson": 0.4}
    return made


def dropped(linearizations: int, friction: float = 0.5, **table: Any) -> Simulation:
    """At 3 m/s, and pressed flat in the first step."""
    newton = {"linearizations": linearizations, "tolerance": 1e-12}
    return over(floor(friction), objects=[soft(friction=friction, at=(0, 0.03, 0), **table)], velocity=(0.5, -3, 0),
                solver=TIGHT, contact=LAW, integrator=newton)  # fmt: skip


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_the_residual_with_contact_falls_quadratically(friction):
    left = [Driver(dropped(n, friction)).advance(1)["nonlinear"][0] for n in (2, 3, 4)]
    assert 1e-9 < left[0] < 1e-5 and left[1] < 1e-3 * left[0] and left[2] < 1e-10


def test_each_linearization_brings_the_motion_nearer_to_that_of_backward_euler():
    def motion(linearizations: int) -> np.ndarray:
        sim, places = dropped(linearizations), []
        for _ in range(6):
            Driver(sim).advance(1)
            places.append(sim.world.x.copy())
        return np.array(places)

    exact = motion(20)
    error = [abs(motion(n) - exact).max(axis=(1, 2)) for n in (1, 2, 4)]
    assert (error[0] > 1e-7).all()
    assert (error[1] < 0.02 * error[0]).all() and (error[2] < 0.02 * error[1]).all()


def test_the_residual_is_that_of_forces_and_momenta_at_the_end_of_the_step():
    """By differences of the energy, and the forces that the rows have."""
    sim = dropped(3, cells=(2, 1, 2))
    Driver(sim).advance(1)
    for _ in range(2):
        before = sim.world.v.copy()
        record = Driver(sim).advance(1)[0]
        w, rows = sim.world, sim.contact.contact_input()
        contact, internal = np.zeros_like(w.x), np.zeros_like(w.x)
        np.add.at(contact, rows.corner[:, 0], rows.force[:, None] * rows.normal + rows.traction)
        for place in np.ndindex(w.x.shape):
            x, ends = w.x[place], []
            for side in (-1e-6, 1e-6):
                w.x[place] = x + side
                ends.append(sim.potential_energy())
            w.x[place] = x
            internal[place] = (ends[1] - ends[0]) / 2e-6
        left = w.mass[:, None] * (w.v - before) / w.dt + internal - contact
        assert record["contacts"] > 0 and record["nonlinear"] < 1e-9
        assert abs(left).max() <= 1e-6 * abs(contact).max()


def test_a_block_at_rest_weighs_what_it_weighs():
    sim = over(objects=[soft()], integrator={"linearizations": 4})
    records, forces = reactions(sim, 80)
    assert forces[-1, 1] == pytest.approx(-weight(sim), rel=1e-5)
    assert not records["status"].any() and records["linearizations"][-1] == 1 and abs(sim.world.v).max() <= 1e-8


@pytest.mark.parametrize("held", ["fixed", "holder"])
def test_it_bears_a_tool_that_presses_against_what_holds_it(held):
    """A ball from below; the forces on both add up to the weight. A holder that stands still is `fixed`, to the bit."""
    sim = simulation_of_pressed(held)
    records, forces = reactions(sim, 30)
    assert records["linearizations"].max() > 2 and not records["status"].any() and records["contacts"][-1] > 0
    if held == "fixed":
        other = simulation_of_pressed("holder")
        other.engine.run(30)
        assert np.array_equal(other.world.x, sim.world.x)
        return
    both = sim.world.reaction[0, 0, :3] + forces[-1, :3]
    assert abs(both - [0, -weight(sim), 0]).max() <= 1e-2 * weight(sim)


def simulation_of_pressed(held: str) -> Simulation:
    body, top = soft(at=(0, 0.003, 0)), "Y > 0.0599"
    keys = [{"time": 0, "translate": [0.05, -0.03, 0.05]}, {"time": 0.2, "translate": [0.05, -0.026, 0.05]}]
    ball = {"name": "ball", "shape": "sphere", "radius": 0.03, "keyframes": keys}
    extra: dict[str, Any] = {}
    if held == "fixed":
        body["effects"]["fixed"] = {"where": top}
    else:
        extra["holders"] = [{"name": "clamp", "object": body["name"], "where": top}]
    newton = {"linearizations": 8, "tolerance": 1e-6}
    return over(ball, objects=[body], dt=0.01, integrator=newton, contact={"thickness": D, "tolerance": 1e-6}, **extra)


# --- fast bodies, several bodies --------------------------------------------------------------------------------------


def test_a_body_that_touches_nothing_moves_as_without_the_effect_to_the_bit():
    def fall(contact: Any) -> np.ndarray:
        table = block(at=(0, 5, 0), rotate=(10, 20, 30), cells=(2, 2, 2))
        if contact is None:
            del table["friction"]
        sim = over(objects=[table], contact=contact, integrator={"linearizations": 3})
        put(sim, sim.world.v, np.cross((3.0, 5.0, 8.0), sim.world.x))
        records = Driver(sim).advance(10)
        assert records["linearizations"].max() > 1
        return np.concatenate([sim.world.x.ravel(), records["residual"], records["iterations"], records["nonlinear"]])

    assert np.array_equal(fall(True), fall(None))


@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
def test_no_node_passes_a_plate(speed):
    dt = 0.01
    sim = over(plate(0.002), velocity=(0.2 * speed, -speed, 0), dt=dt, at=(0, 0.05, 0),
               integrator={"linearizations": 3}, **SMALL)  # fmt: skip
    for _ in range(int(0.05 / speed / dt) + 12):
        sim.engine.run(1)
        assert (surface(sim)[:, 1] > 0).all()
    assert np.isfinite(sim.world.v).all()


def test_what_a_sweep_finds_goes_on_from_the_state_reached():
    """A plate comes from far away in one step: no row is there before the search is over."""
    dt = 1 / 60
    keys = [{"time": 3 * dt, "translate": [0, -0.5, 0]}, {"time": 4 * dt, "translate": [0, 0.05, 0]}]
    swung = {"name": "plate", "shape": "box", "size": [4, 0.002, 4], "keyframes": keys}
    sim = over(swung, at=(0, 0.02, 0), gravity=(0, 0, 0), dt=dt, integrator={"linearizations": 4}, **SMALL)
    sim.engine.run(4)
    records = sim.engine.records()
    assert not records["contacts"][:3].any() and records["contacts"][3] and records["linearizations"][3] > 1
    assert (surface(sim)[:, 1] > 0.051).all()


@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_bodies_that_collide_have_one_search_and_keep_their_momentum(speed):
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-12, "max_iterations": 3000}
    contact, newton = {"thickness": D, "tolerance": 1e-6, "passes": 200}, {"linearizations": 6, "tolerance": 1e-8}
    sim = collision(speed, 0.5, solver, contact, integrator=newton)
    linear, angular = momenta(sim)
    size = sim.world.mass.sum() * speed
    steps = int(0.3 / speed / sim.world.dt) + 4
    sim.engine.run(steps)
    records = sim.engine.records().reshape(steps, 2)
    together = records["contacts"][:, 0] > 0
    assert together.any() and not inside(sim, 0, 1) and not inside(sim, 1, 0)
    for name in ("linearizations", "nonlinear", "status", "passes"):
        assert np.array_equal(*records[name][together].T)
    assert records["linearizations"][together].max() > 2
    after, turned = momenta(sim)
    assert abs(after - linear).max() <= 1e-9 * size
    if speed < 1:  # backward Euler, solved, damps spin
        assert abs(turned - angular).max() <= 0.05 * abs(angular).max()


def test_a_stack_stands_and_costs_one_linearization():
    sim = stack(2, integrator={"linearizations": 4})
    Driver(sim).advance(80)
    records, forces = reactions(sim, 2)
    assert -forces[-2:, 1].sum() == pytest.approx(weight(sim), rel=1e-3)
    assert (records["linearizations"] == 1).all() and abs(sim.world.v).max() <= 1e-4


def test_it_repeats_to_the_bit_with_any_number_of_threads():
    ends = []
    for threads in (1, 1, 2):
        beside = [block(name=name, at=(x, 0.03, 0), rotate=(x, 20, 10)) for x, name in enumerate("ab")]
        sim = over(objects=beside, velocity=(1, -3, 0), solver=LOCKSTEP | {"threads": threads},
                   integrator={"linearizations": 3})  # fmt: skip
        sim.engine.run(2)
        records = sim.engine.records()
        assert records["contacts"].any()
        ends.append(np.concatenate([sim.world.x.ravel(), records["iterations"], records["linearizations"]]))
    assert np.array_equal(ends[0], ends[1]) and np.array_equal(ends[0], ends[2])


def test_linearizations_that_run_out_are_told():
    sim = dropped(2)
    assert Driver(sim).advance(1)["status"][0] == STATUS["MAX_LINEARIZATIONS"]
    short = over(velocity=(5, -5, 0), at=(0, 0.02, 0), contact={"thickness": D, "passes": 1},
                 integrator={"linearizations": 2})  # fmt: skip
    record = Driver(short).advance(1)[0]
    assert record["status"] == STATUS["CONTACT"] and record["contact_residual"] > 1e-3
