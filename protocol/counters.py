# SPDX-License-Identifier: MIT
"""Counters of a link, with one warning for each kind of failure."""

import logging
import os
import threading
import traceback
from collections import Counter

from protocol.refused import Refused

MAX_PLACES = 20  # from which unexpected errors are logged, each once; those of further ones are only counted


class Counters:
    """Counters by name, read as attributes; 0 where nothing was counted. Safe to use from several threads."""

    def __init__(self, logger: logging.Logger):
        self._logger = logger
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._warned: set[str] = set()
        self._places: set[str] = set()  # of unexpected errors
        self.refusals: Counter[str] = Counter()

    def add(self, name: str, amount: int = 1) -> None:
        """Adds to a counter."""
        with self._lock:
            self._counts[name] += amount

    def refuse(self, refusal: Refused, sender: str = "") -> None:
        """Counts a refused message by its kind; the first one of a kind (and of a sender, if given) is logged, of
        unexpected errors the first one from each of MAX_PLACES places."""
        with self._lock:
            self.refusals[refusal.kind] += 1
            if refusal.place:
                if refusal.place not in self._places and len(self._places) >= MAX_PLACES:
                    return
                self._places.add(refusal.place)
        self.warn(
            f"refused:{refusal.kind}:{refusal.place or sender}", f"message refused: {refusal} (counted from now on)"
        )

    def unexpected(self, error: Exception, what: str) -> Refused:
        """Returns the refusal of a message whose checks did not foresee an error, with the line that raised it. The
        traceback is logged at debug level."""
        self._logger.debug("%s: an error that no check foresees", what, exc_info=error)
        last = traceback.extract_tb(error.__traceback__)[-1:]
        where = "".join(f" ({os.path.basename(line.filename)}:{line.lineno})" for line in last)
        kind = type(error).__name__
        return Refused(f"{what}: {kind}: {str(error)[:500]}{where}", "unexpected", f"{kind}{where}")

    def trouble(self, name: str, text: str) -> None:
        """Counts a failure by name; the first one is logged."""
        self.add(name)
        self.warn(name, f"{text} (counted from now on)")

    def warn(self, kind: str, text: str) -> None:
        """Logs a warning, once for each kind."""
        with self._lock:
            first = kind not in self._warned
            self._warned.add(kind)
        if first:
            self._logger.warning(text)

    def copy(self) -> tuple[dict[str, int], dict[str, int]]:
        """Returns (counts by name, refusals by kind) as they are now."""
        with self._lock:
            return dict(self._counts), dict(self.refusals)

    @property
    def refused(self) -> int:
        """Messages refused, of all kinds."""
        return sum(self.refusals.values())

    def __getattr__(self, name: str) -> int:
        if name.startswith("_"):
            raise AttributeError(name)
        return self._counts[name]
