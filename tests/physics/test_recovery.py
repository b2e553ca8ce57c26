# SPDX-License-Identifier: MIT
"""Stable Neo-Hookean bodies from states that no run should reach by itself, and what projection does for them.

The integrator makes one linearization a step. From there clamping suffices at moderate Poisson's ratios; near
incompressibility its steps overshoot further and further, while with absolute eigenvalues the energy may rise in single
steps, and the body gets out.
"""

from typing import Any

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.updates.driver import Driver
from tests.hard_cases.starts import Start, flattened, mirrored, random_in_box
from tests.physics.laws import LAWS, deform, determinants, law_bar, stiffness

STARTS = {"random": random_in_box, "plane": flattened(2), "line": flattened(1, 2), "inside out": mirrored(0)}


def run(start: Start, poisson: float, projection: str, steps: int, **scene: Any):
    """The simulation of a free damped bar, energies and least J (steps + 1,)."""
    sim = law_bar(
        "stable_neo_hookean", cells=(2, 2, 4), size=(1, 1, 2), table={"young": 1e6, "poisson": poisson},
        damping=(2.0, 0.0), dt=1 / 60, preconditioner="cholesky", projection=projection,
        **({"update": "lockstep-10"} | scene),
    )  # fmt: skip
    start(sim)
    driver, J, energy = Driver(sim), [determinants(sim).min()], [sim.potential_energy()]
    for _ in range(steps):
        records = driver.advance(1)
        assert "integrator" in scene or records["status"][0] == SolveStatus.CONVERGED
        J.append(determinants(sim).min())
        energy.append(sim.potential_energy() + sim.kinetic_energy())
    return sim, np.array(energy), np.array(J)


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
def test_it_comes_back_to_its_rest_shape(start):
    sim, energy, J = run(start, 0.3, "clamp", 300)
    assert J[0] <= 0 and (J[120:] > 0).all()
    assert np.abs(determinants(sim) - 1).max() < 1e-3
    assert energy[-1] < 1e-9 * energy[0]


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
@pytest.mark.parametrize("poisson", [0.45, 0.49])
def test_nearly_incompressible_ones_turn_upright_with_absolute_eigenvalues(start, poisson):
    """Every J > 0 soon; without self-contact the body may stay folded through itself, at rest."""
    _, energy, J = run(start, poisson, "absolute", 100)
    assert (J[60:] > 0).all()
    assert J[0] <= 0 and energy[-1] < 0.5 * energy[0]


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
def test_with_several_linearizations_they_turn_upright_and_the_energy_never_rises(start):
    _, energy, J = run(start, 0.49, "clamp", 40, integrator={"linearizations": 20}, update="every-1")
    assert J[0] <= 0 and (J[25:] > 0).all()
    assert (np.diff(energy) <= 1e-9 * energy[0]).all()


@pytest.mark.parametrize("name", ["neo_hookean", "st_venant_kirchhoff"])
def test_without_projection_the_factor_is_still_positive_definite(name):
    """A stiff body pressed together: A is indefinite, and what preconditions is not."""
    table = {"young": 1e7, "poisson": 0.3}
    sim = law_bar(
        name, cells=(4, 2, 2), size=(2, 1, 1), table=table, projection="none", preconditioner="cholesky",
        update="every-1", dt=0.05,
    )  # fmt: skip
    sim.world.x *= [0.62, 1.0, 1.0]
    deform(sim, 0.02)
    sim.world.v[:] = 0
    A = stiffness(sim) * 0.05**2 + np.diag(np.repeat(sim.world.mass, 3))
    assert np.linalg.eigvalsh(A)[0] < -1
    driver = Driver(sim)
    records = driver.advance(1)
    assert (driver.bodies[0].factors.used, driver.bodies[0].factors.regularized, driver.bodies[0].failures.refused) == (
        1,
        1,
        0,
    )
    assert np.isfinite(sim.world.x).all() and np.isfinite(records["residual"]).all()


@pytest.mark.parametrize("projection", ["clamp", "absolute"])
@pytest.mark.parametrize("name", ["neo_hookean", "st_venant_kirchhoff", "mooney_rivlin", "ogden", "costa"])
def test_projected_matrices_need_no_mending(name, projection):
    law = LAWS[name]
    sim = law_bar(
        law, cells=(4, 2, 2), size=(2, 1, 1), projection=projection, preconditioner="cholesky", update="every-1"
    )
    sim.world.x *= [0.7, 1.0, 1.0]
    driver = Driver(sim)
    records = driver.advance(5)
    assert (records["status"] == SolveStatus.CONVERGED).all()
    assert driver.bodies[0].factors.regularized == 0 and driver.bodies[0].factors.used == 5
