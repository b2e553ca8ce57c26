# SPDX-License-Identifier: MIT
"""The simulation of many servers: known answers, and the same figures from the same seed."""

from dataclasses import replace

import pytest

from tests.bench.scale.__main__ import figures
from tests.bench.scale.measured import Motion, body
from tests.bench.scale.policies import POLICIES
from tests.bench.scale.simulate import Plan, Run, quantiles

SMALL = Plan(servers=20, workers=4, pools=2, racks=2, warm=1.0, seconds=4.0, touched=0.4)


def test_quantiles_of_ages_that_grow_in_time() -> None:
    assert quantiles([(0.0, 1.0)], (0.5, 0.99)) == pytest.approx([0.5, 0.99])
    assert quantiles([(0.0, 1.0), (0.0, 3.0)], (0.5, 0.75)) == pytest.approx([1.0, 2.0], abs=1e-3)


def test_excess_grows_with_age_up_to_a_bound() -> None:
    motion = Motion(0.5, 4.0)
    assert [motion.excess(age) for age in (-1, 0, 2, 8, 100)] == [0, 0, 1, 4, 4]


def test_one_worker_of_one_server_makes_a_factor_every_two_steps() -> None:
    """Copied at a step, used at the next one, the next one copied at that after it: ages from one step to three."""
    plan = Plan(policy="fixed", servers=1, workers=1, pools=1, racks=1, warm=1.0, seconds=5.0, link=1e15)
    run = Run(plan).run()
    (server,) = run.servers
    assert server.body.factor < server.dt
    ages = run.ages[True] + run.ages[False]
    assert quantiles(ages, (0.0, 0.5, 1.0)) == pytest.approx([server.dt, 2 * server.dt, 3 * server.dt], rel=1e-2)
    assert run.factors == pytest.approx(4.0 / (2 * server.dt), abs=2)


def test_a_router_bounds_what_passes() -> None:
    plan = replace(SMALL, policy="fixed", link=1e7)
    run = Run(plan).run()
    assert max(run.carried) <= 1.25 * plan.link * (plan.seconds - plan.warm)
    assert run.factors < Run(replace(plan, link=1e10)).run().factors / 4


@pytest.mark.parametrize("policy", POLICIES)
def test_the_same_seed_gives_the_same_figures(policy: str) -> None:
    plan = replace(SMALL, policy=policy)
    assert figures(Run(plan).run(), "") == figures(Run(plan).run(), "")
    assert figures(Run(replace(plan, seed=1)).run(), "") != figures(Run(plan).run(), "")


def test_a_lost_rack_makes_no_factors_until_it_is_back() -> None:
    plan = replace(SMALL, policy="fixed", racks=1, lost=2.0, away=1.0)
    run = Run(replace(plan, seconds=3.0)).run()
    assert all(not worker.queue and not worker.busy for worker in run.workers)
    made = [server.made for server in run.servers]
    assert max(made) < 2.0
    assert max(server.made for server in Run(plan).run().servers) > 3.0


def test_pages_have_what_is_read_from_them() -> None:
    small, large = body(540), body(24000)
    assert small.factor < large.factor and small.bytes < large.bytes and small.worst > small.step
