# SPDX-License-Identifier: MIT
"""Momentum and angular momentum of free, vibrating, tumbling bars in Rosenbrock-W steps, 1000 of them."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.integrators.test_conserved import spin
from tests.scenes import bar, simulation

STEPS = 1000


def tumbling(
    dt: float, update: str, solve: str = "auto", young: float = 2e5, rate: float = 2.0, **table: Any
) -> Simulation:
    """2 m long; 1.1 m/s, turning at `rate` [1/s], with a bending vibration of 0.3 m/s."""
    sim = simulation(
        bar((4, 2, 2), (2, 1, 1), young=young), dt=dt, preconditioner="cholesky", update=update,
        integrator={"scheme": "ros2", "solve": solve}, **table,
    )  # fmt: skip
    w = sim.world
    arm = w.x - w.mass @ w.x / w.mass.sum()
    axis = rate * np.array([0.3, 1.0, 0.5]) / np.linalg.norm([0.3, 1.0, 0.5])
    w.v[:] = np.array([1.0, 0.5, -0.3]) + np.cross(axis, arm)
    w.v[:, 1] += 0.3 * arm[:, 0] ** 2
    return sim


def run(sim: Simulation) -> tuple[float, float, float, NDArray]:
    """What 1000 steps change: momentum, angular momentum, energy, each relative; records."""
    w = sim.world
    p, angular, energy = w.mass @ w.v, spin(sim), sim.kinetic_energy() + sim.potential_energy()
    records = Driver(sim).advance(STEPS)
    lost = np.linalg.norm(w.mass @ w.v - p) / np.linalg.norm(p)
    turned = np.linalg.norm(spin(sim) - angular) / np.linalg.norm(angular)
    kept = (sim.kinetic_energy() + sim.potential_energy()) / energy
    return float(lost), float(turned), float(kept), records


@pytest.mark.parametrize("young, rate", [(2e5, 2.0), (1e7, 3.0)])
@pytest.mark.parametrize("dt", [0.01, 0.02])
def test_a_free_body_keeps_its_momenta_by_iterations(dt, young, rate):
    """Without the momenta that its forces make, the stiff one would lose a fifth of its spin at 10 ms."""
    lost, turned, kept, records = run(tumbling(dt, "lockstep-5", "iterate", young, rate))
    assert (records["form"] == FORMS["ITERATE"]).all()
    assert lost < 1e-11 and turned < 1e-7 and 0.9 < kept < 1.001


@pytest.mark.parametrize("young, rate", [(2e5, 2.0), (1e7, 3.0)])
@pytest.mark.parametrize("dt, age", [(dt, age) for dt in (0.01, 0.02) for age in (1, 5, 10)])
def test_a_free_body_keeps_its_momenta_by_an_older_factor(dt, age, young, rate):
    lost, turned, kept, records = run(tumbling(dt, f"lockstep-{age}", young=young, rate=rate))
    assert np.bincount(records["form"], minlength=4).tolist() == [0, age, STEPS - age, 0]
    assert lost < 1e-11 and turned < 1e-5 and 0.9 < kept < 1.001


def test_forces_change_them():
    """A falling body has the momentum of its weight; one that something holds is left alone."""
    sim = tumbling(0.02, "lockstep-3", gravity=(0, -9.81, 0))
    w = sim.world
    p, g = w.mass @ w.v, w.mass.sum() * np.array([0, -9.81, 0])
    Driver(sim).advance(50)
    np.testing.assert_allclose(w.mass @ w.v, p + 50 * 0.02 * g, rtol=1e-12)
    held = simulation(
        bar((4, 2, 2), (2, 1, 1), young=2e5, fixed="X < 0.01"), gravity=(0, -9.81, 0), preconditioner="cholesky",
        integrator={"scheme": "ros2"},
    )  # fmt: skip
    assert held.integrator.unheld.tolist() == [0] and sim.integrator.unheld.tolist() == [1]
