# SPDX-License-Identifier: MIT
"""Checks whether a run in real time keeps pace with the clock; reports it once, and again when it changes much."""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOOK_PERIOD = 0.1  # s between checks
WINDOW = 1.0  # s before now that a verdict is about
MIN_WINDOW = 0.5  # s that it is about at least
# s from the start in which steps before the first factor do not count; two seconds with MIN_WINDOW
WARM_UP = 1.4
FIRST_STEP_TIMEOUT = 1.8  # s from the start to wait for the end of a first step
STANDSTILL = 0.5  # s without a check, after which the process is taken to have been suspended
MIN_RATE = 0.9  # simulated time over time: below it the run does not keep pace
CONFIRM_TIME = 2 * WINDOW  # s that a change lasts before it is reported: a stall of less than a second passes
CHANGE = 2.0  # factor by which p50 has changed when it is reported again
MIN_INTERVAL = 10.0  # s between two lines; doubles each time
MIN_CPU_SHARE = 0.7  # processor time over time of a step: below it the loop waited for a core


class PaceMonitor:
    """Judges the pace of a run.

    dt: time step [s]
    advice: returns what may be done about it, in words
    on_cpu: steps take processor time
    verdict: present judgement; empty while the run keeps pace
    """

    def __init__(self, dt: float, advice: Callable[[], str], on_cpu: bool = True):
        self.dt, self._advice, self._on_cpu = dt, advice, on_cpu
        self.verdict = ""
        self._begun: float | None = None
        self._warm = False
        self._marks: deque[tuple[float, int]] = deque()  # time and steps completed, the oldest first
        self._times: deque[tuple[float, float]] = deque(maxlen=10_000)  # of steps: all, of the processor
        self._reported_p50: float | None = None  # p50 in the last line about a run that does not keep pace
        self._differs_since: float | None = None  # time at which the run first differed from the last line
        self._quiet_until, self._interval = 0.0, MIN_INTERVAL

    def add(self, records: NDArray[Any]) -> None:
        """Adds the times of step records."""
        first = records[records["body"] == 0]
        self._times.extend(zip(first["whole"].tolist(), first["cpu"].tolist(), strict=True))

    def check(self, now: float, step: int, paused: bool, warm: bool) -> str:
        """Returns the line to report now, mostly empty.

        now: monotonic time [s]
        step: completed steps
        warm: all objects have the factors they want
        """
        last = self._marks[-1][0] if self._marks else now
        if self._begun is None:
            self._begun = now
        if paused or now - last > STANDSTILL:
            self._marks.clear()
            self.verdict = ""
        elif warm and not self._warm and now - self._begun < WARM_UP:
            self._marks.clear()  # the steps before were not like those to come
        self._warm = warm
        self._marks.append((now, step))
        while len(self._marks) > 2 and now - self._marks[1][0] >= WINDOW:
            self._marks.popleft()
        since, steps = now - self._marks[0][0], step - self._marks[0][1]
        early = now - self._begun
        if since < MIN_WINDOW or (not warm and early < WARM_UP) or (not steps and early < FIRST_STEP_TIMEOUT):
            return ""
        return self._judge(now, since, steps)

    def _judge(self, now: float, since: float, steps: int) -> str:
        rate = steps * self.dt / since
        times = list(self._times)[-steps:] if steps else []
        p50, cpu = np.median(times, axis=0).tolist() if times else (since, since)
        if rate + self.dt / since >= MIN_RATE:  # one more step may be nearly done
            self.verdict = ""
            if not self._is_news(now, self._reported_p50 is not None):
                return ""
            self._reported_p50 = None
            return self._report(now, f"keeps pace again: a step takes {_ms(p50)} (p50), dt is {_ms(self.dt)}")
        self.verdict = (
            f"cannot keep pace: a step takes {'' if steps else 'more than '}{_ms(p50)} (p50), dt is {_ms(self.dt)}; "
            f"{rate:.2g} s are simulated a second"
        )
        if self._on_cpu and cpu < MIN_CPU_SHARE * p50:
            self.verdict += f"; the loop had a core for {100 * cpu / p50:.0f} % of that time"
        differs = self._reported_p50 is None or (steps > 0 and not 1 / CHANGE < p50 / self._reported_p50 < CHANGE)
        if not self._is_news(now, differs, at_once=self._interval == MIN_INTERVAL and p50 > MIN_RATE * self.dt):
            return ""
        self._reported_p50 = p50
        return self._report(now, f"{self.verdict}. {self._advice()}")

    def _is_news(self, now: float, differs: bool, at_once: bool = False) -> bool:
        """True if a difference from the last line is to be reported: at once, or because it lasts."""
        if not differs:
            self._differs_since = None
            return False
        if self._differs_since is None:
            self._differs_since = now
        return at_once or (now >= self._quiet_until and now - self._differs_since >= CONFIRM_TIME)

    def _report(self, now: float, line: str) -> str:
        self._quiet_until, self._interval, self._differs_since = now + self._interval, 2 * self._interval, None
        return line


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"
