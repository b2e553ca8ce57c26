# SPDX-License-Identifier: MIT
"""Order two of Rosenbrock-W steps whatever the tangent, the damping and the age of the factor: by halving the step."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

END = 0.48  # s, a swing down and part of the way back
STEPS = (128, 256)
ELASTIC = {"young": 2e5, "poisson": 0.4}
LAWS: dict[str, tuple[str, dict[str, Any]]] = {
    "corotational": ("corotational", ELASTIC),
    "qr": ("corotational", {**ELASTIC, "rotation": "qr"}),
    "exact": ("corotational", {**ELASTIC, "tangent": "exact"}),
    "mass_spring": ("mass_spring", {"young": 2e5}),
    "stable_neo_hookean": ("stable_neo_hookean", ELASTIC),
    "st_venant_kirchhoff": ("st_venant_kirchhoff", ELASTIC),
}
FACTORS = {"iterate": "lockstep-1", "age 3": "lockstep-3", "unwarped": "lockstep-3"}


def swing(law: str, beta: float, dt: float, integrator: dict[str, Any], **solver: Any) -> Simulation:
    name, given = LAWS[law]
    effects = {name: given, "fixed": {"where": "X < 0.01"}, "rayleigh": {"mass": 0.5, "stiffness": beta}}
    return simulation(
        {**bar((4, 1, 1), (2, 0.5, 0.5), young=None), "effects": effects}, gravity=(0, -9.81, 0), dt=dt,
        preconditioner="cholesky", integrator=integrator, **solver,
    )  # fmt: skip


@cache
def start(law: str) -> NDArray:
    """x and v after 0.2 s of a fall whose vibrations are damped out."""
    sim = swing(law, 0.1, 0.002, {})
    sim.engine.run(100)
    return np.stack([sim.world.x, sim.world.v])


@cache
def end(law: str, beta: float, steps: int, factor: str) -> NDArray:
    """x and v, (2, n, 3), at the end of the swing."""
    sim = swing(
        law, beta, END / steps, {"scheme": "ros2", "solve": "iterate" if factor == "iterate" else "auto"},
        update=FACTORS[factor], factor_precision="float64", tolerance=1e-11, warp=factor != "unwarped",
    )  # fmt: skip
    w = sim.world
    w.x[:], w.v[:] = start(law)
    records = Driver(sim).advance(steps)
    assert (records["status"] == 0).all() and not (records["form"] == FORMS["EULER"]).any()
    assert factor == "iterate" or (records["form"] == FORMS["FACTOR"]).sum() >= steps - 3
    return np.stack([w.x, w.v])


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("beta", [0.0, 0.02])
@pytest.mark.parametrize("law", LAWS)
def test_order(law, beta, factor):
    """Of x and of v. Where vibrations are damped and the factor is old, errors of third order are the larger ones."""
    exact = end(law, beta, 1024, "iterate")
    error = [np.linalg.norm(end(law, beta, n, factor) - exact, axis=(1, 2)) for n in STEPS]
    found = np.log2(error[0] / error[1])
    assert found.min() > 1.9, found
    assert found.max() < 2.3 or beta > 0, found
