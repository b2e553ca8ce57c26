# SPDX-License-Identifier: MIT
"""Matrices and factors that stay in device memory of a server, between real processes. Files in shared memory stand for
the device and for what opens its memory elsewhere."""

import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hand_worker import HandWorker
from link_helpers import DenseAnalysis, Driver, chain, dense, matrix, process, product

from protocol.messages_pb2 import DeviceSlot, Factor, Matrix, Topology
from protocol.refused import Refused
from protocol.shared_memory import limits as shm_limits
from sim_server.network import job_sender
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint
from tests.support.device_memory import OpenedStandIn, StandInMemory, numbers

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(bool(shm_limits.obstacle()), reason=f"no shared memory here: {shm_limits.obstacle()}"),
]
BEAM = chain()
MAPPED: list[OpenedStandIn] = []  # kept, as addresses are theirs


@pytest.fixture(autouse=True)
def small_ones_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_sender, "LEAST_ON_DEVICE", 1)


@pytest.fixture
def memory() -> Iterator[StandInMemory]:
    made = StandInMemory()
    yield made
    made.close()


@contextmanager
def server(endpoint: str, memory: StandInMemory | None, name: str = "sim") -> Iterator[Driver]:
    with ServerLink(name, [endpoint]) as link:
        if memory is not None:
            link.share_device(memory)
        link.announce(BEAM)
        yield Driver(link)


def worker(endpoint: str, name: str = "near", servers: str = "sim", *options: str) -> AbstractContextManager[Any]:
    return process(str(Path(__file__).parent / "device_worker.py"), endpoint, name, servers, *options)


def joined(driver: Driver, on_device: bool, count: int = 1) -> None:
    driver.until(
        lambda: sum(w.device_memory == on_device for w in driver.link.dispatch.workers()) == count,
        "a worker that joins",
    )


def on_device(driver: Driver) -> int:
    return driver.link.counters.bulk_on_device


def is_right(factor: Any, topology: Topology, shift: float) -> None:
    np.testing.assert_allclose(product(factor), dense(topology, matrix(topology, shift)), atol=1e-5)


def sized(driver: Driver) -> None:
    """The first factor tells how large they are: it comes through the host; then there is a slot."""
    is_right(driver.factor(BEAM, 1), BEAM, 0.0)
    assert on_device(driver) == 0
    slots_come(driver)


def slots_come(driver: Driver) -> None:
    device = driver.link.dispatch.device
    assert device is not None
    largest = 4 * driver.link.dispatch.decoder.objects["beam"].most_values("cholesky")

    def there() -> bool:
        slots = device.lend([9 * 8 * 22, largest])
        for slot in slots or ():
            device.give_back(slot)
        return slots is not None

    driver.until(there, "slots of device memory")


def test_the_first_job_of_a_pattern_that_came_ahead_is_on_the_device(memory: StandInMemory) -> None:
    """Both of its slots are made once the pattern is known."""
    endpoint = free_endpoint()
    with (
        server(endpoint, memory) as driver,
        HandWorker(endpoint, driver.link.incarnation, shared_memory=True) as hand,
    ):
        hand.hello(device_memory=True)
        driver.until(lambda: driver.link.dispatch.workers(), "the hand worker")
        hand.right_answer(Matrix(header=hand.header("beam", 1), factor_dtype="float32"), BEAM)  # sends the pattern
        driver.until(
            lambda: len(memory.paths) == 3 and not driver.link.dispatch.makes_slots(), "the probe and two slots"
        )
        driver.submit(BEAM, 1)
        job = hand.receive()
        assert job.HasField("device_matrix") and job.HasField("device_factor")


def test_matrix_and_factor_stay_on_the_device(memory: StandInMemory) -> None:
    endpoint = free_endpoint()
    with server(endpoint, memory) as driver, worker(endpoint):
        joined(driver, True)
        sized(driver)
        for step in (2, 3):
            is_right(driver.factor(BEAM, step, float(step)), BEAM, float(step))
            assert on_device(driver) == 2 * (step - 1)
        device = driver.link.dispatch.device
        assert device is not None and device.lent == 0 and driver.link.slots_lent == 0
        assert driver.link.counters.refused == 0 and driver.failures == []


@pytest.mark.parametrize("why", ["another container", "a server without"])
def test_where_it_cannot_be_opened_arrays_travel_through_the_host(memory: StandInMemory, why: str) -> None:
    endpoint = free_endpoint()
    options = ["blind"] if why == "another container" else []
    with server(endpoint, memory if options else None) as driver, worker(endpoint, "near", "sim", *options):
        joined(driver, False)
        for step in (1, 2, 3):
            is_right(driver.factor(BEAM, step, float(step)), BEAM, float(step))
        assert on_device(driver) == 0 and driver.link.counters.bulk_shared > 0 and driver.failures == []


