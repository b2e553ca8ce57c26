# SPDX-License-Identifier: MIT
"""Holders against known answers: frames in motion, stretched bars, momentum, energy."""

import numpy as np
import pytest

from tests.holders.holder_scenes import held_bar, left, right

VELOCITY = np.array([1.0, 2.0, 0.5])
SCHEMES = {
    "backward_euler": {}, "newmark": {"scheme": "newmark"}, "bdf2": {"scheme": "bdf2"},
    "newton": {"linearizations": 20, "tolerance": 1e-10},
    "alpha": {"scheme": "generalized_alpha"},
    "alpha_newton": {"scheme": "generalized_alpha", "linearizations": 20, "tolerance": 1e-10},
    "newmark_newton": {"scheme": "newmark", "linearizations": 20, "tolerance": 1e-10},
    "ros2": {"scheme": "ros2"},
}  # fmt: skip
SPIN = [{"time": t / 4, "rotate": [0, 0, 90.0 * t]} for t in range(9)]  # a quarter of a turn in 0.25 s


def reactions(sim):
    return sim.engine.records_and_reactions()[1]


@pytest.mark.parametrize("motion", [{}, {"moved": "client"}, {"keyframes": [{"time": 0.0}, {"time": 1.0}]}])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_holder_at_rest_is_fixed_nodes_to_the_bit(scheme, motion):
    keys = {"gravity": (0, -9.81, 0), "integrator": SCHEMES[scheme], "touch": True, "damping": (0.2, 0.01)}
    fixed, held = held_bar(fixed="X < 0.01", **keys), held_bar(left(**motion), **keys)
    for sim in (fixed, held):
        sim.engine.run(15)
    np.testing.assert_array_equal(held.world.x, fixed.world.x)
    np.testing.assert_array_equal(held.world.v, fixed.world.v)
    then, now = fixed.engine.records(), held.engine.records()
    for name in ("iterations", "residual", "work", "kinetic"):
        np.testing.assert_array_equal(now[name], then[name])


@pytest.mark.parametrize("scheme", [*SCHEMES, "quasi_static"])
def test_a_bar_that_moves_with_its_holder_is_not_strained(scheme):
    """Translation at constant velocity: no force, and no error of any scheme."""
    integrator = SCHEMES.get(scheme, {"scheme": scheme})
    away = (2 * VELOCITY).tolist()
    sim = held_bar(left(keyframes=[{"time": 0.0}, {"time": 2.0, "translate": away}]), integrator=integrator)
    begun, moving = sim.world.x.copy(), scheme != "quasi_static"
    sim.world.v[:] = VELOCITY if moving else 0
    sim.engine.run(12)
    np.testing.assert_allclose(sim.world.x, begun + 0.12 * VELOCITY, atol=1e-9)
    np.testing.assert_allclose(sim.world.v, np.broadcast_to(VELOCITY, begun.shape), atol=1e-7)
    assert np.abs(reactions(sim)[1:]).max() < 1e-5 * 1e5


def test_momentum_is_what_holders_and_gravity_give():
    """In each step, with damping, while the end moves and turns."""
    keys = [{"time": 0.0}, {"time": 0.2, "translate": [0, 0.1, 0.3], "rotate": [0, 80, 30]}, {"time": 0.3}]
    sim = held_bar(left(keyframes=keys), right(), gravity=(0, -9.81, 0), damping=(0.5, 0.01))
    mass, dt = sim.world.mass, sim.world.dt
    for _ in range(40):
        before = mass @ sim.world.v
        sim.engine.run(1)
        force = -reactions(sim)[0, :, :3].sum(axis=0) + mass.sum() * np.array([0, -9.81, 0])
        force -= 0.5 * mass @ sim.world.v
        np.testing.assert_allclose(mass @ sim.world.v - before, dt * force, atol=1e-7 * mass.sum())


def test_work_of_a_holder_is_counted():
    """A bar that is stretched slowly has the work of its holder as elastic energy, nearly."""
    keys = [{"time": 0.0}, {"time": 2.0, "translate": [0.02, 0, 0]}]
    sim = held_bar(left(), right(keyframes=keys), poisson=0.0, damping=(0, 0.01), dt=0.02)
    sim.engine.loop.energy_every = 1
    sim.engine.run(100)
    last = sim.engine.records()[-1]
    elastic = 0.5 * 1e5 * 1 / 2 * 0.02**2  # E A / (2 L) u^2
    assert last["elastic"] == pytest.approx(elastic, rel=1e-3)
    assert last["work"] == pytest.approx(elastic, rel=0.03)
    assert last["work"] > last["elastic"] + last["kinetic"]


