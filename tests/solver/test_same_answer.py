# SPDX-License-Identifier: MIT
"""No answer depends on the preconditioner, the warp, the age of a factor or where a solve starts."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.driver import Driver
from tests.scenes import bar, simulation

STEPS, TOLERANCE = 40, 1e-10
WAYS = {
    "none": {"preconditioner": "none"},
    "jacobi": {"preconditioner": "jacobi"},
    "block_jacobi, cold": {"preconditioner": "block_jacobi", "warm_start": False},
    "cholesky never": {"preconditioner": "cholesky", "update": "never"},
    "cholesky never, unwarped": {"preconditioner": "cholesky", "update": "never", "warp": False},
    "cholesky every-1": {"preconditioner": "cholesky", "update": "every-1", "factor_precision": "float64"},
    "cholesky every-7": {"preconditioner": "cholesky", "update": "every-7"},
    "cholesky lockstep-3": {"preconditioner": "cholesky", "update": "lockstep-3"},
    "cholesky async": {"preconditioner": "cholesky", "update": "async"},
    "auto lockstep-3": {"preconditioner": "auto", "update": "lockstep-3"},
    "auto async": {"preconditioner": "auto", "update": "async"},
    "auto every-7": {"preconditioner": "auto", "update": "every-7"},
}


def trajectory(tolerance: float = TOLERANCE, **solver) -> tuple[NDArray, NDArray]:
    """(steps, nodes, 3) of a soft posed beam that falls far, and the records."""
    beam = bar((6, 2, 2), (3, 1, 1), young=2e5, fixed="X < 0.01", damping=(0.1, 0.0), pose={"rotate": [40, 0, 70]})
    sim = simulation(
        beam, bar(name="free", young=1e5), gravity=(0, -9.81, 0), tolerance=tolerance, max_iterations=5000, **solver
    )
    sim.world.v[sim.world.bodies[1].nodes] += np.random.default_rng(0).normal(size=(45, 3))
    driver, frames, records = Driver(sim), [], []
    for _ in range(STEPS):
        records.append(driver.advance(1))
        frames.append(sim.world.x.copy())
    return np.array(frames), np.concatenate(records)


@pytest.fixture(scope="module")
def reference() -> NDArray:
    return trajectory(1e-13, preconditioner="block_jacobi")[0]


@pytest.mark.parametrize("solver", WAYS.values(), ids=WAYS.keys())
def test_the_trajectory_is_the_same(solver, reference):
    """To 1e-7 of a fall of metres over 40 steps, each solved to 1e-10."""
    frames, records = trajectory(**solver)
    assert (records["status"] == 0).all()
    assert (records["residual"] <= TOLERANCE).all()
    assert np.abs(reference[-1] - reference[0]).max() > 1
    assert np.abs(frames - reference).max() < 1e-7


def test_the_deviation_is_the_tolerance(reference):
    """A looser solve deviates in proportion, about: what is bought with a tolerance is accuracy, nothing else."""
    deviation = {
        t: np.abs(trajectory(t, preconditioner="block_jacobi")[0] - reference).max() for t in (1e-3, 1e-6, 1e-9)
    }
    assert deviation[1e-3] < 0.1
    assert deviation[1e-6] < 1e-2 * deviation[1e-3]
    assert deviation[1e-9] < 1e-2 * deviation[1e-6]


@pytest.mark.parametrize("solver", [WAYS["auto lockstep-3"], WAYS["cholesky every-7"]], ids=["auto", "every-7"])
def test_a_run_repeats_bit_for_bit(solver):
    """auto counts bytes, not seconds, where runs must repeat."""
    (first, a), (second, b) = trajectory(**solver), trajectory(**solver)
    assert np.array_equal(first, second)
    for field in ("iterations", "factor_step", "kind", "residual"):
        assert np.array_equal(a[field], b[field])
