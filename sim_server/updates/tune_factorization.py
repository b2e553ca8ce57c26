# SPDX-License-Identifier: MIT
"""preconditioner = "auto": which factor is asked for, the exact one or an incomplete one.

An incomplete factor takes more iterations, each of them cheaper, and comes sooner, so that it is fresher: which costs
less per solve depends on the body, the matrix, how busy its workers are and the machine. So it is measured, by *trials*
of a few factors of the other method in a row, which make up for what they take by how seldom they come: each that was
no gain doubles the time to the next, and one that is clearly worse ends at once. A change is tried the other way round
soon, since the motion may have been the reason. A pure state machine over (method, cost of a solve).
"""

from collections import deque
from collections.abc import Sequence

from protocol.method import Method

SOLVES = 12  # fewest that a trial is judged by, and that are known of what is in use ...
FACTORS = 2  # ... with so many factors and done with them
LONG = 36  # solves after which it is judged by fewer factors; also how many are remembered
WORSE = 1.3  # a trial ends at once ...
EARLY = 3  # ... after so many solves that cost so many times what is known
MARGIN = 1.1  # change only for a clear gain
SOON = 24  # solves to the trial after a change
EVERY = 200  # solves to the next one otherwise, doubled after each that was no gain ...
RARELY = 6400  # ... up to so many
FAILURES = 2  # jobs in a row that come to nothing, after which a method is left for long


class Making:
    """Of one body. `method`: of the next job; `decided`: apart from trials. methods: the first to begin with, the last
    one can always be made.

    A trial begins with one factor alone: the job after it is of what is in use again, so that it does not last if it is
    bad. If it is not clearly worse others follow, in a row, as they would if they were in use.
    """

    def __init__(self, methods: Sequence[Method]):
        self._methods = list(methods)
        self.method = self.decided = self._methods[0]
        self._known: deque[float] = deque(maxlen=LONG)  # costs of solves with what is decided
        self._candidate: Method | None = None  # on trial
        self._passed = False  # its first factor was not clearly worse
        self._trial: list[float] = []
        self._tried: set[int] = set()  # steps of the factors of the trial
        self._since, self._wait, self._every = 0, SOLVES, EVERY
        self._sent = self.method
        self._failures = 0

    def observe(self, method: Method, made: int, cost: float) -> bool:
        """A solve with the factor of step `made`. True: what is decided has changed."""
        self._since += 1
        if method == self._candidate:
            self._trial.append(cost)
            self._tried.add(made)
            return self._judge(over=False)
        if method == self.decided:
            if self._candidate is not None and self._trial and not self._passed:
                return self._judge(over=True)
            self._known.append(cost)
            if self._candidate is None and len(self._known) >= SOLVES and self._since >= self._wait:
                self._begin()
        return False

    def decide(self, method: Method) -> None:
        """Something else has shown that it pays."""
        if method != self.decided:
            self._known.clear()
        self.method = self.decided = method
        self._candidate, self._since, self._wait = None, 0, SOON

    def alternate(self) -> None:
        """No factor is in use: the next one is of another method, for the next comparison."""
        self.decide(self._other(self.decided))

    def sent(self) -> None:
        """A job of `method` goes out."""
        self._sent = self.method
        if self._candidate is not None and not self._passed:
            self.method = self.decided

    def answered(self) -> None:
        """A job brought a factor."""
        self._failures = 0

    def failed(self) -> None:
        """The job that went out last came to nothing."""
        if self._sent == self._candidate:
            self._end(False)
        self._failures += 1
        if self._failures >= FAILURES and self.decided == self._sent != self._methods[-1]:
            self._failures = 0
            self.decide(self._methods[-1])
            self._wait = RARELY

    def _other(self, method: Method) -> Method:
        return self._methods[(self._methods.index(method) + 1) % len(self._methods)]

    def _begin(self) -> None:
        if len(self._methods) > 1:
            self.method = self._candidate = self._other(self.decided)
            self._trial, self._tried, self._passed = [], set(), False

    def _judge(self, over: bool) -> bool:
        """over: another factor has taken the place of the first of the trial."""
        trial, known = self._trial, sum(self._known) / len(self._known)
        mean = sum(trial) / len(trial)
        if (over or len(trial) >= EARLY) and mean > WORSE * known:
            return self._end(False)
        if not self._passed and (over or len(trial) >= EARLY):
            assert self._candidate is not None
            self._passed, self.method = True, self._candidate
            trial.clear()
            self._tried.clear()
            return False
        enough = len(trial) >= SOLVES and len(self._tried) > FACTORS
        return self._end(mean * MARGIN < known) if enough or len(trial) >= LONG else False

    def _end(self, change: bool) -> bool:
        """The trial is over."""
        assert self._candidate is not None
        if change:
            self.decide(self._candidate)
            self._known.extend(self._trial)
            self._every = EVERY
        else:
            self.decide(self.decided)
            self._wait, self._every = self._every, min(2 * self._every, RARELY)
        return change
