# SPDX-License-Identifier: MIT
"""Decodes the factors of a message, which lie in one slot of shared memory, by columns; each is judged by itself."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern, check_values
from protocol.messages_pb2 import FactorBatch
from protocol.refused import Refused
from protocol.shared_memory.copies import Parts
from sim_server.arrays import Int64
from sim_server.backends.factors_together import FactorsTogether
from sim_server.network.factor_decoder import LARGE, AnnouncedObject, FactorDecoder, check_slot
from sim_server.network.jobs_in_flight import InFlightJob, JobsInFlight
from sim_server.updates.take_in import BeginCheck, BegunCheck, TakenIn, take_in


class DecodedFactors(NamedTuple):
    """Of answers in a message: factors with their places among them, and places of others with why they are refused."""

    good: list[tuple[list[int], FactorsTogether]]
    refused: list[tuple[int, Refused]]


@dataclass(frozen=True)
class AnswerColumns:
    """What a message tells of each of its factors. slot: segment, offset and generation of theirs"""

    seconds: list[float]
    nonzeros: list[int]
    patterns: list[int]
    checksums: NDArray[np.uint64]
    remedies: list[str]
    slot: tuple[str, int, int]

    @classmethod
    def of(cls, message: FactorBatch) -> "AnswerColumns":
        """Returns them of a message."""
        slot, remedies = message.slot, list(message.remedies) or [""] * len(message.jobs)
        return cls(
            list(message.seconds), list(message.nonzeros), list(message.patterns),
            np.array(message.checksums, np.uint64), remedies,
            (slot.segment, slot.offset, slot.generation),
        )  # fmt: skip


class Expected(NamedTuple):
    """Answers that bring a factor of a known pattern which has room in its slot, by columns.

    answers: places among those that were asked for
    told: places in the message; places: in their batch
    """

    batch: JobsInFlight
    answers: list[int]
    told: list[int]
    places: list[int]
    known: list[AnnouncedObject]
    patterns: list[FactorPattern]

    @property
    def whole(self) -> bool:
        """True if they are all jobs of the batch, in its order."""
        return len(self.places) == len(self.batch) and self.places == list(range(len(self.batch)))

    def of(self, rows: Sequence[int]) -> "Expected":
        """Returns some of them."""
        if len(rows) == len(self.answers):
            return self
        columns: Any = ([column[row] for row in rows] for column in self[1:])
        return Expected(self.batch, *columns)

    def begin(self, begin_check: BeginCheck) -> BegunCheck | None:
        """Returns what the factors are checked with; None: they are checked later."""
        if self.matrices is None:
            return None
        objects, epochs = self.of_batch(self.batch.objects, self.batch.epochs)
        return begin_check(objects, epochs, self.patterns)

    @property
    def matrices(self) -> Int64 | None:
        """Addresses of the matrices that were sent; None: they are not known."""
        at = self.batch.matrices_at
        return None if len(at) == 0 or self.batch.positions else at[self.places]

    def of_batch(self, *columns: Sequence[Any]) -> list[list[Any]]:
        """Returns their entries of columns of the batch, which nobody changes."""
        if self.whole:
            return [column if isinstance(column, list) else list(column) for column in columns]
        return [[column[place] for place in self.places] for column in columns]

    @property
    def bodies(self) -> Int64 | None:
        """Numbers by which the sender of jobs knows their objects, if it has told them."""
        return None if self.batch.bodies is None else self.batch.bodies[self.places]


NONE = DecodedFactors([], [])


def decode_several(
    decoder: FactorDecoder, message: FactorBatch, jobs: Sequence[InFlightJob], told: Sequence[int],
    begin_check: BeginCheck | None = None,
) -> DecodedFactors:  # fmt: skip
    """Returns the factors that answer jobs of one batch, and why others are refused. From any thread.

    They are copied, and checked, by one call of native code: they must not change any more once they are checked.

    told: places of the answers in the message
    begin_check: None: what needs their matrices is checked later
    """
    columns = AnswerColumns.of(message)
    found, refused = _expected(decoder, columns, jobs, told)
    if not found.answers:
        return DecodedFactors([], refused)
    check = None if begin_check is None else found.begin(begin_check)
    taken = _taken(decoder, found, check)
    wrong, method = _wrong(columns, found, taken), found.batch.method
    rows: dict[int, list[int]] = {}  # of good ones by pattern
    for row, pattern in enumerate(found.patterns):
        if row not in wrong:
            rows.setdefault(pattern.id, []).append(row)
    good = []
    for own in rows.values():
        some = found.of(own)
        good.append(_together(columns, some, taken.of(own), check))
        decoder.note_sizes(good[-1][1].objects, some.known, some.patterns[0], method)
    return DecodedFactors(good, [*refused, *((found.answers[row], why) for row, why in wrong.items())])


def _expected(
    decoder: FactorDecoder, columns: AnswerColumns, jobs: Sequence[InFlightJob], told: Sequence[int]
) -> tuple[Expected, list[tuple[int, Refused]]]:  # fmt: skip
    """Returns the answers that are as expected, and why others are refused."""
    batch, objects = jobs[0].batch, decoder.objects
    slot, item, epochs = batch.factor_slot, np.dtype(batch.dtype).itemsize, batch.epochs
    rooms = [room or (slot.capacity if slot else 0) for room in batch.rooms.tolist()]
    lent = slot is not None and columns.slot == (slot.segment, slot.offset, batch.factor_generation)
    found: list[tuple[int, int, int, AnnouncedObject, FactorPattern]] = []
    refused: list[tuple[int, Refused]] = []
    for k, (job, place) in enumerate(zip(jobs, told, strict=True)):
        known, id, row = objects[job.object], columns.patterns[place], job.place
        pattern = known.complete.patterns.get(id) or known.patterns.get(id)
        nonzeros, seconds = columns.nonzeros[place], columns.seconds[place]
        good = lent and known.epoch == epochs[row] and 0 <= seconds < math.inf and nonzeros * item <= rooms[row]
        if good and pattern is not None and pattern.nonzeros == nonzeros:
            found.append((k, place, row, known, pattern))
        else:
            refused.append((k, _why(decoder, columns, place, job, pattern)))
    return Expected(batch, *map(list, zip(*found, strict=True))) if found else Expected(
        batch, [], [], [], [], []
    ), refused


def _why(
    decoder: FactorDecoder, columns: AnswerColumns, place: int, job: InFlightJob, pattern: FactorPattern | None
) -> Refused:  # fmt: skip
    """Returns what is wrong with an answer."""
    try:
        if not 0 <= (seconds := columns.seconds[place]) < math.inf:
            raise Refused(f"FactorBatch.seconds has {seconds}; allowed: finite, 0 or more", "malformed")
        decoder.known(job)
        if pattern is None:
            raise Refused(f"FactorBatch.patterns has {columns.patterns[place]:016x}, which was not sent", "pattern")
        if (nonzeros := columns.nonzeros[place]) != pattern.nonzeros:
            raise Refused(f"FactorBatch.nonzeros has {nonzeros}; allowed: {pattern.nonzeros}", "shape")
        check_slot(columns.slot, nonzeros, job)
    except Refused as refusal:
        return refusal
    return Refused(f"FactorBatch.jobs has {job.number}, whose object or slot changed meanwhile", "epoch")


def _taken(decoder: FactorDecoder, found: Expected, check: BegunCheck | None) -> TakenIn:
    """Copies values of factors out of the slot that was lent for their jobs."""
    slot, dtype = found.batch.factor_slot, np.dtype(found.batch.dtype)
    assert slot is not None
    total = sum(pattern.nonzeros for pattern in found.patterns)
    memory: NDArray[Any]
    if total * dtype.itemsize > LARGE:
        memory = decoder.memory(1 << (total - 1).bit_length(), dtype)  # of few sizes, so that it is used again
    else:
        memory = np.empty(total, dtype)
    source = Parts(slot.part(0, np.uint8, slot.capacity), found.batch.first[found.places])
    return take_in(source, found.patterns, memory[:total], check, found.matrices)


def _wrong(columns: AnswerColumns, found: Expected, taken: TakenIn) -> dict[int, Refused]:
    """Returns why some of the factors that were copied are refused, by their rows."""
    told = columns.checksums[found.told]
    looked, refused = taken.found, dict[int, Refused]()
    good = (looked["checksum"] == told) & (looked["finite"] != 0) & (looked["positive"] != 0)
    for row in np.flatnonzero(~good).tolist():
        seen, positive = (int(looked["checksum"][row]), bool(looked["finite"][row])), bool(looked["positive"][row])
        try:
            check_values(taken.values[row], found.patterns[row], int(told[row]), seen, positive)
        except Refused as refusal:
            refused[row] = refusal
    return refused


def _together(
    columns: AnswerColumns, found: Expected, taken: TakenIn, check: BegunCheck | None
) -> tuple[list[int], FactorsTogether]:  # fmt: skip
    """Returns factors of one pattern, and their places among the answers."""
    batch, told = found.batch, found.told
    objects, epochs, steps, warps = found.of_batch(batch.objects, batch.epochs, batch.steps, batch.warps)
    factors = FactorsTogether(
        found.patterns[0], batch.worker, batch.method, objects, epochs, steps, warps, taken.values,
        [columns.seconds[k] for k in told], [columns.remedies[k][:200] for k in told], bodies=found.bodies,
    )  # fmt: skip
    if check is not None:
        check.end(factors, taken)
    return found.answers, factors
