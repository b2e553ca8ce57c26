# SPDX-License-Identifier: MIT
"""Recycled directions: they make old factors better and change no answer."""

import numpy as np
import pytest

from protocol.factor import FactorPattern
from sim_server.driver import Driver
from sim_server.engine import Kind
from sim_server.simulation import Simulation
from tests.scenes import bar, factor_of, simulation
from tests.solver.solves import bent, solve, true_residual


def wrong_factor(sim: Simulation) -> tuple[FactorPattern, np.ndarray]:
    """Of another bar of the same mesh: a useful but poor preconditioner."""
    return factor_of(bent(seed=5, dt=0.1))


def with_factor(recycle: int, **solver) -> Simulation:
    sim = bent(recycle=recycle, preconditioner="cholesky", warm_start=False, **solver)
    sim.engine.post_factor(0, *wrong_factor(sim), 0)
    return sim


def test_a_system_solved_once_is_solved_again_in_one_iteration():
    """M y = s for all pairs of a solve, so M b = x."""
    sim = with_factor(64, tolerance=1e-5)
    y, first = solve(sim)
    again, second = solve(sim)
    assert 4 < first["iterations"] <= 64
    assert second["iterations"] <= 2
    assert true_residual(sim, again) <= 1e-5 and second["status"] == 0
    np.testing.assert_allclose(again, y, rtol=0, atol=1e-4 * np.abs(y).max())


def test_fewer_pairs_help_less_and_none_not_at_all():
    counts = []
    for recycle in (0, 4, 64):
        sim = with_factor(recycle, tolerance=1e-8)
        counts.append([int(solve(sim)[1]["iterations"]) for _ in range(2)])
    none, few, many = counts
    assert none[0] == none[1] == few[0] == many[0]
    assert many[1] < few[1] < none[1]


@pytest.mark.parametrize("kind", [Kind.NONE, Kind.BLOCK_JACOBI])
def test_only_factors_are_corrected(kind):
    plain, recycling = bent(), bent(recycle=16)
    for _ in range(3):
        y, r = solve(plain, kind=kind, warm_start=0)
        other, s = solve(recycling, kind=kind, warm_start=0)
    assert y.tobytes() == other.tobytes() and r["iterations"] == s["iterations"]


def moving(recycle: int, update: str = "lockstep-8", **solver) -> tuple[Simulation, np.ndarray]:
    beam = bar((6, 3, 3), (4, 1, 1), young=2e5, fixed="X < 0.01", pose={"rotate": [40, 0, 70]})
    sim = simulation(beam, gravity=(0, -4, 0), preconditioner="cholesky", update=update, recycle=recycle, **solver)
    return sim, Driver(sim).advance(40)


@pytest.mark.parametrize("warp", [True, False])
def test_an_old_factor_gets_better_and_the_motion_stays_the_same(warp):
    plain, without = moving(0, warp=warp, tolerance=1e-9)
    sim, records = moving(16, warp=warp, tolerance=1e-9)
    assert (records["status"] == 0).all()
    old = records["factor_step"] >= 0
    assert records["iterations"][old].sum() < 0.9 * without["iterations"][old].sum()
    np.testing.assert_allclose(sim.world.x, plain.world.x, rtol=0, atol=1e-6)


def test_a_run_repeats_bit_for_bit():
    (one, first), (two, second) = moving(8), moving(8)
    assert one.world.x.tobytes() == two.world.x.tobytes()
    assert first["iterations"].tolist() == second["iterations"].tolist()


def test_what_led_astray_is_forgotten():
    """A factor without use is left for block Jacobi within the solve; its directions are not used again."""
    sim = with_factor(8)
    solve(sim)
    assert sim.engine._body[0].recycled.stored > 0
    pattern, values = wrong_factor(sim)
    sim.engine.post_factor(0, pattern, np.full_like(values, np.nan), 1)
    _, record = solve(sim)
    assert record["fallbacks"] == 1 and record["status"] == 0
    assert sim.engine._body[0].recycled.stored == 0