def test_a_slot_that_cannot_be_opened_costs_one_job(memory: StandInMemory) -> None:
    endpoint = free_endpoint()
    with server(endpoint, memory) as driver, worker(endpoint, "near", "sim", "closed"):
        joined(driver, True)
        sized(driver)
        driver.submit(BEAM, 2)
        driver.until(lambda: driver.failures, "the job that fails")
        assert "no device memory here" in driver.failures[0][1]
        joined(driver, False)
        is_right(driver.factor(BEAM, 3, 1.0), BEAM, 1.0)
        assert on_device(driver) == 0 and driver.link.dispatch.device.lent == 0


def test_a_matrix_that_needs_a_remedy_is_read_from_the_device(memory: StandInMemory) -> None:
    endpoint = free_endpoint()
    with server(endpoint, memory) as driver, worker(endpoint, "near", "sim", "remedy"):
        joined(driver, True)
        sized(driver)
        is_right(driver.factor(BEAM, 2, 1.0), BEAM, 1.0)
        assert on_device(driver) == 1, "of the matrix"
        assert not memory.taken and driver.failures == []


def test_a_worker_that_is_killed_while_it_writes_takes_nothing_away(memory: StandInMemory) -> None:
    endpoint = free_endpoint()
    with server(endpoint, memory) as driver:
        with worker(endpoint, "first") as first:
            joined(driver, True)
            sized(driver)
            first.send_signal(signal.SIGKILL)
            driver.until(lambda: not driver.link.dispatch.workers(), "an end")
        with worker(endpoint, "half", "sim", "hangs") as half:
            joined(driver, True)
            driver.submit(BEAM, 2, 2.0)
            while half.stdout.readline().strip() != "half":
                pass
            half.send_signal(signal.SIGKILL)
            driver.until(lambda: driver.failures, "the end of the job")
            assert driver.link.dispatch.device.lent == 0
        with worker(endpoint, "third"):
            joined(driver, True)
            is_right(driver.factor(BEAM, 3, 3.0), BEAM, 3.0)
            assert on_device(driver) == 2 and len(memory.paths) == 3, "the probe and two slots, used again"


def test_one_worker_of_two_servers_opens_the_memory_of_both(memory: StandInMemory) -> None:
    endpoint, other = free_endpoint(), StandInMemory()
    try:
        with (
            server(endpoint, memory, "sim") as one,
            ServerLink("sim2", [free_endpoint()], [endpoint]) as link,
        ):
            link.share_device(other)
            link.announce(BEAM)
            two = Driver(link)
            with worker(endpoint, "near", "sim,sim2"):
                for driver in (one, two):
                    joined(driver, True)
                    sized(driver)
                for step in (2, 3):
                    for shift, driver in ((1.0, one), (2.0, two)):
                        is_right(driver.factor(BEAM, step, shift), BEAM, shift)
                assert on_device(one) == on_device(two) == 4
    finally:
        other.close()


# ---- a worker that does as it likes ------------------------------------------------------------------------------


@contextmanager
def by_hand(memory: StandInMemory, **hello: Any) -> Iterator[tuple[Driver, HandWorker]]:
    """After a first factor; the hand worker says that it opens device memory."""
    endpoint = free_endpoint()
    with (
        server(endpoint, memory) as driver,
        HandWorker(endpoint, driver.link.incarnation, shared_memory=True) as hand,
    ):
        said = {"device_memory": True, **hello}
        hand.hello(**said)
        driver.until(lambda: driver.link.dispatch.workers(), "the hand worker")
        driver.submit(BEAM, 1)
        job = hand.receive()
        hand.answer(*hand.right_answer(job, BEAM))
        driver.until(lambda: driver.factors, "the first factor")
        slots_come(driver)
        hand.hello(**said)
        yield driver, hand


def on_its_device(hand: HandWorker, job: Matrix) -> tuple[Factor, int]:
    """The answer to a job, whose values are right, and where they are."""
    opened = OpenedStandIn()
    MAPPED.append(opened)
    at = opened.address(job.device_factor, 0)
    source = opened.address(job.device_matrix, 72 * job.blocks)
    given = opened.read(source, np.dtype(np.float64), 9 * job.blocks).reshape(-1, 3, 3)
    answer, values = hand.right_answer(job, BEAM)
    values_at = numbers(at, np.float32, len(values))
    values_at[:] = DenseAnalysis(
        np.frombuffer(BEAM.row_start, np.int32), np.frombuffer(BEAM.columns, np.int32)
    ).factorize(given, np.float32)
    answer.checksum, answer.matrix_shared = 0, True
    answer.device_slot.CopyFrom(job.device_factor)
    return answer, at


