# SPDX-License-Identifier: MIT
"""Who made the last factors of bodies."""

import numpy as np

from sim_server.updates.makers import KEPT, Makers


def test_the_last_factors_of_each_body_are_remembered_and_no_others():
    rng, bodies = np.random.default_rng(0), 5
    makers, expected = Makers(bodies), [dict[int, str]() for _ in range(bodies)]
    for step in range(3 * KEPT):
        chosen = np.flatnonzero(rng.random(bodies) < 0.7)
        workers = [f"w{rng.integers(4)}" for _ in chosen]
        makers.note(chosen, chosen + step, workers)
        for body, worker in zip(chosen.tolist(), workers, strict=True):
            expected[body][body + step] = worker
    for body, own in enumerate(expected):
        assert len(own) > KEPT
        kept = dict(list(own.items())[-KEPT:])
        assert makers.of(body) == kept and list(makers.of(body)) == list(kept)
        assert [makers.worker(body, step) for step in own] == [kept.get(step, "") for step in own]


def test_of_a_step_that_is_noted_again_the_last_worker_counts():
    makers = Makers(1)
    for worker in ("a", "b"):
        makers.note(np.array([0]), np.array([7]), [worker])
    assert makers.worker(0, 7) == "b" == makers.of(0)[7]
    assert makers.worker(0, 8) == "" and Makers(1).of(0) == {}
