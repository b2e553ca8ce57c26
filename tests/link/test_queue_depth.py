# SPDX-License-Identifier: MIT
"""How many jobs wait at a worker (worker_choice.py): none grows old in a queue, and a GPU's launches are full."""

from types import SimpleNamespace

import pytest

from protocol.messages_pb2 import WorkerInfo
from sim_server.network.batch_message import MOST_TOGETHER
from sim_server.network.worker_choice import (
    LEAST_BATCHES,
    MOST_ALONE,
    MOST_BATCHES,
    QUEUE_SECONDS,
    SMALL_BLOCKS,
    WorkerChoice,
)


def depth(seconds: float | None, sized: bool = True, blocks: int = 100, **told: object) -> int:
    """Jobs that may be in flight. seconds: that the worker reports of a factorization."""
    info = WorkerInfo(**{"shared_memory": True, "batches": True, "most_jobs": 256, **told})  # type: ignore[arg-type]
    book = SimpleNamespace(
        registry=SimpleNamespace(info=lambda name: info),
        timing=SimpleNamespace(mean_factorization=lambda name: seconds),
        decoder=SimpleNamespace(most_blocks=blocks, most_are_sized=sized),
    )
    return WorkerChoice(book, True, lambda name: 0).most_waiting("w")  # type: ignore[arg-type]


@pytest.mark.parametrize("together", [0, 1])
def test_as_many_as_are_done_within_a_short_time(together):
    assert depth(QUEUE_SECONDS / 7.5, together=together) == 7
    assert depth(10 * QUEUE_SECONDS, together=together) == 1
    assert depth(1e-9, together=together) == MOST_BATCHES * MOST_TOGETHER


def test_what_is_done_together_is_not_divided_however_long_it_takes():
    """Fewer would take as long: each would be said to take the longer, and still fewer would be sent."""
    for seconds in (1e-3, 1.0):
        assert depth(seconds, together=64) == 2 * 64
    assert 2 * 64 < depth(QUEUE_SECONDS / 150, together=64) == 150 < MOST_BATCHES * MOST_TOGETHER
    assert depth(1.0, together=5) == 10
    assert depth(1e-9, together=5) == MOST_BATCHES * MOST_TOGETHER, "they are short: more wait"


def test_no_worker_gets_more_by_what_it_says():
    assert depth(1.0, together=2**31) == LEAST_BATCHES * MOST_TOGETHER
    assert depth(1.0, together=64, most_jobs=0) == 1 and depth(1.0, together=64, most_jobs=9) == 9
    assert depth(1.0, together=64, sized=False) == depth(1.0, together=64, batches=False) == MOST_ALONE


def test_large_ones_and_unknown_ones_go_one_by_one():
    assert depth(1e-3, together=64, blocks=SMALL_BLOCKS + 1) == depth(None, together=64) == 1
    assert depth(1e-3, together=64, shared_memory=False) == 1
