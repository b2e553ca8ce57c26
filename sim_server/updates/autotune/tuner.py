# SPDX-License-Identifier: MIT
"""Chooses the cheapest of a few arms while they are in use: explore now and then, else exploit.

One arm is in use. Now and then another one is on trial. It takes over if it costs less by a margin; otherwise the time
to the next trial doubles, so that trials of an arm that is no gain cost next to nothing in the long run. How long a
trial is, and what a solve with an arm costs, is for the classes that derive from Tuner to say: preconditioner.py and
factorization.py. A tuner is a pure state machine, without clock or input.
"""

from collections.abc import Callable, Sequence
from typing import Generic, Protocol, Self, TypeVar

TRIAL_INTERVAL = 200  # solves between trials, doubled after each trial without gain
MAX_TRIAL_INTERVAL = 6400  # solves
MARGIN = 1.1  # cost of the arm in use by that of an arm on trial from which the latter takes over


class Cost(Protocol):
    """What is known of the cost of solves with an arm."""

    def beats(self, other: Self) -> bool:
        """True if solves cost less than those of `other`, by MARGIN."""


Arm = TypeVar("Arm")
SomeCost = TypeVar("SomeCost", bound=Cost)


class Tuner(Generic[Arm, SomeCost]):
    """The arm in use, the arm on trial, and when the next trial is due.

    arms: the first is in use to begin with
    unknown: makes the cost of an arm of which nothing is known
    interval: solves to the trial after one that was a gain [default: TRIAL_INTERVAL]; doubled by each that was not
    settle: solves to the trial after a change of the arm in use; None: interval
    first: solves to the first trial; None: interval
    """

    def __init__(
        self, arms: Sequence[Arm], unknown: Callable[[], SomeCost], interval: int = TRIAL_INTERVAL,
        settle: int | None = None, first: int | None = None,
    ):  # fmt: skip
        self.arms, self.current = list(arms), arms[0]
        self.candidate: Arm | None = None  # the arm on trial
        self.costs = {arm: unknown() for arm in arms}
        self.solves = 0  # since the last trial or change
        self._unknown = unknown
        self._least, self._interval = interval, interval
        self._settle = interval if settle is None else settle
        self.wait = interval if first is None else first  # solves to the next trial

    @property
    def active(self) -> Arm:
        """The arm on trial if there is one, else the arm in use."""
        return self.current if self.candidate is None else self.candidate

    def following(self, arm: Arm) -> Arm:
        """The arm after this one; the first follows the last."""
        return self.arms[(self.arms.index(arm) + 1) % len(self.arms)]

    def is_due(self) -> bool:
        """True if it is time for a trial."""
        return self.candidate is None and self.solves >= self.wait

    def use(self, arm: Arm) -> None:
        """Takes an arm into use without a trial; what was known of its cost is of another time. Ends a trial."""
        if arm != self.current:
            self.costs[arm] = self._unknown()
        self.current, self.candidate, self.solves, self.wait = arm, None, 0, self._settle

    def end_trial(self) -> bool:
        """Decides by cost. True: the arm on trial takes over."""
        assert self.candidate is not None
        if not self.costs[self.candidate].beats(self.costs[self.current]):
            self.reject()
            return False
        self.current, self.candidate, self.solves, self.wait = self.candidate, None, 0, self._settle
        self._interval = self._least
        return True

    def reject(self) -> None:
        """Ends the trial without gain."""
        self.candidate, self.solves = None, 0
        self.wait = self._interval = min(2 * self._interval, MAX_TRIAL_INTERVAL)
