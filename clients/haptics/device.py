# SPDX-License-Identifier: MIT
"""What the loop of a haptic device uses of it, and a hand that follows a script instead of one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

Point = tuple[float, float, float]


class Device(Protocol):
    """A haptic device. Both calls return at once: the loop calls them each period."""

    def position(self) -> Sequence[float]:
        """Returns where the device is, in the frame of the scene [m]."""
        ...

    def render(self, force: Sequence[float]) -> None:
        """Has the device exert a force on the hand [N]."""
        ...


class ScriptedHand:
    """A hand that goes from `start` by `press` and back, `rate` times a second, whatever it feels.

    felt: force that it felt last [N]. clock: returns seconds
    """

    def __init__(self, start: Point, press: Point, rate: float, clock: Callable[[], float]) -> None:
        self._start, self._press, self._rate, self._clock = start, press, rate, clock
        self._began: float | None = None
        self.felt: Point = (0.0, 0.0, 0.0)

    def position(self) -> Point:
        now = self._clock()
        self._began = now if self._began is None else self._began
        part = 0.5 - 0.5 * math.cos(2 * math.pi * self._rate * (now - self._began))
        x, y, z = (a + part * b for a, b in zip(self._start, self._press, strict=True))
        return x, y, z

    def render(self, force: Sequence[float]) -> None:
        x, y, z = force
        self.felt = x, y, z
