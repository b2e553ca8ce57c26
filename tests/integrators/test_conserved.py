# SPDX-License-Identifier: MIT
"""Momentum, angular momentum and energy of each scheme."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from tests.physics.test_cantilever import lowest_mode
from tests.scenes import bar, simulation

SCHEMES = ["backward_euler", "newmark", "bdf2", "generalized_alpha"]
TIGHT = {"tolerance": 1e-13, "preconditioner": "block_jacobi", "max_iterations": 3000}


def energy(sim: Simulation) -> float:
    return sim.kinetic_energy() + sim.potential_energy()


def spin(sim: Simulation) -> NDArray:
    w = sim.world
    arm = w.x - w.mass @ w.x / w.mass.sum()
    return np.asarray(np.einsum("n,ni->i", w.mass, np.cross(arm, w.v)))


@pytest.mark.parametrize("linearizations", [1, 10])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_momentum_of_a_free_body(scheme, linearizations):
    integrator = {"scheme": scheme, "linearizations": linearizations, "tolerance": 1e-9}
    sim = simulation(bar((4, 2, 2), (2, 1, 1), young=2e5), dt=0.01, integrator=integrator, **TIGHT)
    sim.world.v[:] = np.random.default_rng(0).normal(size=sim.world.v.shape)
    before = sim.world.mass @ sim.world.v
    sim.engine.run(100)
    whole = np.linalg.norm(sim.world.mass[:, None] * sim.world.v, axis=1).sum()
    tolerance = 1e-12 if linearizations == 1 else 1e-11
    assert np.linalg.norm(sim.world.mass @ sim.world.v - before) < tolerance * whole


@pytest.mark.parametrize("rate", [1.0, 5.0])
def test_angular_momentum_that_backward_euler_loses(rate):
    """A stiff body turns by theta in a step and v' is the chord of its way: L' = m x' x v' = m r^2 sin(theta') / h.
    Inner forces have no torque about x', so L' = m x' x v too: tan(theta') = sin(theta) / (2 - cos(theta)), from
    tan(theta) = w h at the beginning. To leading order each step takes the part (w h)^2."""
    sim = simulation(
        bar((4, 2, 2), (2, 1, 1), young=1e9), dt=0.02, integrator={"linearizations": 30, "tolerance": 1e-9}, **TIGHT
    )
    centre = sim.world.mass @ sim.world.x / sim.world.mass.sum()
    sim.world.v[:] = np.cross([0.0, 0.0, rate], sim.world.x - centre)
    before = spin(sim)[2]
    theta = np.arctan(rate * 0.02)
    for _ in range(20):
        sim.engine.run(1)
        lost = 1 - np.sin(theta) / (rate * 0.02)
        assert 1 - spin(sim)[2] / before == pytest.approx(lost, rel=0.01)
        theta = np.arctan(np.sin(theta) / (2 - np.cos(theta)))
    assert sim.engine.records()["nonlinear"][1:].max() < 1e-8  # the first step begins without any force
    assert spin(sim)[2] / before == pytest.approx(np.exp(-20 * (rate * 0.02) ** 2), rel=0.05)


def test_one_linearization_keeps_the_angular_momentum_of_a_body_that_is_hardly_strained():
    """The tangent of corotational elements makes no torque about x, and x' = x + h v' has the moment of x with v'."""
    sim = simulation(bar((4, 2, 2), (2, 1, 1), young=1e9), dt=0.02, **TIGHT)
    centre = sim.world.mass @ sim.world.x / sim.world.mass.sum()
    sim.world.v[:] = np.cross([0.0, 0.0, 1.0], sim.world.x - centre)
    before = spin(sim)[2]
    sim.engine.run(20)
    assert abs(spin(sim)[2] / before - 1) < 1e-4


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("linearizations", [1, 30])
def test_energy_never_rises_in_backward_euler(seed, linearizations):
    sim = simulation(
        bar((4, 2, 2), (2, 1, 1), young=2e5), tolerance=1e-10, preconditioner="block_jacobi", max_iterations=2000,
        integrator={"linearizations": linearizations, "tolerance": 1e-8},
    )  # fmt: skip
    random = np.random.default_rng(seed)
    sim.world.x += 0.02 * random.normal(size=sim.world.x.shape)
    sim.world.v[:] = random.normal(size=sim.world.v.shape)
    history = [energy(sim)]
    for _ in range(60):
        sim.engine.run(1)
        history.append(energy(sim))
    assert np.diff(history).max() < 1e-9 * history[0]
    assert history[-1] < 0.5 * history[0]


def test_newmark_keeps_the_energy_of_a_linear_motion_and_bdf2_takes_little():
    """One mode at w h = 0.3, four periods: q' ends with the same energy; backward Euler has lost nearly all of it. The
    amplitude is so small that compression, where the exact tangent is clamped, hardly counts."""

    def beam(dt: float, **integrator) -> Simulation:
        return simulation(
            bar((6, 1, 1), (3, 0.5, 0.5), young=1e5, fixed="X < 0.01"), dt=dt, integrator=integrator,
            **TIGHT | {"tolerance": 1e-12},
        )  # fmt: skip

    w, shape = lowest_mode(beam(0.01))
    left = {}
    for scheme in SCHEMES:
        sim = beam(0.3 / w, scheme=scheme)
        sim.world.x += 1e-7 * shape / np.abs(shape).max()
        before = energy(sim)
        history = []
        for _ in range(84):
            sim.engine.run(1)
            history.append(energy(sim) / before)
        left[scheme] = history
    assert np.abs(np.array(left["newmark"]) - 1).max() < 1e-6
    assert left["backward_euler"][-1] == pytest.approx((1 + 0.3**2) ** -84, rel=0.01)
    assert 0.5 < left["bdf2"][-1] < 1
