# SPDX-License-Identifier: MIT
"""Slots of shared memory, seen by zenoh, by their owner and by a borrower."""

import threading
from pathlib import Path

import numpy as np
import pytest

from protocol.messages_pb2 import Slot as SlotMessage
from protocol.refused import Refused
from protocol.shared_memory import limits as shm_limits
from protocol.shared_memory import pool as module
from protocol.shared_memory.pool import HEADER, LARGE, Slot, SlotPool, SlotsUnusable
from protocol.shared_memory.view import SlotMap

pytestmark = pytest.mark.skipif(bool(shm_limits.obstacle()), reason=f"no shared memory here: {shm_limits.obstacle()}")


@pytest.fixture
def pool():
    pool = SlotPool(limit=8 << 20)
    yield pool
    pool.close()


def test_what_numpy_writes_is_what_zenoh_sends_and_a_borrower_reads(pool: SlotPool) -> None:
    slot = pool.lend(8000)
    assert slot is not None
    values = slot.array(np.float64, 1000)
    values[:] = np.arange(1000)
    assert slot.payload.to_bytes()[HEADER : HEADER + 8000] == values.tobytes()
    borrower = SlotMap()
    seen = borrower.array(slot.message(), np.float64, 1000)
    assert np.array_equal(seen, values)
    seen[7] = -1
    assert values[7] == -1
    assert slot.message().offset % 64 == 0


def test_a_slot_is_used_again_in_a_new_generation(pool: SlotPool) -> None:
    first = pool.lend(100_000)
    assert first is not None
    late, borrower = first.message(), SlotMap()
    assert borrower.is_current(late)
    pool.give_back(first)
    again = pool.lend(99_000)
    assert again is first and again.message().generation == late.generation + 1
    assert not borrower.is_current(late) and borrower.is_current(again.message())


