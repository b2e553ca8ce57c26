# SPDX-License-Identifier: MIT
"""Does a run in real time keep pace with the clock? Looked at now and then, told once and when it changes much."""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOOKS = 0.1  # s between looks
WINDOW = 1.0  # s that a verdict looks back on
LEAST = 0.5  # s that it looks back on at least
GRACE = 1.4  # s from the start in which steps before the first factor do not count: with LEAST it makes two seconds
PATIENCE = 1.8  # s from the start to wait for the end of a first step
ASLEEP = 0.5  # s without a look: the process stood still, and what it did meanwhile tells nothing
KEPT = 0.9  # simulated time over time: below it the run does not keep pace
LASTS = 2 * WINDOW  # s that something differs before it is told: a stall of less than a second passes
MUCH = 2.0  # factor by which p50 has changed when it is told again
PAUSE = 10.0  # s between two lines, twice as long each time
HAD = 0.7  # processor time over time of a step: below it the loop waited for a core


class Pace:
    """The verdict on a run, and the lines about it.

    dt: s of simulation a step. advice: what may be done about it, in words. on_cpu: steps take processor time.
    verdict: the line of this moment, empty while the run keeps pace.
    """

    def __init__(self, dt: float, advice: Callable[[], str], on_cpu: bool = True):
        self.dt, self._advice, self._on_cpu = dt, advice, on_cpu
        self.verdict = ""
        self._begun: float | None = None
        self._warm = False
        self._marks: deque[tuple[float, int]] = deque()  # time and steps completed, the oldest first
        self._times: deque[tuple[float, float]] = deque(maxlen=10_000)  # of steps: all, of the processor
        self._told: float | None = None  # p50 when it was told that the run does not keep pace
        self._differs_since: float | None = None  # since when that is no longer so
        self._quiet_until, self._pause = 0.0, PAUSE

    def note(self, records: NDArray[Any]) -> None:
        """Takes records of the loop (layouts.RECORD)."""
        first = records[records["body"] == 0]
        self._times.extend(zip(first["whole"].tolist(), first["cpu"].tolist(), strict=True))

    def look(self, now: float, step: int, paused: bool, warm: bool) -> str:
        """What to say now, mostly nothing. step: completed so far. warm: all objects have the factors they want."""
        last = self._marks[-1][0] if self._marks else now
        if self._begun is None:
            self._begun = now
        if paused or now - last > ASLEEP:
            self._marks.clear()
            self.verdict = ""
        elif warm and not self._warm and now - self._begun < GRACE:
            self._marks.clear()  # the steps before were not like those to come
        self._warm = warm
        self._marks.append((now, step))
        while len(self._marks) > 2 and now - self._marks[1][0] >= WINDOW:
            self._marks.popleft()
        since, steps = now - self._marks[0][0], step - self._marks[0][1]
        early = now - self._begun
        if since < LEAST or (not warm and early < GRACE) or (not steps and early < PATIENCE):
            return ""
        return self._judge(now, since, steps)

    def _judge(self, now: float, since: float, steps: int) -> str:
        rate = steps * self.dt / since
        times = list(self._times)[-steps:] if steps else []
        p50, cpu = np.median(times, axis=0).tolist() if times else (since, since)
        if rate + self.dt / since >= KEPT:  # one more step may be nearly done
            self.verdict = ""
            if not self._is_news(now, self._told is not None):
                return ""
            self._told = None
            return self._said(now, f"keeps pace again: a step takes {_ms(p50)} (p50), dt is {_ms(self.dt)}")
        self.verdict = (
            f"cannot keep pace: a step takes {'' if steps else 'more than '}{_ms(p50)} (p50), dt is {_ms(self.dt)}; "
            f"{rate:.2g} s are simulated a second"
        )
        if self._on_cpu and cpu < HAD * p50:
            self.verdict += f"; the loop had a core for {100 * cpu / p50:.0f} % of that time"
        differs = self._told is None or (steps > 0 and not 1 / MUCH < p50 / self._told < MUCH)
        if not self._is_news(now, differs, at_once=self._pause == PAUSE and p50 > KEPT * self.dt):
            return ""
        self._told = p50
        return self._said(now, f"{self.verdict}. {self._advice()}")

    def _is_news(self, now: float, differs: bool, at_once: bool = False) -> bool:
        """Whether what differs from what was told is to be told; if not at once, then if it lasts."""
        if not differs:
            self._differs_since = None
            return False
        if self._differs_since is None:
            self._differs_since = now
        return at_once or (now >= self._quiet_until and now - self._differs_since >= LASTS)

    def _said(self, now: float, line: str) -> str:
        self._quiet_until, self._pause, self._differs_since = now + self._pause, 2 * self._pause, None
        return line


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"
