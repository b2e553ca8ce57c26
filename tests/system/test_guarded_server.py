# SPDX-License-Identifier: MIT
"""A worker whose factors are in good form and no good: they are refused, the simulation goes on, then right ones."""

import logging
from collections.abc import Callable

import numpy as np
import pytest
from hand_worker import HandWorker
from link_helpers import DenseAnalysis

from protocol.messages_pb2 import Factor, Topology
from protocol.validate import checksum
from sim_server.network.link import ServerLink
from sim_server.recording import messages
from sim_server.updates.driver import Driver
from tests.ports import free_endpoint
from tests.scenes import bar, simulation

pytestmark = pytest.mark.system


def answered(hand: HandWorker, topology: Topology, edit: Callable[[np.ndarray, np.ndarray], None]) -> None:
    """The next job, with the values of its factor edited (values, places of the pivots)."""
    job = hand.receive()
    analysis = DenseAnalysis(np.frombuffer(topology.row_start, np.int32), np.frombuffer(topology.columns, np.int32))
    values = analysis.factorize(np.frombuffer(bytes(hand.payload)).reshape(-1, 3, 3), job.factor_dtype)
    edit(values, analysis.pattern.diagonal)
    hand.put(
        "pattern", analysis.pattern.message(hand.header("bar", 1)).SerializeToString(), worker="hand", object="bar"
    )
    answer = Factor(
        header=hand.header("bar", 1), step=job.step, warp=job.warp, pattern=analysis.pattern.id, dtype=job.factor_dtype,
        nonzeros=len(values), checksum=checksum(values), worker="hand", seconds=0.01, job=job.header.sequence,
    )  # fmt: skip
    hand.answer(answer, values)


def identity(values: np.ndarray, pivots: np.ndarray) -> None:
    values[:] = 0
    values[pivots] = 1


def nothing(values: np.ndarray, pivots: np.ndarray) -> None:
    pass


def test_factors_that_are_no_good_are_refused_and_right_ones_are_used(caplog: pytest.LogCaptureFixture) -> None:
    sim = simulation(
        bar((3, 1, 1), young=1e6, fixed="X < 0.01"), gravity=(0, -9.81, 0), preconditioner="cholesky", update="async"
    )
    endpoint, topology = free_endpoint(), messages.topology(sim, sim.world.bodies[0])
    with (
        ServerLink(listen=[endpoint], shared_memory=False, silence=60) as link,
        HandWorker(endpoint, link.incarnation) as hand,
        caplog.at_level(logging.WARNING),
    ):
        driver = Driver(sim, link.dispatch)
        link.announce(topology)
        hand.hello()
        state = driver.bodies[0]

        def until(done: Callable[[], bool]) -> None:
            for _ in range(200_000):
                driver.advance(1)
                if done():
                    return
            raise AssertionError("it never happened")

        for count in (1, 2):
            until(lambda: state.job.in_flight)
            answered(hand, topology, identity)
            until(lambda count=count: state.failures.refused == count)  # type: ignore[misc]
        assert state.factors.used == 0 and driver.advance(1)["factor_step"].tolist() == [-1]
        until(lambda: state.job.in_flight)
        answered(hand, topology, nothing)
        until(lambda: state.factors.used == 1)
        records = driver.advance(3)
        assert (records["factor_step"] >= 0).all() and (records["status"] == 0).all()
    told = [r.getMessage() for r in caplog.records if "no factor" in r.getMessage()]
    assert len(told) == 1 and "that of hand is not used: worse than block Jacobi" in told[0]
    assert "worse than block Jacobi" in state.failures.reason
