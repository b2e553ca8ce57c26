# SPDX-License-Identifier: MIT
"""Factors refreshed on a GPU where a body has changed most (refresh_state.cuh). Runs where there is a GPU:
pytest -m gpu."""

from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.gpu.refresh import LocalRefresh
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, scene

pytestmark = pytest.mark.gpu


def fall(refreshed: bool, steps: int = 24, **solver: Any) -> tuple[NDArray[Any], NDArray[Any], list[int]]:
    """Records, last positions, and nodes of T of steps with the factor of the first one's matrix."""
    young = [{"where": "X < 1.3", "young": 2e6}, {"young": 2e4}]
    beam = bar((24, 8, 8), size=(4, 1, 1), young=young, fixed="X < 0.01", poisson=0.45)
    given = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-6, "max_iterations": 2000} | solver
    with patch.object(LocalRefresh, "wanted", LocalRefresh.wanted if refreshed else lambda *_: None):
        sim = Simulation(scene(beam, gravity=(0, -9.81, 0), dt=0.02, **given), "gpu")
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    found, used = [], []
    for _ in range(steps):
        found.append(driver.advance(1))
        used.append(sim.engine.refreshed(0))  # type: ignore[attr-defined]
    sim.fetch()
    return np.concatenate(found), sim.world.x.copy(), used


@pytest.mark.parametrize("precision", ["mixed", "float64", "float32"])
def test_an_old_factor_takes_fewer_iterations_to_the_same_state(precision):
    (with_it, x, used), (without, plain, _) = fall(True, precision=precision), fall(False, precision=precision)
    for records in (with_it, without):
        assert (records["status"] == 0).all() and not records["fallbacks"].any()
        assert (records["residual"] <= 1e-6).all()
    assert np.abs(x - plain).max() < (1e-3 if precision == "float32" else 1e-4)
    assert max(used) > 0 and with_it["iterations"].sum() < 0.8 * without["iterations"].sum(), used


def test_a_run_repeats_to_the_bit():
    (one, x, _), (other, again, _) = fall(True), fall(True)
    assert np.array_equal(x, again) and np.array_equal(one["iterations"], other["iterations"])
