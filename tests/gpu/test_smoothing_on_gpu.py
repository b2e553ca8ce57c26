# SPDX-License-Identifier: MIT
"""Solves of a GPU that go on with a smoothed factor (smoothing_state.cuh), beside the CPU's. Runs where there is a GPU:
pytest -m gpu."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from tests.scenes import bar, factor_of, scene

pytestmark = pytest.mark.gpu
CELLS, SIZE = (40, 10, 10), (4.0, 1.0, 1.0)  # 4961 nodes
STEPS = 30


def falling(device: str, cells: tuple[int, int, int] = CELLS) -> tuple[Simulation, NDArray[Any], NDArray[Any]]:
    """Records and positions of a beam whose soft end is let go, with a factor of the matrix of step 6."""
    body = bar(cells, SIZE, fixed="X < 0.01", damping=(0.1, 0.0), poisson=0.45)
    body["effects"]["corotational"]["young"] = [{"where": "X < 1.3", "young": 5e6}, {"young": 1e4}]
    given = scene(body, gravity=(0, -9.81, 0), dt=0.03, preconditioner="cholesky", max_iterations=2000)
    sim, on_cpu = Simulation(given, device), Simulation(given)
    on_cpu.engine.run(6)
    on_cpu.engine.assemble()
    pattern, values = factor_of(on_cpu, dtype=np.float32)
    sim.engine.run(6)
    sim.engine.post_factor(0, pattern, values, step=5)
    sim.engine.settle_factors()
    sim.engine.records()
    sim.engine.run(STEPS)
    records = sim.engine.records()
    return sim, records, sim.fetch().x.copy()


def slow_factor(sim: Simulation) -> int | None:
    """Step of the factor with which a solve was slow last; None where none goes on smoothed."""
    return next((int(a.read()[0]) for a in sim.engine.state() if a.name == "engine.smoothing.slow"), None)


def test_slow_solves_go_on_with_fewer_iterations_and_repeat_to_the_bit():
    sim, records, x = falling("gpu")
    (_, again, x_again), (_, on_cpu, x_on_cpu) = falling("gpu"), falling("cpu")
    assert (records["status"] == 0).all() and (records["residual"] <= 1e-6).all() and not records["fallbacks"].any()
    assert slow_factor(sim) == 5  # the solves at the end were slow with that of step 5
    assert records["iterations"][-1] < 0.5 * on_cpu["iterations"][-1]  # with the factor as it is
    np.testing.assert_array_equal(records["iterations"], again["iterations"])
    np.testing.assert_array_equal(x, x_again)
    assert np.abs(x - x_on_cpu).max() < 1e-3


def test_small_bodies_and_other_scenes_have_the_solver_as_it_was():
    sim, records, _ = falling("gpu", (8, 3, 3))
    assert slow_factor(sim) is None and (records["status"] == 0).all()
