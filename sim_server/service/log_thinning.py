# SPDX-License-Identifier: MIT
"""Chooses the step records for a log that cannot follow in real time, where no step waits for it.

What a replay needs of a step is what its solves were given: preconditioner and factor. A record that tells the same as
the one before of its object, of a step that went well, may be left out; the next one of the object tells how many were
(ObjectStep.left_out), and a replay repeats their steps by the one before (replay/log.py).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.log_file import KEPT_EVERY
from protocol.messages_pb2 import CONVERGED

GIVEN = ("kind", "asked", "probe", "factor_step")  # columns that tell what solves were given
EVENTS = ("fallbacks", "halvings", "clipped")  # above 0 where something happened


class LogThinning:
    """Keeps of each object what its last record told. count: records left out so far"""

    def __init__(self, bodies: int):
        self._given = np.full((len(GIVEN), bodies), -2, np.int64)  # -2: no record yet
        self._left_out = np.zeros(bodies, np.int64)  # since the last that was chosen
        self.count = 0

    def choose(self, records: NDArray[Any], behind: bool) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Returns the numbers of the records for the log, and how many of its object were left out before each.

        behind: only those with news, and of each object every KEPT_EVERY-th step
        """
        if not len(records):
            return np.zeros(0, np.intp), np.zeros(0, np.int64)
        order = np.argsort(records["body"], kind="stable")
        own, place = np.unique(records["body"][order], return_index=True)
        last = np.append(place[1:], len(order)) - 1
        keep = self._with_news(records, order, own, place, last)
        if not behind:
            keep[:] = True
        gone = np.cumsum(~keep)  # in this order, up to and with each
        before = np.maximum.accumulate(np.where(keep, np.arange(len(order)), -1))  # the last that is kept
        previous = np.append(-1, before[:-1])
        begin = place.repeat(last - place + 1)
        within = previous >= begin  # one of the same object
        carried = (gone - ~keep)[place] - self._left_out[own]
        base = np.where(within, gone[np.maximum(previous, 0)], carried.repeat(last - place + 1))
        left_out = np.zeros(len(order), np.int64)
        left_out[order] = gone - base
        kept_last = before[last] >= place
        self._left_out[own] = gone[last] - np.where(kept_last, gone[np.maximum(before[last], 0)], carried)
        self.count += int(gone[-1])
        numbers = np.sort(order[keep])
        return numbers, left_out[numbers]

    def _with_news(
        self, records: NDArray[Any], order: NDArray[np.intp], own: NDArray[Any], place: NDArray[np.intp],
        last: NDArray[np.intp],
    ) -> NDArray[np.bool_]:  # fmt: skip
        """Returns in this order which records tell what those before of their objects do not."""
        news: NDArray[np.bool_] = (
            (records["status"] != CONVERGED) | (records["bad_node"] >= 0) | (records["step"] % KEPT_EVERY == 0)
        )
        for name in EVENTS:
            news |= records[name] > 0
        news = news[order]
        for known, name in zip(self._given, GIVEN, strict=True):
            now = records[name][order].astype(np.int64)
            then = np.append(-2, now[:-1])
            then[place] = known[own]
            news |= now != then
            known[own] = now[last]
        return news