@pytest.mark.parametrize("integrator", [{"scheme": "quasi_static"}, {"scheme": "quasi_static", "linearizations": 20}])
def test_the_force_of_a_stretched_bar_is_that_of_its_section(integrator):
    """Poisson's ratio 0: E A u / L, on one end and, the other way, on the other; it is the bar's internal force."""
    integrator["tolerance"] = 1e-12
    keys = [{"time": 0.0}, {"time": 0.01, "translate": [0.05, 0, 0]}]
    sim = held_bar(left(), right(keyframes=keys), poisson=0.0, integrator=integrator)
    sim.engine.run(6)
    force = reactions(sim)[-1, :, :3]
    pull = 1e5 * 1 / 2 * 0.05
    np.testing.assert_allclose(force, [[pull, 0, 0], [-pull, 0, 0]], atol=1e-9 * pull * 10)
    np.testing.assert_allclose(sim.world.x[:, 0], sim.world.rest[:, 0] * (1 + 0.05 / 2), atol=1e-10)


def test_reactions_are_the_internal_forces_of_held_nodes():
    """At rest under its weight: that of the assembled forces there, and weights are carried."""
    sim = held_bar(left(), right(), gravity=(0, -9.81, 0), integrator={"scheme": "quasi_static"})
    sim.engine.run(60)
    force = reactions(sim)[-1]
    sim.engine.assemble()
    held = sim.world.free == 0
    internal = sim.system.b[held].sum(axis=0) / sim.world.dt
    np.testing.assert_allclose(force[:, :3].sum(axis=0), internal, rtol=1e-9, atol=1e-9 * np.abs(internal).max())
    np.testing.assert_allclose(force[:, :3].sum(axis=0), [0, -9.81 * sim.world.mass.sum(), 0], atol=1e-5)
    assert force[0, 5] == pytest.approx(-force[1, 5], rel=0.05) and abs(force[0, 5]) > 1


def test_a_bar_that_turns_with_its_holder_has_the_momentum_of_a_rigid_one():
    """Constant rate about z through its end: after the start has died away the nodes go in circles."""
    sim = held_bar(left(keyframes=SPIN, center=[0, 0.5, 0.5]), young=1e7, damping=(0, 0.05))
    sim.engine.run(100)
    rate, arm = 2 * np.pi, sim.world.x - [0, 0.5, 0.5]
    circling = np.cross([0, 0, rate], arm)
    away = np.linalg.norm(sim.world.v - circling, axis=1).max()
    assert away < 0.06 * rate * 2  # backward Euler has chords for arcs, and the bar is drawn out by its rotation
    held = sim.world.free == 0
    turned = sim.world.x[held] - [0, 0.5, 0.5]
    np.testing.assert_allclose(turned, (sim.world.rest[held] - [0, 0.5, 0.5]), atol=1e-9)  # a whole turn
    spin, rigid = (np.cross(arm, sim.world.mass[:, None] * v).sum(axis=0)[2] for v in (sim.world.v, circling))
    assert spin == pytest.approx(rigid, rel=0.02)


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha", "ros2"])
def test_velocities_of_held_nodes_are_those_of_the_motion(scheme):
    sim = held_bar(left(keyframes=SPIN, center=[0, 0.5, 0.5]), integrator={"scheme": scheme}, young=1e6)
    sim.engine.run(13)
    held = sim.world.free == 0
    expected = np.cross([0, 0, 2 * np.pi], sim.world.x[held] - [0, 0.5, 0.5])
    np.testing.assert_allclose(sim.world.v[held], expected, atol=1e-9)


def test_a_frozen_body_is_not_moved():
    sim = held_bar(left(keyframes=[{"time": 0.0}, {"time": 0.05, "translate": [0, 3e4, 0]}]))
    sim.engine.run(10)
    assert sim.engine.records()["status"][-1] == 8 or (sim.world.free == 0).all()
    x = sim.world.x.copy()
    sim.engine.run(5)
    np.testing.assert_array_equal(sim.world.x, x)
    assert not reactions(sim)[-1].any()


def test_iterations_do_not_grow_with_motion():
    """A bar in motion with its end takes as many as one that is let go with it fixed."""
    keys = {"gravity": (0, -9.81, 0), "solver": {"tolerance": 1e-6, "warm_start": False}}
    still = held_bar(left(), **keys)
    moved = held_bar(left(keyframes=[{"time": 0.0}, {"time": 0.5, "translate": [0, 0.5, 0]}]), **keys)
    counts = []
    for sim in (still, moved):
        sim.engine.run(40)
        counts.append(sim.engine.records()["iterations"].mean())
    assert counts[1] < 1.1 * counts[0]
