# SPDX-License-Identifier: MIT
"""warp = "auto": whether the frames of a body follow its rotations (the warp) or are held (none).

Following is nearly free and saves iterations wherever nodes turn, so it is where a body begins. Where strains matter
more than rotations it may cost some; what it is worth is known only from trying. A *trial* is a few solves of the other
way. They show it at once, as frames are reckoned from where the factor in use was made, whatever was done meanwhile
(kernels/nodes.cu). They are compared with solves before and after them, with factors about as old; as motion makes
iterations swing, trials go on until their mean says which way is better by more than its standard error. Holding must
be better by a margin.

Trials end as soon as they are clearly worse, what they cost in all is a bounded share of all iterations, and where
nodes have turned far since the matrix holding is not tried at all. A pure state machine over solves.
"""

from collections import deque
from collections.abc import Callable, Sequence
from math import log, sqrt
from typing import NamedTuple

SAMPLES = 6  # solves of a trial
AFTER = 12  # at most so many after it are waited for one with a factor as old
MARGIN = 0.03  # holding must be better by such a part
PRIOR = 0.05  # standard error of the first trial
TRIALS = 2, 8  # fewest before a body is held; most that may leave it open
WORSE = 1.1  # a trial is given up when so much worse (and by more than an iteration)
SHARE = 0.02  # of all iterations that trials may cost
EVERY = 12  # solves between trials, doubled after each that was no gain ...
RARELY = 3000  # ... up to so many
HARDER = 1.25  # a held body is tried again soon when solves cost so many times what they did when that was decided
FAR = 0.12  # rad, mean over nodes since the factor's matrix: following is better for certain
NEAR = 1e-4  # rad: both are the same
RECENT = 64  # solves remembered
STEPS = 5  # of time between two solves that make as much of a difference as one of age


class Solve(NamedTuple):
    """step: completed before it; age: of its factor [steps]."""

    step: int
    age: int
    iterations: int

    def unlike(self, other: "Solve") -> float:
        """How little it says about another one: an older factor is worth so many steps of motion."""
        return abs(self.age - other.age) + abs(self.step - other.step) / STEPS


class Warping:
    """Of one body. `hold` is the setting of its next step."""

    def __init__(self) -> None:
        self.hold = self.decided = False  # decided: hold apart from trials
        self.trials = 0
        self._recent: deque[Solve] = deque(maxlen=RECENT)
        self._trial: list[Solve] | None = None
        self._after: list[Solve] = []
        self._all = self.lost = 0.0  # iterations; of them by trials
        self._since, self._wait, self._every = 0, EVERY, EVERY  # solves since the last trial; so many before the next
        self._reference = 0.0
        self._gains: list[float] = []  # of trials since the last decision: logarithm of expected by tried

    def observe(self, step: int, factor_step: int, iterations: int, held: bool) -> None:
        """A solve with a factor was made. step: steps completed before it; factor_step: of the factor's matrix."""
        solve = Solve(step, step - factor_step, iterations)
        self._all += iterations
        self._since += 1
        if self._trial is not None and held == self.hold != self.decided:
            self._tried(self._trial, solve)
        elif held == self.decided:
            self._recent.append(solve)
            if self._trial is not None and self.hold == self.decided:
                self._compare(self._trial, solve)

    def observe_steps(
        self, steps: Sequence[int], factor_steps: Sequence[int], iterations: Sequence[int], held: Sequence[bool]
    ) -> None:
        """As `observe` of each of many solves."""
        if self._trial is not None or not all(h == self.decided for h in held):
            for solve in zip(steps, factor_steps, iterations, held, strict=True):
                self.observe(*solve)
            return
        self._all += sum(iterations)
        self._since += len(steps)
        for step, made, n in list(zip(steps, factor_steps, iterations, strict=True))[-RECENT:]:
            self._recent.append(Solve(step, step - made, n))

    def begin_anew(self) -> None:
        """Other factors are in use from now on: what was found says nothing of them."""
        self.hold = self.decided = False
        self._recent.clear()
        self._gains.clear()
        self._every, self._trial = EVERY, None
        self._next(EVERY)

    def consider(self, turned: Callable[[], float]) -> None:
        """Begins a trial if it is time. turned: mean angle of nodes since the factor's matrix [rad], asked rarely."""
        if self._trial is not None or len(self._recent) < SAMPLES:
            return
        harder = self.decided and self._now() > HARDER * self._reference and self._since >= SAMPLES
        if not (harder or self._since >= self._wait) or (self.lost > SHARE * self._all and not self.decided):
            return
        self._since = 0
        if self.decided or NEAR < turned() < FAR:
            self.trials += 1
            self.hold = not self.decided
            self._trial, self._after = [], []

    def _now(self) -> float:
        last = list(self._recent)[-SAMPLES:]
        return total(last) / max(len(last), 1)

    def _tried(self, trial: list[Solve], solve: Solve) -> None:
        self.lost += max(0, solve.iterations - alike(solve, self._recent))
        trial.append(solve)
        tried, before = total(trial), expected(trial, self._recent)
        dear = self.lost > SHARE * self._all + 2 and tried >= before
        if dear or tried > WORSE * before + 1:
            self._judge(log(max(before, 1) / max(tried, 1)))
        elif len(trial) == SAMPLES:
            self.hold = self.decided  # and now the solves after it

    def _compare(self, trial: list[Solve], solve: Solve) -> None:
        self._after.append(solve)
        missing = {s.age for s in trial} - {s.age for s in self._after}
        if missing and len(self._after) < AFTER:
            return
        before, after = expected(trial, list(self._recent)[: -len(self._after)]), expected(trial, self._after)
        self._judge(log(sqrt(max(before, 1) * max(after, 1)) / max(total(trial), 1)))

    def _judge(self, gain: float) -> None:
        self._gains.append(gain)
        gain, error = mean_and_error(self._gains)
        aim, (fewest, most) = (0.0, (1, TRIALS[1])) if self.decided else (MARGIN, TRIALS)
        if len(self._gains) >= fewest and gain > aim + error:
            self._decide(True)
        elif gain < aim - error or len(self._gains) >= most:
            self._decide(False)
        else:
            self._next(EVERY)

    def _decide(self, change: bool) -> None:
        assert self._trial is not None
        if change:
            self.decided = not self.decided
            self._recent.clear()
            self._recent.extend(self._trial)
        self._gains.clear()
        self._every = EVERY if change else min(2 * self._every, RARELY)
        self._next(self._every)

    def _next(self, wait: int) -> None:
        self._reference = self._now()
        self.hold, self._trial, self._since, self._wait = self.decided, None, 0, wait


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error, which begins with PRIOR."""
    n = len(values)
    mean = sum(values) / n
    return mean, sqrt((PRIOR**2 + sum((v - mean) ** 2 for v in values)) / n**2)


def total(solves: Sequence[Solve]) -> int:
    """Iterations of all."""
    return sum(solve.iterations for solve in solves)


def alike(solve: Solve, others: Sequence[Solve]) -> int:
    """Iterations of the one that says most about a solve, of equals the last."""
    return min(reversed(others), key=solve.unlike).iterations


def expected(trial: Sequence[Solve], others: Sequence[Solve]) -> int:
    """What a trial's solves took as others did."""
    return sum(alike(solve, others) for solve in trial)
