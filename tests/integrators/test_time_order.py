# SPDX-License-Identifier: MIT
"""Order of convergence in time of each scheme, by halving the step."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from tests.physics.test_cantilever import lowest_mode
from tests.scenes import bar, simulation

END = 2.0  # s; the lowest mode has a period of 6.2 s
ORDER = {"backward_euler": 1, "newmark": 2, "bdf2": 2, "generalized_alpha": 2}
STEPS = (100, 200, 400)


def beam(steps: int, damping: float, tangent: str = "auto", **integrator) -> Simulation:
    return simulation(
        bar((6, 1, 1), (3, 0.5, 0.5), young=1e5, fixed="X < 0.01", damping=(0, damping), tangent=tangent),
        dt=END / steps, tolerance=1e-11, preconditioner="block_jacobi", max_iterations=3000, integrator=integrator,
    )  # fmt: skip


@cache
def mode() -> tuple[float, NDArray]:
    """Angular frequency and shape, largest displacement 1."""
    frequency, shape = lowest_mode(beam(100, 0.0))
    return frequency, shape / np.abs(shape).max()


@cache
def swing(scheme: str, steps: int, linearizations: int, tangent: str = "usual") -> NDArray:
    """x and v at the end, let go from the bent shape, a tenth of the length at the tip; high modes, which no step here
    would resolve, are damped out (with the tangent, so that the motion depends on which one it is)."""
    sim = beam(steps, 0.1, tangent, scheme=scheme, linearizations=linearizations, tolerance=1e-9)
    sim.world.x += 0.3 * mode()[1]
    sim.engine.run(steps)
    assert (sim.engine.records()["status"] == 0).all()
    return np.stack([sim.world.x, sim.world.v])


def orders(scheme: str, linearizations: int, tangent: str = "usual") -> NDArray:
    """Orders of x and v from each halving of the step, (halvings, 2)."""
    exact = swing("newmark", 3200 if tangent == "usual" else 1600, 40, tangent)
    error = [np.linalg.norm(swing(scheme, n, linearizations, tangent) - exact, axis=(1, 2)) for n in STEPS]
    return np.log2(np.array(error[:-1]) / error[1:])


@pytest.mark.parametrize("scheme", ORDER)
def test_order_of_a_large_swing_with_newton(scheme):
    found = orders(scheme, 40)
    assert np.abs(found - ORDER[scheme]).max() < 0.1, found


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha"])
def test_one_linearization_with_an_inexact_tangent_costs_an_order(scheme):
    """The exact tangent, too, is clamped under compression (docs/scenes.md); with backward Euler nothing is lost."""
    assert 0.9 < orders(scheme, 1, "exact")[-1, 0] < 1.3
    assert np.abs(orders("backward_euler", 1) - 1).max() < 0.1


@pytest.mark.parametrize("scheme", ORDER)
def test_one_mode_with_one_linearization(scheme):
    """Small strains, the exact solution known: q'' = -w^2 q, let go with a speed."""
    w, shape = mode()
    error = []
    for steps in (25, 50, 100):
        sim = beam(steps, 0.0, scheme=scheme)
        sim.world.x += 1e-7 * shape
        sim.world.v += 1e-7 * 0.5 * w * shape
        sim.engine.run(steps)
        q = np.cos(w * END) + 0.5 * np.sin(w * END)
        rate = w * (0.5 * np.cos(w * END) - np.sin(w * END))
        displaced = sim.world.x - sim.world.rest - 1e-7 * q * shape
        error.append(np.linalg.norm([w * displaced, sim.world.v - 1e-7 * rate * shape]))
    found = np.log2(np.array(error[:-1]) / error[1:])
    assert np.abs(found - ORDER[scheme]).max() < 0.1, (found, error)


def test_newmark_with_other_parameters():
    """gamma above 1/2 takes energy and an order; beta alone does not."""
    w, shape = mode()

    def error(steps: int, beta: float, gamma: float) -> float:
        sim = beam(steps, 0.0, scheme="newmark", beta=beta, gamma=gamma)
        sim.world.x += 1e-7 * shape
        sim.engine.run(steps)
        return float(np.abs(sim.world.x - sim.world.rest - 1e-7 * np.cos(w * END) * shape).max())

    for beta, gamma, order in ((0.25, 0.5, 2), (0.3, 0.5, 2), (0.3025, 0.6, 1), (0.5, 1.0, 1)):
        assert np.log2(error(200, beta, gamma) / error(400, beta, gamma)) == pytest.approx(order, abs=0.1)
