# SPDX-License-Identifier: MIT
"""Contact with other schemes: a body that touches something takes backward Euler, one that does not its own."""

from typing import Any

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import LOCKSTEP, D, block, floor, over
from tests.contact.test_contact_answers import G, mean_velocity, reactions, weight
from tests.contact.test_contact_bodies import collision, inside, momenta
from tests.contact.test_contact_sweep import SMALL, plate, surface

SCHEMES = ("newmark", "bdf2", "generalized_alpha", "ros2")
EULER, ONE_SOLVE, ITERATE, FACTOR = (FORMS[name] for name in ("EULER", "ONE_SOLVE", "ITERATE", "FACTOR"))
STATUS = KINDS.enumeration("Status")
FAR = {"at": (0, 5, 0), "rotate": (10, 20, 30)}


def under(scheme: str, *obstacles: dict, **table: Any) -> Simulation:
    return over(*obstacles, integrator={"scheme": scheme}, **table)


# --- known answers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_block_at_rest_weighs_what_it_weighs_and_stays_where_backward_euler_has_it(scheme):
    sim, reference = under(scheme), over()
    for each in (sim, reference):
        Driver(each).advance(150)
    records, forces = reactions(sim, 10)
    assert (records["form"] == EULER).all()
    assert forces[-1, 1] == pytest.approx(-weight(sim), rel=1e-5)
    assert abs(forces[-1, [0, 2]]).max() <= 1e-5 * weight(sim)
    assert abs(sim.world.v).max() <= 1e-8
    rows, expected = sim.contact.contact_input(), reference.contact.contact_input()
    assert records["contacts"][-1] == (rows.force > 0).sum() == 25
    assert np.allclose(rows.stiffness, expected.stiffness, rtol=1e-9)
    assert abs(sim.world.x - reference.world.x).max() <= 1e-9


