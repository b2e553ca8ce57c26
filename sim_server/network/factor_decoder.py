# SPDX-License-Identifier: MIT
"""Checks and decodes what workers send: patterns of L, and factors as bytes or in a slot of shared memory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import TypeVar
from weakref import WeakValueDictionary

import numpy as np

from protocol.channels import CHANNELS, MOST_JOBS, name_in
from protocol.factor import Factor, FactorPattern, check_values
from protocol.messages_pb2 import DeviceSlot as DeviceSlotMessage
from protocol.messages_pb2 import Factor as FactorMessage
from protocol.messages_pb2 import FactorBatch, Topology
from protocol.messages_pb2 import FactorPattern as PatternMessage
from protocol.messages_pb2 import Slot as SlotMessage
from protocol.method import COMPLETE
from protocol.refused import Refused
from protocol.shared_memory.pool import Slot
from protocol.validate import (
    Sized,
    array,
    check_header,
    check_numbers,
    check_strings,
    copied,
    parse,
    take,
    topology_checksum,
)
from sim_server.arrays import Float32, Float64
from sim_server.backends.shared_memory import SharedMemory
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.scene.size_limits import expected_values
from sim_server.updates.factor_source import FactorMemory

T = TypeVar("T")

LARGE = 1 << 20  # bytes of a factor for which `memory` is asked
WORST_FILL = 6  # over that of nested dissection; minimum degree orderings leave about twice as much
ALWAYS_ALLOWED = 1 << 18  # values, a megabyte: a small matrix may well have a dense factor
MAX_PATTERNS = 4  # kept per object: one for each library among its workers


@dataclass
class CompleteFactors:
    """What objects whose matrices have one pattern share.

    patterns: of their complete factors, by id
    sizes: values of these factors, by id, without those of which the last one was rejected
    epochs: present ones of these objects, by name
    """

    patterns: dict[int, FactorPattern] = field(default_factory=dict)
    sizes: dict[int, int] = field(default_factory=dict)
    epochs: dict[str, int] = field(default_factory=dict)


@dataclass
class AnnouncedObject:
    """What is known of an object in its present epoch.

    size: degrees of freedom
    blocks: 3x3 blocks of its matrix
    topology: checksum of the pattern of its matrix
    complete: shared with objects of this topology
    patterns: of L, by id
    sizes: likewise as of CompleteFactors, of the last other factors, by method
    """

    epoch: int
    size: int
    blocks: int
    topology: int = 0
    complete: CompleteFactors = field(default_factory=CompleteFactors)
    patterns: dict[int, FactorPattern] = field(default_factory=dict)
    sizes: dict[str, dict[int, int]] = field(default_factory=dict)

    def pattern(self, id: int) -> FactorPattern | None:
        """Returns a pattern that a worker has sent for this object, or that a factor of one like it had."""
        return self.patterns.get(id) or self.complete.patterns.get(id)

    @property
    def most_allowed(self) -> int:
        """Most values of a pattern: slots for factors of this object and those like it have room for the largest."""
        return max(ALWAYS_ALLOWED, int(WORST_FILL * expected_values(self.size // 3, self.blocks)))

    @property
    def known_patterns(self) -> list[int]:
        """Ids of these patterns."""
        return list(dict.fromkeys((*self.patterns, *self.complete.patterns)))

    def most_values(self, method: str) -> int:
        """Number of values of the largest of the last factors by a method, also of objects like it; 0: not known. What
        is not known of complete ones their patterns tell."""
        if method != COMPLETE:
            return max(self.sizes.get(method, {}).values(), default=0)
        if known := self.complete.sizes:
            return max(known.values())
        if own := self.patterns:
            return max(pattern.nonzeros for pattern in own.values())
        return min((pattern.nonzeros for pattern in self.complete.patterns.values()), default=0)


class FactorDecoder:
    """Decodes messages of workers about objects that were announced. Its methods raise Refused.

    memory: makes the arrays that large factors are copied to (FactorSource.use_memory)
    device: device memory in which factors may come
    """

    def __init__(self, incarnation: int):
        self._incarnation = incarnation
        self.memory: FactorMemory = np.empty
        self.device: SharedMemory | None = None
        self.objects: dict[str, AnnouncedObject] = {}
        self._most_blocks = 0
        self._unsized: set[str] = set()  # objects that have had no factor in this epoch, nor has one like them
        self._complete: WeakValueDictionary[int, CompleteFactors] = WeakValueDictionary()  # by topology

    @property
    def most_blocks(self) -> int:
        """Blocks of the largest matrix."""
        return self._most_blocks

    @property
    def most_are_sized(self) -> bool:
        """True if nearly all objects have had a factor, so that the size of the next one is known."""
        return 10 * len(self._unsized) <= len(self.objects)

    def announce(self, topology: Topology) -> None:
        """Begins a new epoch of an object; patterns of the last one are dropped."""
        header = topology.header
        if (last := self.objects.get(header.object)) is not None:
            last.complete.epochs.pop(header.object, None)
        shape = topology_checksum(topology)
        complete = self._complete.setdefault(shape, CompleteFactors())
        complete.epochs[header.object] = header.epoch
        self.objects[header.object] = AnnouncedObject(
            header.epoch, 3 * topology.nodes, len(topology.columns) // 4, shape, complete
        )
        if not complete.patterns:
            self._unsized.add(header.object)
        self._most_blocks = max(known.blocks for known in self.objects.values())

    def add_pattern(self, key: object, data: Sized) -> tuple[str, FactorPattern] | None:
        """Keeps the pattern that a worker sends before its first factor with it; returns it with its object if it is
        new."""
        message = parse(PatternMessage, data, CHANNELS["pattern"].limit)
        known = self._object(message, key, "pattern")
        check_header(message, epoch=known.epoch)
        if message.size != known.size:
            raise Refused(f"FactorPattern.size is {message.size}; allowed: {known.size}", "shape")
        pattern = FactorPattern.from_message(message)
        if pattern.id in known.patterns:
            return None
        if pattern.nonzeros > (most := known.most_allowed):
            raise Refused(
                f"FactorPattern.nonzeros is {pattern.nonzeros}; allowed for the {known.blocks} blocks of the matrix: "
                f"at most {most}, the more of {ALWAYS_ALLOWED} and {WORST_FILL} times what nested dissection leaves",
                "size",
            )
        while len(known.patterns) >= MAX_PATTERNS:
            known.patterns.pop(next(iter(known.patterns)))
        known.patterns[pattern.id] = pattern
        return message.header.object, pattern

    def parse_factor(self, key: object, attachment: Sized | None) -> FactorMessage:
        """Parses the message that travels with the values of a factor.

        Its epoch is not checked: also the answer to a job of the last epoch tells that its worker is free again.
        """
        message = parse(FactorMessage, attachment, CHANNELS["factor"].limit)
        self._object(message, key, "factor")
        check_strings(message)
        if message.worker != name_in("factor", key, "worker"):  # access rules go by the key
            raise Refused(f"Factor.worker is {message.worker!r}, its key is {key}", "worker")
        check_numbers(message)
        if message.seconds < 0:
            raise Refused(f"Factor.seconds is {message.seconds}; allowed: 0 or more", "malformed")
        return message

    def decode(
        self, message: FactorMessage, payload: Sized, job: InFlightJob,
        fetch: Callable[[], Float32 | Float64] | None = None,
    ) -> Factor:  # fmt: skip
        """Returns the factor that answers a job. fetch: returns values that are in parts, each with its checksum."""
        for name, value, wanted in (
            ("header.object", message.header.object, job.object),
            ("step", message.step, job.step),
            ("warp", message.warp, job.warp),
            ("dtype", message.dtype, job.dtype),
        ):
            if value != wanted:
                raise Refused(f"Factor.{name} is {value!r}; allowed: {wanted!r}, as in the matrix", "malformed")
        known = self.known(job)
        pattern = known.pattern(message.pattern)
        if pattern is None:
            raise Refused(f"Factor.pattern is {message.pattern:016x}, which was not sent before", "pattern")
        if message.nonzeros != pattern.nonzeros:
            raise Refused(f"Factor.nonzeros is {message.nonzeros}; allowed: {pattern.nonzeros}", "shape")
        if message.HasField("device_slot"):
            values = self._from_device(message.device_slot, pattern, job)
            return self._made(known, pattern, values, job, message.seconds, message.remedy)
        if fetch is not None:
            return self._factor(known, pattern, fetch(), None, job, message.seconds, message.remedy)
        if message.HasField("slot"):
            values, seen = self._from_slot(message.slot, message.nonzeros, job)
        else:
            values, seen = _from_payload(message, payload), None
        return self._factor(known, pattern, values, message.checksum, job, message.seconds, message.remedy, seen)

    def parse_batch(self, key: object, attachment: Sized | None) -> FactorBatch:
        """Parses a message with answers to several jobs. Each answer is checked by itself (batch_decoder.py)."""
        message = parse(FactorBatch, attachment, CHANNELS["factors"].limit)
        check_header(message, incarnation=self._incarnation)
        check_strings(message, 256)
        if message.worker != _worker_in(str(key)):
            raise Refused(f"FactorBatch.worker is {message.worker[:80]!r}, its key is {key}", "worker")
        count = len(message.jobs)
        lengths = {name: len(getattr(message, name)) for name in ("patterns", "nonzeros", "checksums", "seconds")}
        texts = {name: len(getattr(message, name)) for name in ("failures", "remedies")}
        if not 0 < count <= MOST_JOBS or any(n != count for n in lengths.values()):
            raise Refused(f"FactorBatch.jobs has {count} numbers, other fields {lengths}; allowed: as many", "shape")
        if any(n not in (0, count) for n in texts.values()):
            raise Refused(f"FactorBatch.jobs has {count} numbers, texts {texts}; allowed: none or as many", "shape")
        return message

    def _factor(
        self, known: AnnouncedObject, pattern: FactorPattern, values: Float32 | Float64, checksum: int | None,
        job: InFlightJob, seconds: float, remedy: str, seen: tuple[int, bool] | None = None,
    ) -> Factor:  # fmt: skip
        check_values(values, pattern, checksum, seen)
        return self._made(known, pattern, values, job, seconds, remedy)

    def _made(
        self, known: AnnouncedObject, pattern: FactorPattern, values: Float32 | Float64, job: InFlightJob,
        seconds: float, remedy: str,
    ) -> Factor:  # fmt: skip
        """Returns the factor of values that were checked."""
        self.note_sizes([job.object], [known], pattern, job.method)
        return Factor(job.object, job.epoch, job.step, job.warp, pattern, values, job.worker, seconds, remedy[:200])

    def note_sizes(
        self, objects: Sequence[str], known: Sequence[AnnouncedObject], pattern: FactorPattern, method: str
    ) -> None:  # fmt: skip
        """Takes note of the pattern of factors that were checked. known: what is known of their objects"""
        if self._unsized:
            self._unsized.difference_update(objects)
        if method == COMPLETE:
            for complete in {id(each.complete): each.complete for each in known}.values():
                if pattern.id not in complete.sizes:
                    self._share(complete, pattern)
            return
        for each in known:
            sizes = each.sizes.get(method, {})
            if pattern.id not in sizes:
                each.sizes[method] = _with_last(sizes, pattern.id, pattern.nonzeros)

    def on_rejected(self, object: str, pattern: int) -> None:
        """Takes note that a factor of a pattern did not pass the check: until another one comes, no room is made for
        factors of its size."""
        if (known := self.objects.get(object)) is None:
            return
        for method, sizes in list(known.sizes.items()):  # another thread may add one
            known.sizes[method] = {id: size for id, size in sizes.items() if id != pattern}
        known.complete.sizes = {id: size for id, size in known.complete.sizes.items() if id != pattern}

    def known(self, job: InFlightJob) -> AnnouncedObject:
        """Returns what is known of the object of a job. From any thread: to be asked once for each answer, as another
        epoch of the object may begin meanwhile."""
        known = self.objects[job.object]
        if known.epoch != job.epoch:
            raise Refused(f"Factor.job is {job.number} of an epoch of {job.object} that is over", "epoch")
        return known

    def _share(self, complete: CompleteFactors, pattern: FactorPattern) -> None:
        """Has all objects of a topology know the pattern of a complete factor of one of them."""
        complete.patterns = _with_last(complete.patterns, pattern.id, pattern)
        sizes = {**complete.sizes, pattern.id: pattern.nonzeros}
        complete.sizes = {id: size for id, size in sizes.items() if id in complete.patterns}
        self._unsized = self._unsized - complete.epochs.keys()

    def _from_slot(
        self, told: SlotMessage, nonzeros: int, job: InFlightJob
    ) -> tuple[Float32 | Float64, tuple[int, bool]]:  # fmt: skip
        """Copies the values out of the slot allocated for the job: they must not change any more once they are checked.
        Returns them, their checksum, and whether all are finite."""
        size = check_slot((told.segment, told.offset, told.generation), nonzeros, job)
        values = (self.memory if size > LARGE else np.empty)(nonzeros, np.dtype(job.dtype))
        return values, copied(_slot(job).part(job.first, job.dtype, nonzeros), values, own=values)

    def _from_device(self, told: DeviceSlotMessage, pattern: FactorPattern, job: InFlightJob) -> Float32 | Float64:
        """Returns a copy of the values in the slot of device memory that was lent for the job, which are checked."""
        slot = job.device_slot
        if slot is None or self.device is None:
            raise Refused("Factor.device_slot is set, but no slot was lent for this job", "slot")
        if (told.handle, told.generation) != (slot.handle, job.device_generation):
            raise Refused(
                f"Factor.device_slot is {told.handle[:8].hex()} ({len(told.handle)} bytes), generation "
                f"{told.generation}; allowed: {slot.handle[:8].hex()}, {job.device_generation}, as lent for this job",
                "slot",
            )
        dtype = np.dtype(job.dtype)
        if (size := pattern.nonzeros * dtype.itemsize) > slot.capacity:
            raise Refused(f"Factor.nonzeros is {pattern.nonzeros}: {size} bytes in a slot of {slot.capacity}", "slot")
        return self.device.take(slot.address, pattern, dtype)

    def _object(self, message: PatternMessage | FactorMessage, key: object, channel: str) -> AnnouncedObject:
        header = check_header(message, incarnation=self._incarnation, object=self.objects)
        if header.object != name_in(channel, key, "object"):
            raise Refused(f"{message.DESCRIPTOR.name}.header.object is {header.object!r}, its key is {key}", "object")
        return self.objects[header.object]


def _with_last(entries: dict[int, T], id: int, value: T) -> dict[int, T]:
    """Returns the last entries and this one behind them, MAX_PATTERNS in all. Another thread may read `entries`."""
    others = [each for each in entries.items() if each[0] != id]
    return {**dict(others[1 - MAX_PATTERNS :]), id: value}


def _slot(job: InFlightJob) -> Slot:
    assert job.factor_slot is not None
    return job.factor_slot


@lru_cache(maxsize=256)
def _worker_in(key: str) -> str:
    """Returns the worker that a message of factors is of, by its key."""
    return name_in("factors", key, "worker")


@cache
def _item_bytes(dtype: str) -> int:
    return np.dtype(dtype).itemsize


def check_slot(given: tuple[str, int, int], nonzeros: int, job: InFlightJob) -> int:
    """Returns the bytes of a factor that fits into the slot allocated for its job, and is said to be there."""
    slot = job.factor_slot
    if slot is None:
        raise Refused("Factor.slot is set, but no slot was lent for this job", "slot")
    allocated = (slot.segment, slot.offset, job.factor_generation)
    if given != allocated:
        raise Refused(f"Factor.slot is {given}; allowed: {allocated}, as lent for this job", "slot")
    size, room = nonzeros * _item_bytes(job.dtype), job.room or slot.capacity
    if size > room:
        raise Refused(f"Factor.nonzeros is {nonzeros}: {size} bytes in a slot of {room}", "slot")
    return size


def _from_payload(message: FactorMessage, payload: Sized) -> Float32 | Float64:
    dtype = np.dtype(message.dtype)
    size = message.nonzeros * dtype.itemsize
    if len(payload) != size:
        raise Refused(f"Factor payload has {len(payload)} bytes; allowed: {size}", "size")
    return array(take(payload, CHANNELS["factor"].bulk, "Factor payload"), dtype, (-1,), "Factor payload")
