# SPDX-License-Identifier: MIT
"""Holders with ros2: order, forms of the step, forces."""

import numpy as np
import pytest

from sim_server.backends.rosenbrock import FORMS
from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.holders.holder_scenes import held_bar, left, right

EULER, ITERATE, FACTOR = (FORMS[name] for name in ("EULER", "ITERATE", "FACTOR"))
ROS2 = {"scheme": "ros2"}
LOCKSTEP = {"preconditioner": "cholesky", "update": "lockstep-3", "factor_precision": "float64"}
SHORT = {"cells": (4, 1, 2), "gravity": (0, -9.81, 0)}


def reactions(sim: Simulation) -> np.ndarray:
    found: np.ndarray = sim.engine.records_and_reactions()[1]
    return found


def wave(count: int) -> list[dict]:
    """Keyframes of a smooth motion in which a holder shifts and turns."""
    times = np.linspace(0, 0.4, count)
    return [{"time": t, "translate": [0.02 * np.sin(3 * t) ** 2, 0.1 * np.sin(2 * t) ** 2, 0],
             "rotate": [0, 0, 23 * np.sin(2 * t) ** 2]} for t in times.tolist()]  # fmt: skip


def test_bodies_whose_holders_move_are_followed_to_second_order():
    def end(steps: int) -> np.ndarray:
        sim = held_bar(left(), right(keyframes=wave(161)), integrator=ROS2, dt=0.2 / steps, **SHORT)
        sim.engine.run(steps)
        records = sim.engine.records()
        assert (records["form"] == ITERATE).all() and not records["status"].any()
        free = sim.world.free > 0
        return np.stack([sim.world.x[free], sim.world.v[free]])

    coarse, middle, fine = (end(steps) for steps in (20, 40, 80))
    order = np.log2(abs(coarse - middle).max(axis=(1, 2)) / abs(middle - fine).max(axis=(1, 2)))
    assert (order > 1.7).all()


def test_a_stiff_bar_follows_its_holder():
    """Stiff modes have no part in the motion of the boundary: the bar goes with it, without overshoot."""
    keys = [{"time": 0.0}, {"time": 0.1}, {"time": 0.3, "translate": [0.1, 0.05, 0]}, {"time": 0.4}]
    bars = [left(keyframes=keys), right(keyframes=keys)]
    sim = held_bar(*bars, integrator=ROS2, young=1e9, dt=0.01, cells=(4, 1, 2))
    for _ in range(29):
        sim.engine.run(1)
        moved = sim.world.x - sim.world.rest
        assert np.abs(moved - moved[sim.holders.node[0]]).max() <= 1e-4


def test_with_a_holder_at_rest_the_factor_stands_alone_as_with_fixed_nodes():
    sims = [held_bar(*holders, integrator=ROS2, solver=LOCKSTEP, touch=True, **SHORT, **fixed)
            for holders, fixed in (((), {"fixed": "X < 0.01"}), ((left(moved="client"),), {}))]  # fmt: skip
    then, now = (Driver(sim).advance(20) for sim in sims)
    assert (now["form"][5:] == FACTOR).all() and np.array_equal(now["form"], then["form"])
    assert np.array_equal(sims[0].world.x, sims[1].world.x) and np.array_equal(sims[0].world.v, sims[1].world.v)


def test_a_body_iterates_while_its_holder_moves():
    keys = [
        {"time": 0.0},
        {"time": 0.1},
        {"time": 0.15, "translate": [0, 0.01, 0]},
        {"time": 9.0, "translate": [0, 0.01, 0]},
    ]
    sim = held_bar(left(), right(keyframes=keys), integrator=ROS2, solver=LOCKSTEP, **SHORT)
    forms = Driver(sim).advance(30)["form"]
    assert (forms[10:15] == ITERATE).all() and (forms[5:10] == FACTOR).all() and (forms[-5:] == FACTOR).all()


def test_forces_at_rest_are_those_that_carry_the_weight_and_in_motion_those_that_change_the_momentum():
    sim = held_bar(left(), right(keyframes=wave(161)), integrator=ROS2, damping=(1.0, 0.01), **SHORT)
    mass, dt = sim.world.mass, sim.world.dt
    largest = off = 0.0
    for _ in range(25):
        before = mass @ sim.world.v
        sim.engine.run(1)
        force = -reactions(sim)[0, :, :3].sum(axis=0) + mass.sum() * np.array([0, -9.81, 0])
        force -= 0.5 * (before + mass @ sim.world.v)
        off = max(off, np.abs((mass @ sim.world.v - before) / dt - force).max())
        largest = max(largest, np.abs(force).max())
    assert off <= 0.05 * largest
    still = held_bar(left(), right(), integrator=ROS2, damping=(20.0, 0.02), **SHORT)
    still.engine.run(400)
    carried = reactions(still)[-1, :, :3]
    np.testing.assert_allclose(carried.sum(axis=0), [0, -9.81 * still.world.mass.sum(), 0], atol=1e-4)
    np.testing.assert_allclose(carried[0, 1], carried[1, 1], rtol=0.05)


def test_a_step_that_is_made_again_by_backward_euler_has_its_forces_and_work():
    """An error bound that no step by stages keeps: held nodes and forces are those of backward Euler."""
    keys = [{"time": 0.0}, {"time": 0.2, "translate": [0, 0.02, 0]}]
    bound = ROS2 | {"error_bound": 1e-12}
    sims = [held_bar(left(), right(keyframes=keys), integrator=i, tangent="usual", **SHORT) for i in (bound, {})]
    told = []
    for sim in sims:
        sim.engine.run(10)
        records, forces = sim.engine.records_and_reactions()
        told.append((records["work"], forces))
        assert sim is sims[1] or (records["form"] == EULER).all()
    np.testing.assert_allclose(sims[0].world.x, sims[1].world.x, atol=1e-9)
    np.testing.assert_allclose(told[0][1], told[1][1], atol=1e-6 * np.abs(told[1][1]).max())
    np.testing.assert_allclose(told[0][0], told[1][0], atol=1e-6 * np.abs(told[1][0]).max())


def test_a_frozen_body_is_not_moved():
    keys = [{"time": 0.0}, {"time": 0.05, "translate": [0, 3e4, 0]}]
    sim = held_bar(left(keyframes=keys), integrator=ROS2, cells=(3, 1, 1))
    sim.engine.run(10)
    assert sim.engine.records()["status"][-1] == 7
    x = sim.world.x.copy()
    sim.engine.run(3)
    np.testing.assert_array_equal(sim.world.x, x)
    assert not reactions(sim)[-1].any()


def test_a_gpu_refuses_them():
    with pytest.raises(InputError, match=r"'ros2' on a GPU; allowed: .* --device cpu"):
        held_bar(left(), integrator=ROS2, device="gpu")
