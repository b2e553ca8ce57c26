# SPDX-License-Identifier: MIT
"""CUDA graphs without a GPU: what is launched while one is captured runs when the graph does, in branches only if a
number on the device is not 0, in loops as long as it is not."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

MOST_REPEATS = 1000
Work = Callable[[], None]


class Graphs:
    """Captures of one stream, one at a time, and what runs outside of them at once."""

    def __init__(self) -> None:
        self._parts: list[list[Work]] = []  # of the graph that is captured, and of its branches around this place

    def begin(self) -> None:
        """Begins a capture."""
        assert not self._parts
        self._parts.append([])

    def end(self) -> Work:
        """Ends it; returns the graph."""
        (captured,) = self._parts
        self._parts.clear()
        return lambda: _run(captured)

    def put(self, work: Work) -> None:
        """Appends a launch."""
        if self._parts:
            self._parts[-1].append(work)
        else:
            work()

    @contextmanager
    def branch(self, flag: np.ndarray, repeats: bool = False) -> Iterator[None]:
        """What is launched inside runs only if `flag` (1,) is not 0 then. repeats: as long as it is not."""
        assert self._parts, "only while a graph is captured"
        inside: list[Work] = []
        self._parts.append(inside)
        yield
        self._parts.pop()
        self._parts[-1].append(lambda: _while(flag, inside) if repeats else _run(inside if flag[0] else []))


def _run(works: list[Work]) -> None:
    for work in works:
        work()


def _while(flag: np.ndarray, inside: list[Work]) -> None:
    for _ in range(MOST_REPEATS):
        if not flag[0]:
            return
        _run(inside)
    raise AssertionError("a loop that does not end")
