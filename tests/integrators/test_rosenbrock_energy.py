# SPDX-License-Identifier: MIT
"""Undamped motion in Rosenbrock-W steps: its energy does not rise, with the matrix of the step or an older factor."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

SOLVES = ["iterate", "auto"]


def hanging(young: float, split: str, dt: float, damping: float = 0.0, **options: Any) -> Simulation:
    """A bar of 4 m that hangs along x."""
    mesh = {"bar": [4, 1, 1], "size": [4, 1, 1], "split": split}
    held = bar(mesh=mesh, young=young, poisson=0.45, fixed="X < 0.01", damping=(damping, 0.0))
    table: dict[str, Any] = {"preconditioner": "cholesky", "update": "lockstep-5", **options}
    return simulation(held, gravity=(9.81, 0, 0), dt=dt, **table)


@cache
def still(young: float, split: str) -> NDArray:
    """Where it hangs."""
    sim = hanging(young, split, 0.1, 5.0, preconditioner="block_jacobi", max_iterations=2000)
    sim.engine.run(300)
    return sim.world.x.copy()


def kicked(young: float, split: str, dt: float, solve: str, kick: float, seconds: float) -> tuple[NDArray, NDArray]:
    """Energy above that of the bar at rest after each 0.2 s, over the kinetic energy of the kick; numbers of forms."""
    sim = hanging(young, split, dt, integrator={"scheme": "ros2", "solve": solve})
    sim.world.x[:] = still(young, split)
    static = sim.potential_energy()
    sim.world.v[:, 1] = kick * (sim.world.rest[:, 0] / 4) ** 2
    sim.world.v[:, 2] = 0.5 * kick * np.sin(sim.world.rest[:, 0]) * sim.world.free
    whole, driver, found, forms = sim.kinetic_energy(), Driver(sim), [], []
    for _ in range(round(seconds / 0.2)):
        forms.append(driver.advance(round(0.2 / dt))["form"])
        found.append((sim.kinetic_energy() + sim.potential_energy() - static) / whole)
    return np.array(found), np.bincount(np.concatenate(forms), minlength=4)


def check(found: NDArray) -> None:
    """The energy falls but for beats of the elements' rotations, and is never above that at the start."""
    assert found.max() < 1 and np.diff(found).max() < 5e-4 and found.min() > 0, found


@pytest.mark.parametrize("solve", SOLVES)
@pytest.mark.parametrize("dt", [0.01, 0.04])
@pytest.mark.parametrize("young", [1e6, 1e7])
def test_a_kicked_bar_under_tension(young, dt, solve):
    """6 s. With the usual tangent and one linearization Newmark's scheme flies apart."""
    found, forms = kicked(young, "mirrored", dt, solve, 5.0, 6)
    check(found)
    assert forms[FORMS["FACTOR" if solve == "auto" else "ITERATE"]] > 0.9 * forms.sum() and not forms[FORMS["EULER"]]


# Small steps, which take longest, of the stiff bar alone, the smallest by factors alone.
MINUTES = [
    (young, dt, solve)
    for young in (1e6, 1e7) for dt in (0.005, 0.01, 0.02, 0.04) for solve in SOLVES
    if dt > 0.01 or (young > 1e6 and (dt == 0.01 or solve == "auto"))
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("young", "dt", "solve"), MINUTES)
@pytest.mark.parametrize("split", ["mirrored", "kuhn"])
def test_a_minute_of_it(young, split, dt, solve):
    """The kick is 5 m/s at the end, or 1 cm/s; a small one loses little with small steps."""
    for kick in (5.0, 0.01):
        found, forms = kicked(young, split, dt, solve, kick, 60)
        check(found)
        assert not forms[FORMS["EULER"]]
    assert found[-1] > {0.005: 0.85, 0.01: 0.65, 0.02: 0.5, 0.04: 0.15}[dt]