@pytest.mark.parametrize("scheme", SCHEMES)
def test_friction_holds_below_its_limit_and_lets_go_beyond(scheme):
    for degrees in (-0.5, 0.5):
        angle = np.arctan(0.5) + np.radians(degrees)
        sim = under(scheme, gravity=(G * np.sin(angle), -G * np.cos(angle), 0))
        driver = Driver(sim)
        driver.advance(60)
        before, velocity = sim.world.x.mean(axis=0), mean_velocity(sim)
        records = driver.advance(60)
        assert (
            not records["status"].any() and records["iterations"].mean() <= 10
        )  # of a factor, or more of block Jacobi
        if degrees < 0:
            assert np.linalg.norm(sim.world.x.mean(axis=0) - before) <= 1e-6
        else:
            expected = G * (np.sin(angle) - 0.5 * np.cos(angle))
            assert (mean_velocity(sim) - velocity)[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("friction", [0.1, 0.5])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_stops_where_a_rigid_block_stops(scheme, friction):
    dt, v = 1 / 60, 1.0
    sim = under(scheme, floor(friction), velocity=(v, 0, 0), friction=friction, dt=dt)
    start = sim.world.x.mean(axis=0)
    Driver(sim).advance(120)
    assert abs(sim.world.v).max() <= 1e-6
    assert (sim.world.x.mean(axis=0) - start)[0] == pytest.approx(v**2 / (2 * friction * G) - v * dt / 2, rel=5e-3)


@pytest.mark.parametrize("speed", [1.0, 10.0, 50.0])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_an_impact_without_friction_keeps_momentum_along_the_floor(scheme, speed):
    solver = LOCKSTEP | {"tolerance": 1e-8}
    sim = under(scheme, floor(0.0), velocity=(0.3 * speed, -speed, 0), friction=0.0, at=(0, 0.02, 0), solver=solver)
    momentum = sim.world.mass @ sim.world.v
    records, forces = reactions(sim, 30)
    assert not records["status"].any() and not records["clipped"].any()
    after = sim.world.mass @ sim.world.v
    assert after[0] == pytest.approx(momentum[0], rel=1e-6)
    assert abs(after[2]) <= 1e-6 * momentum[0]
    own = records["form"] != EULER
    assert (forces[own] == 0).all() and (forces[~own, 1] < 0).any()
    impulse = -forces[:, 1].sum() * sim.world.dt
    assert after[1] - momentum[1] == pytest.approx(impulse - weight(sim) * 30 * sim.world.dt, rel=1e-5)


def of_start(sim: Simulation, record: Any) -> float:
    """Kinetic, elastic and gravity, and what contacts store."""
    rows = sim.contact.contact_input()
    stored = (rows.force**2 + (rows.traction**2).sum(axis=1)) @ (0.5 / rows.stiffness)
    return float(record["kinetic"] + record["elastic"] + record["gravity"] + stored)


@pytest.mark.parametrize("start", [
    {"at": (0, 0.1, 0), "rotate": (30, 20, 40)},
    {"velocity": (20, -20, 0), "at": (0, 0.1, 0), "rotate": (10, 0, 40)},
], ids=["tumble", "throw"])  # fmt: skip
@pytest.mark.parametrize("scheme", SCHEMES)
def test_energy_never_passes_that_of_the_start(scheme, start):
    """2000 steps of an undamped block that tumbles, bounces, slides and rests."""
    sim = under(scheme, cells=(2, 2, 2), solver={"preconditioner": "block_jacobi"}, **start)
    sim.engine.loop.energy_every = 1
    energy = []
    for _ in range(2000):
        sim.engine.run(1)
        record = sim.engine.records()[0]
        assert record["status"] in (STATUS["CONVERGED"], STATUS["CONTACT"])
        energy.append(of_start(sim, record))
    assert max(energy) <= energy[0] + 1e-6 * abs(energy[0])
    assert max(energy[1000:]) <= energy[1000] + 1e-6 * abs(energy[0])
    assert abs(sim.world.v).max() <= 1e-6, "it has come to rest"


# --- forms ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [LOCKSTEP, {"preconditioner": "block_jacobi"}], ids=["factor", "block_jacobi"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_body_that_touches_nothing_moves_as_without_the_effect_to_the_bit(scheme, solver):
    def fall(contact: Any, obstacles: list[dict]) -> np.ndarray:
        table = {k: v for k, v in block(**FAR).items() if k != "friction" or contact}
        sim = over(*obstacles, objects=[table], contact=contact, integrator={"scheme": scheme}, solver=solver)
        records = Driver(sim).advance(20)
        assert (records["form"] != EULER).all()
        return np.concatenate([sim.world.x.ravel(), sim.world.v.ravel(), records["residual"], records["iterations"]])

    assert np.array_equal(fall(True, [floor()]), fall(None, []))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_records_tell_the_form_of_each_step(scheme):
    """It falls, touches, and lies: its own steps until the first touch, backward Euler from then on."""
    sim = under(scheme, at=(0, 0.05, 0))
    records = Driver(sim).advance(60)
    first = int(np.argmax(records["contacts"] > 0))
    own = [ITERATE, FACTOR] if scheme == "ros2" else [ONE_SOLVE]
    assert first > 3 and np.isin(records["form"][:first], own).all()
    assert (records["form"][first:] == EULER).all() and (records["contacts"][first:] > 0).all()
    assert (records["passes"][first : first + 3] > 0).all() and not records["passes"][:first].any()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_what_bounces_goes_on_by_its_own_scheme_once_it_is_free(scheme):
    """Thrown at the floor without gravity: the first step without a force of contact is the last of backward Euler."""
    sim = under(scheme, velocity=(0, -3, 0), at=(0, 0.0035, 0), gravity=(0, 0, 0), young=3e6, dt=2e-4)
    records = Driver(sim).advance(40)
    touching = np.flatnonzero(records["contacts"])
    last = touching[-1] + 1
    assert records["form"][last] == EULER and not records["contacts"][last]
    assert (records["form"][last + 1 :] != EULER).all() and len(records) - last > 10
    assert sim.world.v[:, 1].mean() > 0.5
    before = mean_velocity(sim)
    Driver(sim).advance(10)
    assert np.allclose(mean_velocity(sim), before, rtol=0, atol=1e-5 * abs(before[1]))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_each_body_goes_its_own_way(scheme):
    """One lies on the floor, another falls beside it as it does alone, to the bit."""
    lying, falling = block(name="lying"), block(name="falling", at=(1, 3, 0), rotate=(5, 10, 15))
    both = under(scheme, objects=[lying, falling], solver={"preconditioner": "block_jacobi"})
    alone = under(scheme, objects=[falling], solver={"preconditioner": "block_jacobi"})
    records = Driver(both).advance(20)
    Driver(alone).advance(20)
    assert (records["form"][records["body"] == 0] == EULER).all()
    assert (records["form"][records["body"] == 1] != EULER).all()
    assert np.array_equal(both.world.x[both.world.bodies[1].nodes], alone.world.x)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_is_of_second_order_until_it_touches(scheme):
    """A block that vibrates a little as it falls: error of x and v before the first touch, by halving the step."""

    def fall(steps: int, name: str = scheme) -> np.ndarray:
        solver = {"preconditioner": "block_jacobi", "tolerance": 1e-11, "max_iterations": 3000}
        sim = under(name, dt=0.06 / steps, at=(0, 0.0225, 0), solver=solver, young=3e3)
        x = sim.world.x
        sim.world.v[:, 0] = 1e-3 * np.cos(np.pi * (x[:, 0] - x[:, 0].min()) / 0.1)
        records = Driver(sim).advance(steps)
        assert (records["form"] != EULER).all() or name == "backward_euler"
        end = np.stack([sim.world.x, sim.world.v])
        assert (Driver(sim).advance(steps // 3)["contacts"] > 0).any()
        return end

    exact = fall(960, "newmark")
    error = [np.linalg.norm(fall(steps) - exact, axis=(1, 2)) for steps in (60, 120)]
    assert (np.log2(error[0] / error[1]) > 1.8).all()


# --- fast bodies, several bodies --------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.005, 0.03])
@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_no_node_passes_a_plate(scheme, speed, dt):
    sim = under(scheme, plate(0.002), velocity=(0.2 * speed, -speed, 0), dt=dt, at=(0, 0.05, 0), **SMALL)
    for _ in range(int(0.05 / speed / dt) + 12):
        sim.engine.run(1)
        assert (surface(sim)[:, 1] > 0).all()
    assert np.isfinite(sim.world.v).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_plate_that_comes_from_far_away_in_one_step(scheme):
    """The stages leave the body where it is, and the plate passes through: it goes back, and is pushed."""
    dt = 1 / 60
    keys = [{"time": 3 * dt, "translate": [0, -0.5, 0]}, {"time": 4 * dt, "translate": [0, 0.05, 0]}]
    swung = {"name": "plate", "shape": "box", "size": [4, 0.002, 4], "keyframes": keys}
    sim = under(scheme, swung, at=(0, 0.02, 0), gravity=(0, 0, 0), dt=dt, **SMALL)
    sim.engine.run(4)
    records = sim.engine.records()
    assert (records["form"][:3] != EULER).all() and records["form"][3] == EULER
    assert (surface(sim)[:, 1] > 0.051).all()


@pytest.mark.parametrize("speed", [0.5, 5.0])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_bodies_that_collide_in_free_flight_keep_their_momentum(scheme, speed):
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-12, "max_iterations": 3000}
    contact = {"thickness": D, "tolerance": 1e-6, "passes": 200}
    sim = collision(speed, 0.5, solver, contact, integrator={"scheme": scheme})
    linear, angular = momenta(sim)
    size = sim.world.mass.sum() * speed
    sim.engine.run(int(0.3 / speed / sim.world.dt) + 4)
    records = sim.engine.records()
    assert inside(sim, 0, 1) == inside(sim, 1, 0) == 0
    assert records["contacts"].any() and not records["clipped"].any()
    assert speed > 1 or set(records["form"]) - {EULER}  # at 5 m/s the estimates of ros2 are too large
    after, turned = momenta(sim)
    assert abs(after - linear).max() <= 1e-9 * size
    if scheme == "ros2":  # the others lose angular momentum in free flight
        assert abs(turned - angular).max() <= 0.1 * size * 0.1
    relative = np.diff([sim.world.v[b.nodes].mean(axis=0) for b in sim.world.bodies], axis=0)
    assert np.linalg.norm(relative) < 1.9 * speed  # it was a collision


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha"])
def test_with_newton_raphson_in_flight_colliding_bodies_keep_their_spin_too(scheme):
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-12, "max_iterations": 3000}
    newton = {"scheme": scheme, "linearizations": 20, "tolerance": 1e-10}
    sim = collision(0.5, 0.5, solver, {"thickness": D, "tolerance": 1e-6, "passes": 200}, integrator=newton)
    linear, angular = momenta(sim)
    sim.engine.run(30)
    records = sim.engine.records()
    assert not records["status"].any() and records["contacts"].any()
    flying = records["form"] == ONE_SOLVE
    assert (records["linearizations"][~flying] == 1).all() and (records["linearizations"][flying] > 1).any()
    assert (records["nonlinear"][~flying] < 0).all()
    after, turned = momenta(sim)
    assert abs(after - linear).max() <= 1e-9 * sim.world.mass.sum() * 0.5
    assert abs(turned - angular).max() <= 0.02 * abs(angular).max()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_fast_body_stops_at_one_that_flies_by_its_own_scheme(scheme):
    """Before the step neither has a row: the sweep of their own paths sends both back."""
    wall = block(name="wall", cells=(4, 2, 4), size=(0.2, 0.02, 0.2), at=(-0.05, 0, -0.05), young=1e7)
    ball = block(name="ball", at=(0, 0.05, 0))
    for speed in (1.0, 10.0, 40.0):
        sim = under(scheme, floor(pose={"translate": [0, -100, 0]}), objects=[wall, ball], gravity=(0, 0, 0),
                    solver={"preconditioner": "block_jacobi"})  # fmt: skip
        flying = sim.world.bodies[1].nodes
        sim.world.v[flying] = (0, -speed, 0)
        sim.engine.run(max(3, int(0.05 / speed / sim.world.dt) + 2))
        assert sim.engine.records()["contacts"].any()
        middle = [sim.world.x[b.nodes, 1].mean() for b in sim.world.bodies]
        assert middle[1] > middle[0] + 0.02, speed


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_stack_stands(scheme):
    blocks = [block(name=f"b{i}", at=(0.003 * i, D + i * (0.06 + D), 0)) for i in range(2)]
    sim = under(scheme, objects=blocks)
    Driver(sim).advance(150)
    _, forces = reactions(sim, 1)
    assert -forces[:, 1].sum() == pytest.approx(weight(sim), rel=1e-4)
    assert abs(sim.world.v).max() <= 1e-5


@pytest.mark.parametrize("scheme", SCHEMES)
def test_one_that_forces_make_nan_goes_back_and_the_other_rests(scheme):
    sim = under(scheme, objects=[block(name="a"), block(name="b", at=(0, D, 0.3))])
    Driver(sim).advance(60)
    x = sim.world.x[sim.world.bodies[0].nodes].copy()
    sim.world.x[sim.world.bodies[1].nodes] = np.nan
    records = Driver(sim).advance(5)
    assert (records["status"][records["body"] == 1] != STATUS["CONVERGED"]).any()
    assert abs(sim.world.x[sim.world.bodies[0].nodes] - x).max() <= 1e-8


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_repeats_to_the_bit(scheme, threads):
    ends = []
    for _ in range(2):
        sim = collision(3.0, solver=LOCKSTEP | {"threads": threads}, integrator={"scheme": scheme})
        records = Driver(sim).advance(10)
        assert (records["contacts"] > 0).any()
        ends.append(np.concatenate([sim.world.x.ravel(), records["iterations"], records["form"]]))
    assert np.array_equal(*ends)


def test_a_factor_that_knows_contacts_is_not_used_alone():
    """It lies until its factor is that of backward Euler, and is thrown up: it iterates until another has come."""
    sim = under("ros2")
    driver = Driver(sim)
    driver.advance(60)
    sim.world.v[:] = (0, 3, 0)
    forms = driver.advance(20)["form"].tolist()
    free = forms.index(ITERATE)
    assert set(forms[:free]) == {EULER} and FACTOR in forms[free:]
    assert abs(sim.world.v[:, 1].mean() - 3 + G * 20 / 60) <= 1e-3 * 3


def test_a_factor_of_the_scheme_itself_is_used_alone_again_after_a_long_touch():
    sim = under("ros2", solver=LOCKSTEP | {"update": "never"}, at=(0, 0.01, 0))
    driver = Driver(sim)
    assert FACTOR in driver.advance(60)["form"]
    sim.world.v[:] = (0, 3, 0)
    forms = driver.advance(10)["form"].tolist()
    assert forms[0] == EULER and forms[-5:] == [FACTOR] * 5
