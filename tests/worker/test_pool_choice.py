# SPDX-License-Identifier: MIT
"""Which servers the workers of a pool go to: a pool in simulated time, with needs that react to who serves."""

import random
from dataclasses import dataclass, field

from hypothesis import given, settings
from hypothesis import strategies as st

from precond_worker.network.pool_choice import MARGIN, REST, PoolChoice, ServerNeed

PERIOD = 0.5  # s between two needs that a server tells


@dataclass
class Pool:
    """Workers and servers; servers tell what was so one period ago. demands: time lost a second times workers"""

    demands: dict[str, float]
    workers: int
    seed: int = 0
    noise: float = 0.1
    now: float = 0.0
    told: dict[str, ServerNeed] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.choices = [PoolChoice(f"{self.seed}-{k}") for k in range(self.workers)]

    def shares(self) -> dict[str, float]:
        found = dict.fromkeys(self.demands, 0.0)
        for choice in self.choices:
            for name in choice.seats:
                if name in found:
                    found[name] += 1 / len(choice.seats)
        return found

    def run(self, seconds: float) -> int:
        """Returns the changes in that time."""
        before = sum(choice.changes for choice in self.choices)
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            told = {}
            for name, workers in self.shares().items():
                lost = self.demands[name] / max(workers, 0.5)
                told[name] = ServerNeed(lost * self.random.uniform(1 - self.noise, 1 + self.noise), workers)
            there = {name: need for name, need in self.told.items() if name in self.demands}
            for choice in self.choices:
                choice.update(there, self.now + self.random.random() * PERIOD)
            self.told = told
        return sum(choice.changes for choice in self.choices) - before


def balanced(pool: Pool) -> bool:
    """No worker could do much better elsewhere: D'Hondt's condition, with a margin for the noise."""
    shares = pool.shares()
    one = min(1 / len(choice.seats) for choice in pool.choices)
    return all(
        pool.demands[b] / (shares[b] + one) <= MARGIN * (1 + 2.5 * pool.noise) * pool.demands[a] / shares[a]
        for a in shares
        for b in shares
        if a != b and shares[a] > 1.5 * one  # the only one stays
    )


demands = st.lists(st.floats(0.05, 5.0), min_size=1, max_size=6)


@settings(max_examples=12, deadline=None)
@given(demands, st.integers(1, 16), st.integers(0, 1000))
def test_workers_settle_by_need_and_stay(wanted: list[float], workers: int, seed: int) -> None:
    pool = Pool({f"s{k}": d for k, d in enumerate(wanted)}, workers, seed)
    pool.run(150)
    assert pool.run(40) <= max(1, workers // 8), "they do not go to and fro"
    if workers >= len(wanted):
        assert all(len(choice.seats) == 1 for choice in pool.choices)
    assert all(share > 0 for share in pool.shares().values()), "nobody is left out"
    assert balanced(pool), (pool.demands, pool.shares())


@settings(max_examples=8, deadline=None)
@given(demands.filter(lambda d: len(d) > 1), st.integers(2, 12), st.integers(0, 1000))
def test_a_server_that_leaves_is_left_at_once(wanted: list[float], workers: int, seed: int) -> None:
    pool = Pool({f"s{k}": d for k, d in enumerate(wanted)}, workers, seed)
    pool.run(60)
    del pool.demands["s0"]
    pool.run(2 * PERIOD)
    assert all("s0" not in choice.seats for choice in pool.choices)
    assert all(choice.seats for choice in pool.choices), "each has another"


@settings(max_examples=8, deadline=None)
@given(demands, st.integers(2, 12), st.integers(0, 1000))
def test_a_newcomer_gets_its_part_and_no_more(wanted: list[float], workers: int, seed: int) -> None:
    pool = Pool({f"s{k}": d for k, d in enumerate(wanted)}, workers, seed)
    pool.run(120)
    pool.demands["new"] = max(pool.demands.values())
    pool.run(2 * workers + 4 * REST)
    assert pool.shares()["new"] > 0
    pool.run(120)
    assert balanced(pool), (pool.demands, pool.shares())


def test_shares_are_proportional_to_needs() -> None:
    pool = Pool({"small": 1.0, "large": 3.0}, 40)
    pool.run(200)
    assert abs(pool.shares()["large"] - 30) <= 3


def test_a_need_a_little_larger_is_no_reason_to_move() -> None:
    choice = PoolChoice(1)
    here = {"a": ServerNeed(1.0, 2.0)}
    assert choice.update(here, 0.0) == ("a",)
    for k in range(1, 400):
        assert choice.update({**here, "b": ServerNeed(0.8 * MARGIN * 2, 1.0)}, 0.5 * k) == ("a",)


def test_one_worker_serves_all_servers_and_none_without_a_need() -> None:
    choice = PoolChoice(1)
    servers = {"a": ServerNeed(1.0, 0.0), "b": ServerNeed(1.0, 0.0), "idle": ServerNeed(0.0, 0.0)}
    found = choice.update({"a": servers["a"]}, 0.0)
    for k in range(1, 100):
        shares = {name: (name in found) / len(found) for name in servers}
        found = choice.update({n: ServerNeed(s.lost, shares[n]) for n, s in servers.items()}, k)
    assert set(found) == {"a", "b"}


def test_where_nobody_needs_anything_a_worker_stays() -> None:
    choice = PoolChoice(3)
    servers = {"a": ServerNeed(0.0, 1.0), "b": ServerNeed(0.0, 0.0)}
    first = choice.update(servers, 0.0)
    assert all(choice.update(servers, float(k)) == first for k in range(1, 50)) and choice.changes == 1


def test_no_server_no_seat() -> None:
    choice = PoolChoice(0)
    assert choice.update({}, 0.0) == () and choice.changes == 0


def test_of_servers_without_a_worker_the_one_that_loses_most_comes_first() -> None:
    servers = {f"s{k}": ServerNeed(0.01, 0.0) for k in range(20)} | {"most": ServerNeed(0.5, 0.0)}
    for seed in range(10):
        choice = PoolChoice(seed)
        (first,) = choice.update({"s0": ServerNeed(0.01, 1.0)}, 0.0)
        assert first == "s0"
        k = 0
        while len(seats := choice.update({**servers, "s0": ServerNeed(0.01, 1.0)}, 0.5 * k)) == 1:
            k += 1
            assert k < 200
        assert set(seats) == {"s0", "most"}
