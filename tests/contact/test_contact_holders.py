# SPDX-License-Identifier: MIT
"""Holders that press a body onto a floor: where it touches, held nodes and the forces on them are backward Euler's."""

from typing import Any

import numpy as np
import pytest

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from tests.contact.scenes import D, block, over
from tests.contact.test_contact_answers import weight

SCHEMES = ("newmark", "bdf2", "generalized_alpha", "ros2")
TIGHT = {"preconditioner": "block_jacobi", "tolerance": 1e-10, "max_iterations": 3000, "on_runaway": "go_on"}
DOWN = [{"time": 0}, {"time": 0.2, "translate": [0, -0.01, 0]}, {"time": 9, "translate": [0, -0.01, 0]}]


def pressed(scheme: str, gap: float, beta: float = 0.0, objects: tuple[dict, ...] = (), **newton: Any) -> Simulation:
    body = block(cells=(3, 2, 3), at=(0, gap, 0), **({"damping": (0.0, beta)} if beta else {}))
    clamp = {"name": "clamp", "object": body["name"], "where": "Y > 0.0599", "keyframes": DOWN}
    return over(objects=[body, *objects], holders=[clamp], dt=0.01, solver=TIGHT, contact={"thickness": D},
                integrator={"scheme": scheme, **newton})  # fmt: skip


def forces(sim: Simulation, steps: int) -> tuple[np.ndarray, np.ndarray]:
    sim.engine.run(steps)
    return sim.engine.records_and_reactions()


@pytest.mark.parametrize("beta", [0.0, 0.01])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_body_that_touches_all_along_is_held_as_in_backward_euler(scheme, beta):
    sims = [pressed(name, 0.001, beta) for name in (scheme, "backward_euler")]
    (records, on), (expected, on_expected) = (forces(sim, 30) for sim in sims)
    assert (records["form"] == FORMS["EULER"]).all() and (records["contacts"] > 0).all()
    np.testing.assert_allclose(sims[0].world.x, sims[1].world.x, atol=1e-12)
    np.testing.assert_allclose(on, on_expected, atol=1e-8 * np.abs(on_expected).max())
    np.testing.assert_allclose(records["work"], expected["work"], atol=1e-8 * np.abs(expected["work"]).max())


@pytest.mark.parametrize(
    ("scheme", "newton"),
    [*((s, {}) for s in SCHEMES), *((s, {"linearizations": 4}) for s in SCHEMES if s != "ros2")],
)
def test_one_that_comes_to_touch_is_pressed_as_far_as_its_holder_goes(scheme, newton):
    """Beside another one that flies all along, whose own steps must leave the forces on the holder alone."""
    flying = block(name="flying", cells=(1, 1, 1), at=(1, 3, 0))
    sim = pressed(scheme, 0.007, 0.0, (flying,), **newton)
    records, on = forces(sim, 60)
    own, bystander = records.reshape(-1, 2)["form"].T
    assert (own[:3] != FORMS["EULER"]).all() and (own[-5:] == FORMS["EULER"]).all()
    assert (bystander != FORMS["EULER"]).all()
    held = sim.holders.node
    assert np.abs(sim.world.x[held] - sim.holders.next).max() <= 1e-12
    floor_force, clamp_force = on[-2, 0, 1], on[-2, 1, 1]
    assert clamp_force > 10 * weight(sim)
    lying = sim.world.mass[sim.world.bodies[0].nodes].sum() * 9.81
    assert floor_force + clamp_force == pytest.approx(-lying, abs=1e-3 * clamp_force)