def send(hand: HandWorker, answer: Factor) -> None:
    hand.put("factor", b"", answer.SerializeToString(), worker=hand.name, object="beam")


def test_only_a_worker_that_shares_memory_of_the_host_is_offered_any(memory: StandInMemory) -> None:
    with by_hand(memory, shared_memory=False) as (driver, hand):
        driver.submit(BEAM, 2)
        job = hand.receive()
        assert not job.HasField("device_matrix") and not job.HasField("device_factor")


def wrong_handle(slot: DeviceSlot) -> DeviceSlot:
    return DeviceSlot(handle=slot.handle[::-1], capacity=slot.capacity, generation=slot.generation)


def other_generation(slot: DeviceSlot) -> DeviceSlot:
    return DeviceSlot(handle=slot.handle, capacity=slot.capacity, generation=slot.generation - 1)


@pytest.mark.parametrize("wrong", [wrong_handle, other_generation, lambda slot: DeviceSlot()])
def test_an_answer_with_another_slot_is_refused(
    memory: StandInMemory, wrong: Callable[[DeviceSlot], DeviceSlot]
) -> None:  # fmt: skip
    with by_hand(memory) as (driver, hand):
        driver.submit(BEAM, 2)
        job = hand.receive()
        answer, _ = on_its_device(hand, job)
        answer.device_slot.CopyFrom(wrong(job.device_factor))
        send(hand, answer)
        driver.until(lambda: driver.failures, "the refusal")
        assert driver.link.counters.refusals["slot"] == 1 and len(driver.factors) == 1 and not memory.taken


def test_a_slot_that_was_not_lent_is_refused(memory: StandInMemory, monkeypatch: pytest.MonkeyPatch) -> None:
    with by_hand(memory) as (driver, hand):
        driver.submit(BEAM, 2)
        first = hand.receive()
        send(hand, on_its_device(hand, first)[0])
        driver.until(lambda: len(driver.factors) == 2, "a factor")
        monkeypatch.setattr(job_sender, "LEAST_ON_DEVICE", 1 << 30)  # jobs travel through the host from now on
        driver.submit(BEAM, 3)
        job = hand.receive()
        job.device_factor.CopyFrom(first.device_factor)
        job.device_matrix.CopyFrom(first.device_matrix)
        send(hand, on_its_device(hand, job)[0])
        driver.until(lambda: driver.failures, "the refusal")
        assert "no slot was lent" in driver.failures[0][1] and len(driver.factors) == 2


def test_an_answer_that_is_sent_again_is_refused(memory: StandInMemory) -> None:
    with by_hand(memory) as (driver, hand):
        driver.submit(BEAM, 2)
        answer, _ = on_its_device(hand, hand.receive())
        send(hand, answer)
        driver.until(lambda: len(driver.factors) == 2, "a factor")
        send(hand, answer)
        driver.until(lambda: driver.link.counters.refusals["duplicate"], "the refusal")
        assert len(driver.factors) == 2 and len(memory.taken) == 1


@pytest.mark.parametrize(
    ("place", "value", "kind"), [(3, np.nan, "not_finite"), (5, np.inf, "not_finite"), (0, -1.0, "not_positive")]
)
def test_bad_values_are_refused(memory: StandInMemory, place: int, value: float, kind: str) -> None:
    with by_hand(memory) as (driver, hand):
        driver.submit(BEAM, 2)
        answer, at = on_its_device(hand, hand.receive())
        numbers(at, np.float32, answer.nonzeros)[place] = value
        send(hand, answer)
        driver.until(lambda: driver.failures, "the refusal")
        assert driver.link.counters.refusals[kind] == 1 and len(driver.factors) == 1


def test_a_factor_does_not_change_once_it_was_checked(memory: StandInMemory) -> None:
    with by_hand(memory) as (driver, hand):
        driver.submit(BEAM, 2, 2.0)
        answer, at = on_its_device(hand, hand.receive())
        send(hand, answer)
        driver.until(lambda: len(driver.factors) == 2, "a factor")
        numbers(at, np.float32, answer.nonzeros)[:] = np.nan
        is_right(driver.factors[1], BEAM, 2.0)


def test_a_capacity_beyond_the_memory_is_refused(memory: StandInMemory) -> None:
    slot = DeviceSlot(handle=memory.allocate(1 << 12).handle, capacity=1 << 12, generation=1)
    with pytest.raises(Refused, match="capacity"):
        OpenedStandIn().address(slot, 8)