def test_a_large_slot_is_made_beside_those_who_do_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """And while it is, other slots are lent, and its bytes count."""
    pool, go = SlotPool(limit=24 << 20), threading.Event()
    made: list[threading.Thread] = []

    class Slow(Slot):
        def __init__(self, capacity: int):
            if capacity > LARGE:
                made.append(threading.current_thread())
                assert go.wait(60)
            super().__init__(capacity)

    monkeypatch.setattr(module, "Slot", Slow)
    size = 6 << 20
    assert pool.lend(size, beside=True) is None and pool.is_making(size) and not pool.is_making(size // 8)
    assert pool.lend(size, beside=True) is None, "and none besides"
    small = pool.lend(8000, beside=True)
    assert small is not None and pool.bytes >= size
    assert pool.lend(20 << 20) is None, "there is no room beside it"
    assert pool.makes_any
    go.set()
    while pool.is_making(size):
        pool.lend(8000)
    assert not pool.makes_any
    slot = pool.lend(size, beside=True)
    assert slot is not None and slot.capacity >= size
    assert len(made) == 1 and made[0] is not threading.current_thread()
    pool.close()


def test_what_cannot_be_made_is_made_by_who_waits(pool: SlotPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a pool is closed while one is made."""

    def refused(capacity: int) -> Slot:
        raise SlotsUnusable("not now")

    with monkeypatch.context() as patch:
        patch.setattr(module, "Slot", refused)
        pool.prepare(6 << 20)
        while pool.is_making(6 << 20):
            pool.lend(8)
    assert pool.lend(6 << 20) is not None
    pool.prepare(7 << 20)


def test_who_does_not_wait_is_told_that_none_can_be_made(pool: SlotPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once for each attempt: none is being made then, unlike while the attempt goes on."""
    size, made = 6 << 20, []

    def refused(capacity: int) -> Slot:
        made.append(capacity)
        raise SlotsUnusable("not now")

    with monkeypatch.context() as patch:
        patch.setattr(module, "Slot", refused)
        for attempt in (1, 2):
            assert pool.lend(size, beside=True) is None and pool.is_making(size)
            while pool.is_making(size):
                pool.prepare(1)
            assert pool.lend(size, beside=True) is None and not pool.is_making(size)
            assert len(made) == attempt
    assert pool.lend(size, beside=True) is None and pool.is_making(size), "and tried again"


def test_a_slot_that_the_system_does_not_map_is_none(pool: SlotPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays travel as bytes then; the next call tries again."""

    def refused(*arguments: object) -> None:
        raise OSError("cannot allocate memory")

    with monkeypatch.context() as patch:
        patch.setattr(module.mmap, "mmap", refused)
        assert pool.lend(100_000) is None
    assert pool.lend(100_000) is not None and pool.lent == 1


def test_a_slot_given_back_twice_is_lent_once(pool: SlotPool) -> None:
    slot = pool.lend(100_000)
    assert slot is not None
    pool.give_back(slot)
    pool.give_back(slot)
    one, other = pool.lend(100_000), pool.lend(100_000)
    assert one is slot and other is not slot
    assert pool.lent == 2


def test_a_slot_of_several_users_is_lent_again_after_the_last_one(pool: SlotPool) -> None:
    slot = pool.lend(100_000, users=3)
    assert slot is not None
    pool.give_back(slot)
    pool.give_back(slot)
    other = pool.lend(100_000)
    assert other is not slot and pool.lent == 2
    pool.give_back(slot)
    assert pool.lend(100_000) is slot


def test_the_longest_unused_slot_makes_room(pool: SlotPool) -> None:
    """Of slots of several sizes, that of whichever size."""
    sizes = (3 << 20, 2 << 20, 1 << 20)
    slots = [pool.lend(size) for size in sizes]
    for slot in (slots[1], slots[0], slots[2]):
        pool.give_back(slot)
    assert pool.lend(3 << 20) is slots[0]
    assert pool.lend(4 << 20) is not None and pool.bytes == (3 + 1 + 4) << 20, "that of 2 MiB went"


def test_the_limit_holds_and_free_slots_make_room(pool: SlotPool) -> None:
    big = pool.lend(5 << 20)
    assert big is not None and pool.lend(5 << 20) is None
    segment = shm_limits.SHM / big.segment
    assert segment.exists()
    pool.give_back(big)
    del big
    other = pool.lend(7 << 20)
    assert other is not None and pool.bytes <= 8 << 20
    assert not segment.exists()


def test_closing_removes_the_segments() -> None:
    pool = SlotPool()
    slot = pool.lend(1 << 20)
    assert slot is not None
    segment = shm_limits.SHM / slot.segment
    del slot
    pool.close()
    assert not segment.exists()


def test_no_slot_where_dev_shm_is_full(monkeypatch: pytest.MonkeyPatch, pool: SlotPool) -> None:
    monkeypatch.setattr(shm_limits, "free_bytes", lambda: 0)
    assert pool.lend(1 << 20) is None


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"segment": "../etc/passwd"}, "allowed: digits and .zenoh"),
        ({"segment": "/etc/passwd"}, "allowed: digits and .zenoh"),
        ({"segment": ""}, "allowed: digits and .zenoh"),
        ({"segment": "1234567890123.zenoh"}, "cannot be opened"),
        ({"offset": 0}, "Slot.offset is 0"),
        ({"offset": 1 << 60}, "Slot.offset is"),
        ({"offset": 1091}, "a multiple of 8"),
        ({"capacity": 1 << 60}, "Slot.offset is"),
        ({"capacity": 100}, "Slot.capacity is 100 bytes; needed: 8000"),
    ],
)
def test_a_borrower_believes_no_description(pool: SlotPool, changes: dict[str, object], text: str) -> None:
    slot = pool.lend(8000)
    assert slot is not None
    message = slot.message()
    for field, value in changes.items():
        setattr(message, field, value)
    with pytest.raises(Refused, match=text):
        SlotMap().array(message, np.float64, 1000)


def test_a_borrower_follows_no_link() -> None:
    link = shm_limits.SHM / "999999999999999999999999.zenoh"
    link.symlink_to(Path("/etc/passwd"))
    try:
        with pytest.raises(Refused, match="cannot be opened"):
            SlotMap().array(SlotMessage(segment=link.name, offset=64, capacity=64), np.uint8, 8)
    finally:
        link.unlink(missing_ok=True)  # zenoh may have swept it up, in a process of another test


def test_every_slot_is_its_own(pool: SlotPool) -> None:
    slots = [pool.lend(20_000) for _ in range(5)]
    for number, slot in enumerate(slots):
        assert isinstance(slot, Slot)
        slot.array(np.int64, 2500)[:] = number
    assert [int(slot.array(np.int64, 2500).sum()) for slot in slots if slot] == [2500 * k for k in range(5)]
