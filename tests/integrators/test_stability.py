# SPDX-License-Identifier: MIT
"""Schemes of second order with one linearization a step: the energy of undamped motion does not grow.

One linearization with a stiffness below the slope of the forces overshoots a little in each step, and the energy grows
exponentially; the usual tangent of corotational elements is such a stiffness under tension, so a bar that hangs
straight down and is kicked a little shows it within seconds.
"""

from typing import Any

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.scenes import bar, simulation

SCHEMES = ["newmark", "bdf2", "generalized_alpha"]
SOLVER = {"preconditioner": "block_jacobi", "max_iterations": 2000}
ELASTIC = {"young": 2e5, "poisson": 0.45}
LAWS: dict[str, dict[str, Any]] = {
    "corotational": ELASTIC,
    "mass_spring": {"young": 2e5},
    "stable_neo_hookean": ELASTIC,
    "neo_hookean": ELASTIC,
    "st_venant_kirchhoff": ELASTIC,
}


def held(law: str, g: tuple[float, float, float], damping: float = 0.0, **table: Any) -> Simulation:
    """A bar of 4 m along x, fixed at x = 0, of E = 0.2 MPa."""
    effects = {law: LAWS[law], "fixed": {"where": "X < 0.01"}, "rayleigh": {"mass": damping}}
    made = bar((4, 1, 1), (4, 1, 1), young=None)
    return simulation({**made, "effects": effects}, gravity=g, **SOLVER, **table)


def kicked(law: str, scheme: str, dt: float) -> list[float]:
    """Energy above that of the bar hanging along x at rest, over the kinetic energy of the kick, every two seconds."""
    still = held(law, (9.81, 0, 0), damping=5.0, dt=0.1)
    still.engine.run(300)
    sim = held(law, (9.81, 0, 0), dt=dt, integrator={"scheme": scheme})
    sim.world.x[:] = still.world.x
    static = sim.potential_energy()
    sim.world.v[:] = 1e-3 * sim.world.free[:, None] * np.random.default_rng(0).normal(size=sim.world.x.shape)
    kick, found = sim.kinetic_energy(), [1.0]
    for _ in range(10):
        sim.engine.run(round(2 / dt))
        found.append((sim.kinetic_energy() + sim.potential_energy() - static) / kick)
    return found


@pytest.mark.parametrize("dt", [0.04, 0.02, 0.01, 0.002])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_kicked_bar_under_tension_calms_down(scheme, dt):
    """20 s; with the usual tangent the energy is 1e43 times the kick's (newmark, 20 ms)."""
    found = kicked("corotational", scheme, dt)
    assert np.diff(found).max() < 0 and found[-1] > 0, found


@pytest.mark.parametrize("law", [law for law in LAWS if law != "corotational"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_so_it_does_of_every_law(scheme, law):
    found = kicked(law, scheme, 0.02)
    assert np.diff(found).max() < 1e-6, found


@pytest.mark.parametrize("dt", [0.04, 0.01])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_swing_without_damping_never_rises_above_its_start(scheme, dt):
    sim = held("corotational", (0, -9.81, 0), dt=dt, integrator={"scheme": scheme})
    start, highest = sim.potential_energy(), -np.inf
    for _ in range(200):
        sim.engine.run(round(0.2 / dt))
        highest = max(highest, sim.kinetic_energy() + sim.potential_energy())
    assert (sim.engine.records()["status"] == 0).all()
    assert highest < start * (1 + 1e-4)  # the first steps, of 40 ms, are off by 3e-5


@pytest.mark.parametrize("scheme", SCHEMES)
def test_with_damping_it_comes_to_rest_and_stays_there(scheme):
    """The usual tangent leaves the rest again."""
    sim = held("corotational", (9.81, -1, 0), damping=1.0, dt=0.02, integrator={"scheme": scheme})
    sim.engine.run(1500)
    there = sim.world.x.copy()
    assert np.abs(sim.world.v).max() < 1e-5
    sim.engine.run(1500)
    assert np.abs(sim.world.v).max() < 1e-9 and np.abs(sim.world.x - there).max() < 1e-6
