# SPDX-License-Identifier: MIT
"""A run that does not keep pace with the clock says so, once, soon enough; in virtual time."""

import io
import itertools
from collections.abc import Callable

import numpy as np
import pytest
from rich.console import Console

from clients.watch import tables
from protocol import messages_pb2 as pb
from sim_server.backends.cpu.structs import RECORD
from sim_server.service.pace import LOOK_PERIOD, PaceMonitor

DT = 0.02
ROUND_PERIOD = 2.5e-3  # s between rounds of the service thread


class Run:
    """A loop in real time, as its service thread sees it: a step begins when it is due and the last one has ended.

    takes: how long a step takes [s] that begins at a time. share: of it, how long the loop had a core.
    """

    def __init__(self, takes: Callable[[float], float], warm: float = 0.0, share: float = 1.0):
        self.takes, self.warm, self.share = takes, warm, share
        self.now, self.step, self.busy_until, self.due = 0.0, 0, -1.0, 0.0
        self.paused = self.stopped = False
        self.whole = self.look_due = 0.0
        self.pace = PaceMonitor(DT, lambda: "ADVICE")
        self.said: list[tuple[float, str]] = []

    def until(self, end: float) -> list[tuple[float, str]]:
        """Goes on to this time; what is said meanwhile, with its time."""
        before = len(self.said)
        while self.now < end:
            self._loop()
            look = not self.stopped and self.now >= self.look_due
            if look and (line := self.pace.check(self.now, self.step, self.paused, self.now >= self.warm)):
                self.said.append((self.now, line))
            self.look_due = self.now + LOOK_PERIOD if look else self.look_due
            self.now += ROUND_PERIOD
        return self.said[before:]

    def _loop(self) -> None:
        if 0 <= self.busy_until <= self.now:
            self.busy_until = -1.0
            self.step += 1
            record = np.zeros(1, RECORD)
            record["whole"], record["cpu"] = self.whole, self.whole * self.share
            self.pace.add(record)
        if self.busy_until < 0 and self.now >= self.due and not (self.paused or self.stopped):
            self.whole = self.takes(self.now)
            self.busy_until = self.now + self.whole
            self.due = max(self.due + DT, self.now)


def test_a_run_that_keeps_pace_says_nothing():
    run = Run(lambda now: 0.9 * DT)
    assert run.until(20) == [] and run.pace.verdict == ""


@pytest.mark.parametrize("takes", [0.025, 0.05, 0.31, 0.8])
def test_one_that_does_not_says_so_within_two_seconds_and_once(takes):
    run = Run(lambda now: takes)
    ((when, line),) = run.until(40)
    assert when < 2.0
    assert line.startswith(f"cannot keep pace: a step takes {1e3 * takes:.3g} ms (p50), dt is 20 ms; ")
    assert line.endswith("s are simulated a second. ADVICE")
    assert run.pace.verdict.partition("; ")[0] == line.partition("; ")[0]


def test_a_step_that_never_ends_is_told_too():
    ((when, line),) = Run(lambda now: 3600.0).until(60)
    assert when < 2.0 and "a step takes more than " in line


@pytest.mark.parametrize("warm", [0.05, 0.6, 1.3])
def test_steps_before_the_first_factor_do_not_count(warm):
    run = Run(lambda now: 0.1 if now < warm else 0.005, warm)
    assert run.until(30) == []


@pytest.mark.parametrize("warm", [0.6, 1.3, 1.7, 5.0])
def test_but_they_do_if_it_takes_long_to_come_or_does_not_help(warm):
    ((when, _),) = Run(lambda now: 0.1, warm).until(3)
    assert when <= 2.0


def test_a_stall_is_not_told():
    run = Run(lambda now: 0.7 if 10 < now < 10.1 or 17 < now < 17.1 else 0.005)
    assert run.until(30) == []


def test_nor_that_a_few_steps_take_long_but_that_every_third_one_does():
    assert Run(lambda now: 0.05 if now % 1 < 0.05 else 0.005).until(20) == []
    each = itertools.cycle([0.005, 0.005, 0.1])
    run = Run(lambda now: next(each))
    ((when, line),) = run.until(20)
    assert when < 4 and "a step takes 5 ms (p50), dt is 20 ms; 0." in line


def test_it_is_told_again_if_it_has_changed_much():
    run = Run(lambda now: 0.03 if now < 30 else 0.04 if now < 60 else 0.2)
    run.until(59)
    assert len(run.said) == 1, "30 or 40 ms"
    ((when, line),) = run.until(90)
    assert when < 64 and "a step takes 200 ms" in line


def test_it_is_told_when_it_keeps_pace_again():
    run = Run(lambda now: 0.03 if now < 30 else 0.005)
    run.until(29)
    ((when, line),) = run.until(60)
    assert when < 34 and line == "keeps pace again: a step takes 5 ms (p50), dt is 20 ms"
    assert run.pace.verdict == ""


def test_a_run_to_and_fro_is_told_less_and_less_often():
    run = Run(lambda now: 0.1 if now % 10 < 5 else 0.001)
    run.until(300)
    gaps = np.diff([when for when, _ in run.said])
    assert len(run.said) < 7 and (gaps >= 10 * 2.0 ** np.arange(len(gaps))).all()


def test_a_pause_is_not_slow():
    run = Run(lambda now: 0.005)
    run.until(10)
    run.paused = True
    run.until(20)
    run.paused = False
    assert run.until(30) == [] and len(run.said) == 0


def test_a_process_that_stood_still_was_not_slow():
    run = Run(lambda now: 0.005)
    run.until(10)
    run.stopped = True
    run.until(20)
    run.stopped = False
    assert run.until(30) == [] and len(run.said) == 0


def test_a_loop_that_waits_for_a_core_says_so():
    ((_, line),) = Run(lambda now: 0.05, share=0.4).until(3)
    assert "the loop had a core for 40 % of that time" in line
    ((_, line),) = Run(lambda now: 0.05).until(3)
    assert "core" not in line


def test_the_client_shows_it():
    text = io.StringIO()
    Console(width=200, file=text).print(tables(pb.Status(pace="cannot keep pace: a step takes 31 ms")))
    assert "\ncannot keep pace: a step takes 31 ms\n" in text.getvalue()
