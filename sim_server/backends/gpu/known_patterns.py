# SPDX-License-Identifier: MIT
"""Patterns of factors that workers sent in earlier runs, kept on disk by the pattern of A: the inverses of a large body
are planned while the server starts, and not when its first factor comes.

What is read is checked as what a worker sends. A wrong file could cost the time of a plan that nobody uses.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from protocol.channels import CHANNELS
from protocol.factor import FactorPattern
from protocol.messages_pb2 import FactorPattern as PatternMessage
from protocol.messages_pb2 import Header
from protocol.process.cache_folder import cache_folder
from protocol.process.kept_files import keep, read_kept
from protocol.refused import Refused
from sim_server.backends.gpu.solver import PcgSolver

LEAST_NODES = 2000  # of a body: inverses of smaller ones are planned in less time than a step takes
MOST_BYTES = 256 << 20  # of all files; those that were used longest ago are deleted
SUFFIX = ".pattern"


class KnownPatterns:
    """Patterns of the factors of the large bodies of a scene.

    expect: begins to plan the inverses of factors with a pattern of a body (FactorUpload.expect)
    ranges: nodes [first, last) of each body
    row_start, columns: pattern of A
    """

    def __init__(
        self, solver: PcgSolver, expect: Callable[[int, FactorPattern], Any], ranges: Sequence[tuple[int, int]],
        row_start: NDArray[np.int32], columns: NDArray[np.int32],
    ):  # fmt: skip
        self._solver, self._expect, self._row_start, self._columns = solver, expect, row_start, columns
        self._ranges = {body: each for body, each in enumerate(ranges) if each[1] - each[0] >= LEAST_NODES}
        self._known: dict[int, int] = {}  # ids of patterns by body, the last one that was read or written

    def plan(self) -> None:
        """Begins to plan the inverses of factors with the patterns that are on disk, beside the caller."""
        for body in self._ranges:
            self._solver.beside(partial(self._plan, body))

    def note(self, body: int, pattern: FactorPattern) -> None:
        """Keeps the pattern of a body that came first in this run, beside the caller."""
        if body in self._ranges and self._known.setdefault(body, pattern.id) == pattern.id:
            self._solver.beside(partial(self._keep, body, pattern))

    def _plan(self, body: int) -> None:
        first, last = self._ranges[body]
        data = read_kept(self._path(body), CHANNELS["pattern"].limit)
        try:
            found = None if data is None else FactorPattern.from_message(PatternMessage.FromString(data))
        except (DecodeError, Refused):
            return
        if found is not None and found.size == 3 * (last - first):
            self._expect(body, found)

    def _keep(self, body: int, pattern: FactorPattern) -> None:
        path, data = self._path(body), pattern.message(Header()).SerializeToString()
        if len(data) <= CHANNELS["pattern"].limit and read_kept(path, len(data)) != data:
            keep(path, data, MOST_BYTES)

    def _path(self, body: int) -> Path:
        first, last = self._ranges[body]
        start = self._row_start[first : last + 1].astype(np.int64)
        digest = xxhash.xxh3_128((start - start[0]).tobytes())
        digest.update((self._columns[start[0] : start[-1]].astype(np.int64) - first).tobytes())
        return cache_folder() / "patterns" / f"{digest.hexdigest()}{SUFFIX}"
