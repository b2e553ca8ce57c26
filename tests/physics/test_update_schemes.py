# SPDX-License-Identifier: MIT
"""The order of the schemes of Courtecuisse et al. 2010, figure 4, in iterations: the beam bends under gravity."""

from pathlib import Path

import pytest

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver

pytestmark = pytest.mark.slow
BEAM = Path(__file__).resolve().parents[2] / "deploy" / "scenes" / "beam.toml"
STEPS, LATENCY = 150, 30


def mean_iterations(*solver: str) -> float:
    """Over the steps in which the asynchronous schemes have a factor."""
    simulation = Simulation.load(BEAM, [f"solver.{key}" for key in solver])
    records = Driver(simulation).advance(STEPS)
    assert (records["status"] == 0).all()
    return float(records["iterations"][LATENCY:].mean())


@pytest.fixture(scope="module")
def mean() -> dict[str, float]:
    cholesky, lockstep = "preconditioner=cholesky", f"update=lockstep-{LATENCY}"
    return {
        "cg": mean_iterations("preconditioner=none"),
        "pcg30": mean_iterations(cholesky, f"update=every-{LATENCY}", "warp=false"),
        "async": mean_iterations(cholesky, lockstep, "warp=false"),
        "async+warp": mean_iterations(cholesky, lockstep, "warp=true"),
    }


def test_warp_makes_an_old_factor_young(mean: dict[str, float]) -> None:
    assert mean["async+warp"] <= 0.6 * mean["async"]
    assert mean["async+warp"] <= 0.1 * mean["cg"]


def test_asynchronous_factors_are_older_and_cost_iterations(mean: dict[str, float]) -> None:
    """Sections 5 and 6: what the asynchronous update loses the warp wins back, and more."""
    assert mean["async+warp"] < mean["pcg30"] < mean["async"]
