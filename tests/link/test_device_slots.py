# SPDX-License-Identifier: MIT
"""Slots of device memory: lent once at a time, each in a generation of its own, never more than may be."""

import logging
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from protocol.channels import PROTOCOL
from protocol.counters import Counters
from protocol.messages_pb2 import Echo, Header
from sim_server.backends.shared_memory import Allocation
from sim_server.network import device_slots
from sim_server.network.device_slots import UNIT, DeviceSlot, DeviceSlots
from tests.support.device_memory import StandInMemory

MIB = 1 << 20


class Gated(StandInMemory):
    """Allocates once it may."""

    def __init__(self, limit: int):
        super().__init__(limit)
        self.may, self.asked = threading.Event(), list[int]()
        self.may.set()

    def allocate(self, size: int) -> Allocation | None:
        self.asked.append(size)
        assert self.may.wait(60)
        return super().allocate(size)


@pytest.fixture
def memory() -> Iterator[Gated]:
    made = Gated(16 * MIB)
    yield made
    made.may.set()
    made.close()


def soon(found: Callable[[], list[DeviceSlot] | None]) -> list[DeviceSlot]:
    end = time.monotonic() + 60
    while (slots := found()) is None:
        assert time.monotonic() < end
        time.sleep(0.001)
    return slots


def test_lending_does_not_wait_for_memory(memory: Gated) -> None:
    slots = DeviceSlots(memory)
    memory.may.clear()
    assert slots.lend([MIB, MIB]) is None and slots.lend([MIB, MIB]) is None
    memory.may.set()
    two = soon(lambda: slots.lend([MIB, MIB]))
    assert len({slot.address for slot in two}) == 2 and slots.lent == 2
    assert memory.asked == [UNIT] * 3, "the probe and two, asked for once"


def test_one_is_lent_again_in_another_generation_and_to_nobody_else_meanwhile(memory: Gated) -> None:
    slots = DeviceSlots(memory)
    (first,) = soon(lambda: slots.lend([3 * MIB]))
    generation, address = first.generation, first.address
    (other,) = soon(lambda: slots.lend([3 * MIB]))
    assert other.address != address
    slots.give_back(first)
    slots.give_back(first)
    (again,) = soon(lambda: slots.lend([3 * MIB]))
    assert again.address == address and again.generation == generation + 1
    told = again.message()
    assert (told.handle, told.capacity, told.generation) == (again.handle, again.capacity, again.generation)
    assert again.capacity >= 3 * MIB


def test_no_more_than_may_be_lent_and_none_far_too_large(memory: Gated) -> None:
    slots = DeviceSlots(memory)
    (large,) = soon(lambda: slots.lend([10 * MIB]))
    slots.give_back(large)
    for _ in range(100):
        assert slots.lend([10 * MIB, 10 * MIB]) is None, "16 MiB are all"
        time.sleep(0.001)
    (small,) = soon(lambda: slots.lend([MIB]))
    assert small is not large, "ten times as large"
    assert sum(memory.asked[1:]) <= memory.limit


def test_an_error_of_the_driver_costs_one_slot(
    memory: Gated, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_slots, "RETRY", 0.0)
    slots, allocate = DeviceSlots(memory), memory.allocate

    def broken(size: int) -> Allocation | None:
        memory.allocate = allocate  # type: ignore[method-assign]
        raise RuntimeError("cudaErrorUnknown")

    memory.allocate = broken  # type: ignore[method-assign]
    soon(lambda: slots.lend([MIB]))
    assert "device memory for matrices and factors is not there: cudaErrorUnknown" in caplog.text


@pytest.mark.parametrize("raises", [True, False])
def test_after_a_failed_allocation_none_is_tried_for_a_while(
    memory: Gated, monkeypatch: pytest.MonkeyPatch, raises: bool
) -> None:
    monkeypatch.setattr(device_slots, "RETRY", 1e6)
    slots, tried = DeviceSlots(memory, counters := Counters(logging.getLogger("test"))), list[int]()

    def broken(size: int) -> Allocation | None:
        tried.append(size)
        if raises:
            raise RuntimeError("cudaErrorMemoryAllocation")
        return None

    memory.allocate = broken  # type: ignore[method-assign]
    soon(lambda: [] if slots.lend([MIB]) is None and counters.device_slots else None)
    for _ in range(20):
        assert slots.lend([MIB]) is None and not slots.makes_any
    assert len(tried) == counters.device_slots == 1


def test_a_driver_that_fails_at_the_first_allocation_lends_none(memory: Gated) -> None:
    def broken(size: int) -> Allocation | None:
        raise RuntimeError("cudaErrorUnknown")

    memory.allocate = broken  # type: ignore[method-assign]
    assert not DeviceSlots(memory).usable


def test_a_server_that_can_share_none_lends_none(memory: Gated) -> None:
    memory.allocate = lambda size: None  # type: ignore[method-assign]
    slots = DeviceSlots(memory)
    assert not slots.usable and slots.lend([1]) is None
    question = Echo(header=Header(protocol=PROTOCOL, sequence=3), nonce=5, on_device=True)
    assert not slots.answer(question, 7).HasField("device")
