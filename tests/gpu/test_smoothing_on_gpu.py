# SPDX-License-Identifier: MIT
"""Solves of a GPU that go on with a smoothed factor (smoothing_state.cuh), beside the CPU's. Runs where there is a GPU:
pytest -m gpu."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.backends.gpu import smoothing
from sim_server.scene import Scene
from sim_server.simulation import Simulation
from tests.scenes import bar, factor_of, scene

pytestmark = pytest.mark.gpu
CELLS, SMALL = (25, 8, 8), (8, 3, 3)  # 2106 and 144 nodes
STEPS = 20


@pytest.fixture(autouse=True)
def large_from_1000_nodes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoothing, "LEAST_NODES", 1000)


def scene_of(cells: tuple[int, int, int]) -> Scene:
    """A beam whose soft end is let go."""
    body = bar(cells, (4.0, 1.0, 1.0), fixed="X < 0.01", damping=(0.1, 0.0), poisson=0.45)
    body["effects"]["corotational"]["young"] = [{"where": "X < 1.3", "young": 5e6}, {"young": 1e4}]
    return scene(body, gravity=(0, -9.81, 0), dt=0.03, preconditioner="cholesky", max_iterations=2000)


@cache
def factor_of_step_5(cells: tuple[int, int, int]) -> tuple[FactorPattern, NDArray[Any]]:
    sim = Simulation(scene_of(cells))
    sim.engine.run(6)
    sim.engine.assemble()
    return factor_of(sim, dtype=np.float32)


def falling(device: str, cells: tuple[int, int, int] = CELLS) -> tuple[Simulation, NDArray[Any], NDArray[Any]]:
    """Records and positions after it, with a factor that is as old as they are many."""
    sim = Simulation(scene_of(cells), device)
    sim.engine.run(6)
    sim.engine.post_factor(0, *factor_of_step_5(cells), step=5)
    sim.engine.settle_factors()
    sim.engine.records()
    sim.engine.run(STEPS)
    records = sim.engine.records()
    return sim, records, sim.fetch().x.copy()


def slow_factor(sim: Simulation) -> int | None:
    """Step of the factor with which a solve was slow last; None where none goes on smoothed."""
    return next((int(a.read()[0]) // 2 for a in sim.engine.state() if a.name == "engine.smoothing.slow"), None)


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
    sim, records, _ = falling("gpu", SMALL)
    assert slow_factor(sim) is None and (records["status"] == 0).all()
