# SPDX-License-Identifier: MIT
"""preconditioner = "auto": which factor is asked for, the exact one or an incomplete one.

An incomplete factor takes more iterations, each of them cheaper, and comes sooner, so that it is fresher. Which costs
less per solve depends on the body, the matrix, how busy its workers are and the machine, so it is measured. A trial is
a few factors of the other method in a row. It begins with one factor alone: the job after it is of the method in use
again, so that a bad trial ends with its first factor. After a change the former method is tried soon, since the motion
may have been the reason. A pure state machine over (method, cost of a solve).
"""

from collections import deque
from collections.abc import Sequence

from protocol.method import Method
from sim_server.updates.autotune.tuner import MARGIN, MAX_TRIAL_INTERVAL, TRIAL_INTERVAL, Tuner

MIN_SOLVES = 12  # solves that a trial is judged by at least, and that are known of the method in use
MIN_FACTORS = 2  # factors of a trial that must have been replaced before it is judged
MAX_SOLVES = 36  # solves after which a trial is judged by fewer factors; also the number of costs remembered
FIRST_SOLVES = 3  # solves with the first factor of a trial before it may end at once
CLEARLY_WORSE = 1.3  # mean cost with the first factor by that of the method in use from which the trial ends at once
SETTLE = 24  # solves to the trial after a change
MAX_FAILURES = 2  # jobs in a row without a factor after which a method is left for long


class RecentCosts:
    """Costs of the last MAX_SOLVES solves by a method."""

    def __init__(self) -> None:
        self.costs: deque[float] = deque(maxlen=MAX_SOLVES)

    @property
    def mean(self) -> float:
        """Mean cost of a solve."""
        return sum(self.costs) / len(self.costs)

    def beats(self, other: "RecentCosts") -> bool:
        """True if the mean cost is less by MARGIN."""
        return self.mean * MARGIN < other.mean


class FactorizationTuner(Tuner[Method, RecentCosts]):
    """Chooses how the factors of one body are made.

    methods: the first to begin with; the last one can always be made
    """

    def __init__(self, methods: Sequence[Method]):
        super().__init__(methods, RecentCosts, TRIAL_INTERVAL // 2, settle=SETTLE, first=MIN_SOLVES)
        self._confirmed = False  # the first factor of the trial was not clearly worse
        self._first_sent = False  # the job of that first factor
        self._factors: set[int] = set()  # steps of the matrices of the trial's factors
        self._sent = self.current
        self._failures = 0
        self._has_factor = False  # a job has brought one

    @property
    def method(self) -> Method:
        """The method of the next job."""
        return self.current if self._first_sent and not self._confirmed else self.active

    def observe(self, method: Method, factor_step: int, cost: float) -> bool:
        """Takes note of a solve with the factor of a step. True: the method in use has changed."""
        self.solves += 1
        if method == self.candidate:
            self.costs[method].costs.append(cost)
            self._factors.add(factor_step)
            return self._judge(replaced=False)
        if method == self.current:
            if self.candidate is not None and self.costs[self.candidate].costs and not self._confirmed:
                return self._judge(replaced=True)
            known = self.costs[method].costs
            known.append(cost)
            if self.is_due() and len(known) >= MIN_SOLVES and len(self.arms) > 1:
                self._begin_trial()
        return False

    def alternate(self) -> None:
        """Takes the following method into use: no factor is, so that the next comparison is with another one."""
        self.use(self.following(self.current))

    def on_sent(self) -> None:
        """Takes note that a job of `method` goes out."""
        self._sent = self.method
        self._first_sent = True

    def on_factor(self) -> None:
        """Takes note that a job brought a factor."""
        self._failures, self._has_factor = 0, True

    def on_failure(self, refused: bool = False) -> None:
        """Takes note that the last job came back without a factor, or with one that was refused.

        A refused factor is a matter of its method and not of chance: where it would be the first one, solves have none
        yet, and the last method is asked at once.
        """
        if self._sent == self.candidate:
            self.reject()
        self._failures += 1
        enough = self._failures >= MAX_FAILURES or (refused and not self._has_factor)
        if enough and self.current == self._sent != self.arms[-1]:
            self._failures = 0
            self.use(self.arms[-1])
            self.wait = MAX_TRIAL_INTERVAL

    def _begin_trial(self) -> None:
        self.candidate = self.following(self.current)
        self.costs[self.candidate] = RecentCosts()
        self._factors, self._confirmed, self._first_sent = set(), False, False

    def _judge(self, replaced: bool) -> bool:
        """Judges the trial so far. replaced: its first factor is not in use any more. True: it was a gain."""
        assert self.candidate is not None
        trial = self.costs[self.candidate]
        # Reject a first factor that is clearly worse
        solves = len(trial.costs)
        if (replaced or solves >= FIRST_SOLVES) and trial.mean > CLEARLY_WORSE * self.costs[self.current].mean:
            self.reject()
            return False
        # Otherwise go on with factors in a row, and count from here
        if not self._confirmed and (replaced or solves >= FIRST_SOLVES):
            self._confirmed = True
            trial.costs.clear()
            self._factors.clear()
            return False
        # Compare once there are enough solves and factors
        enough = solves >= MIN_SOLVES and len(self._factors) > MIN_FACTORS
        return self.end_trial() if enough or solves >= MAX_SOLVES else False
