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
from sim_server.backends.factors_together import FactorsTogether
from sim_server.network.factor_decoder import LARGE, AnnouncedObject, FactorDecoder, check_slot, slot_of
from sim_server.network.leases import InFlightJob
from sim_server.updates.take_in import BeginCheck, SentMatrices, TakenIn, take_in


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
    checksums: list[int]
    remedies: list[str]
    slot: tuple[str, int, int]

    @classmethod
    def of(cls, message: FactorBatch) -> "AnswerColumns":
        """Returns them of a message."""
        slot, remedies = message.slot, list(message.remedies) or [""] * len(message.jobs)
        return cls(
            list(message.seconds), list(message.nonzeros), list(message.patterns), list(message.checksums), remedies,
            (slot.segment, slot.offset, slot.generation),
        )  # fmt: skip


class Expected(NamedTuple):
    """Answers that bring a factor of a known pattern which has room in its slot, by columns.

    answers: places among those that were asked for
    told: places in the message
    """

    answers: Sequence[int]
    told: Sequence[int]
    jobs: Sequence[InFlightJob]
    known: Sequence[AnnouncedObject]
    patterns: Sequence[FactorPattern]

    def begin(self, begin_check: BeginCheck) -> SentMatrices | None:
        """Returns what the factors are checked with; None: they are checked later."""
        jobs = self.jobs
        objects, epochs = [job.object for job in jobs], [job.epoch for job in jobs]
        return begin_check(objects, epochs, [job.step for job in jobs], self.patterns)


NOTHING = Expected((), (), (), (), ())


def decode_several(
    decoder: FactorDecoder, message: FactorBatch, answers: Sequence[tuple[int, InFlightJob]],
    begin_check: BeginCheck | None = None,
) -> DecodedFactors:  # fmt: skip
    """Returns the factors at some places of a message, and why others are refused. From any thread.

    They are copied, and checked, by one call of native code: they must not change any more once they are checked.

    begin_check: None: what needs their matrices is checked later
    """
    columns = AnswerColumns.of(message)
    found, refused = _expected(decoder, columns, answers)
    if not found.jobs:
        return DecodedFactors([], refused)
    sent = None if begin_check is None else found.begin(begin_check)
    taken = _taken(decoder, found, sent)
    wrong = _wrong(columns, found, taken)
    rows: dict[tuple[FactorPattern, str], list[int]] = {}  # of good ones by pattern and method
    for row, (job, pattern) in enumerate(zip(found.jobs, found.patterns, strict=True)):
        if row not in wrong:
            rows.setdefault((pattern, job.method), []).append(row)
            decoder.note_size(found.known[row], pattern, job)
    good = [_together(columns, found, taken, own, sent) for own in rows.values()]
    return DecodedFactors(good, [*refused, *((found.answers[row], why) for row, why in wrong.items())])


def _expected(
    decoder: FactorDecoder, columns: AnswerColumns, answers: Sequence[tuple[int, InFlightJob]]
) -> tuple[Expected, list[tuple[int, Refused]]]:  # fmt: skip
    """Returns the answers that are as expected, and why others are refused."""
    found: list[tuple[int, int, InFlightJob, AnnouncedObject, FactorPattern]] = []
    refused: list[tuple[int, Refused]] = []
    for k, (place, job) in enumerate(answers):
        nonzeros, id = columns.nonzeros[place], columns.patterns[place]
        try:
            if not 0 <= (seconds := columns.seconds[place]) < math.inf:
                raise Refused(f"FactorBatch.seconds has {seconds}; allowed: finite, 0 or more", "malformed")
            known = decoder.known(job)
            pattern = known.complete.patterns.get(id) or known.patterns.get(id)
            if pattern is None:
                raise Refused(f"FactorBatch.patterns has {id:016x}, which was not sent", "pattern")
            if nonzeros != pattern.nonzeros:
                raise Refused(f"FactorBatch.nonzeros has {nonzeros}; allowed: {pattern.nonzeros}", "shape")
            check_slot(columns.slot, nonzeros, job)
            found.append((k, place, job, known, pattern))
        except Refused as refusal:
            refused.append((k, refusal))
    return Expected(*zip(*found, strict=True)) if found else NOTHING, refused


def _taken(decoder: FactorDecoder, found: Expected, sent: SentMatrices | None) -> TakenIn:
    """Copies values of factors, which are of one type, out of the slot that was lent for their jobs."""
    slot, dtype = slot_of(found.jobs[0]), np.dtype(found.jobs[0].dtype)
    total = sum(pattern.nonzeros for pattern in found.patterns)
    memory: NDArray[Any]
    if total * dtype.itemsize > LARGE:
        memory = decoder.memory(1 << (total - 1).bit_length(), dtype)  # of few sizes, so that it is used again
    else:
        memory = np.empty(total, dtype)
    begin = np.array([job.first for job in found.jobs], np.int64)
    return take_in(Parts(slot.part(0, np.uint8, slot.capacity), begin), found.patterns, memory[:total], sent)


def _wrong(columns: AnswerColumns, found: Expected, taken: TakenIn) -> dict[int, Refused]:
    """Returns why some of the factors that were copied are refused, by their rows."""
    told = np.array([columns.checksums[place] for place in found.told], np.uint64)
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
    columns: AnswerColumns, found: Expected, taken: TakenIn, rows: Sequence[int], sent: SentMatrices | None
) -> tuple[list[int], FactorsTogether]:  # fmt: skip
    """Returns some of the factors that were found, of one pattern and method, and their places among the answers."""
    all_of_them = len(rows) == len(found.jobs)
    jobs, told = [found.jobs[row] for row in rows], [found.told[row] for row in rows]
    own = taken if all_of_them else taken.of(rows)
    factors = FactorsTogether(
        found.patterns[rows[0]], jobs[0].worker, jobs[0].method, [job.object for job in jobs],
        [job.epoch for job in jobs], [job.step for job in jobs], [job.warp for job in jobs], own.values,
        [columns.seconds[k] for k in told], [columns.remedies[k][:200] for k in told],
    )  # fmt: skip
    if sent is not None:
        sent.end(factors, own)
    return [found.answers[row] for row in rows], factors
