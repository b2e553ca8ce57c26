# SPDX-License-Identifier: MIT
"""Counters of one body, from which scheduler.py decides: what it was sent, what came of it, what its solves cost."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from protocol.method import Method
from sim_server.mechanics.world import Body
from sim_server.updates.scheduler import Need, excess
from sim_server.updates.tune_preconditioner import Choice

MEMORY = 0.2  # weight of the newest value in running means
METHODS = 32  # jobs of which it is remembered by which method they were made


def flops(pattern: FactorPattern) -> float:
    """Of a numeric Cholesky factorization: the squares of the column lengths of L."""
    width, height = np.diff(pattern.super_start).astype(float), np.diff(pattern.row_start).astype(float)
    low = height - width  # lengths of the columns of a supernode: low + 1 ... height
    return float((height * (height + 1) * (2 * height + 1) - low * (low + 1) * (2 * low + 1)).sum() / 6)


class Mean:
    """Running mean; `value` is None before the first."""

    def __init__(self) -> None:
        self.value: float | None = None

    def add(self, value: float) -> None:
        self.value = value if self.value is None else self.value + MEMORY * (value - self.value)

    def add_all(self, mean: float, rest: float, first: float) -> None:
        """Many at once. mean: theirs with their weights; rest: weight of what was before, or else of the first."""
        self.value = mean + rest * ((first if self.value is None else self.value) - mean)


class Track:
    """One body. methods: by which `auto` may have its factors made, none without it. counted: costs are bytes and
    operations instead of seconds, so that runs repeat exactly; one of these counts like the other, which is about what
    a core makes of them."""

    def __init__(self, body: Body, methods: Sequence[Method] = (), counted: bool = False):
        self.body, self.counted = body, counted
        self.excess = 0.0  # since the last matrix went out, or its factor came
        self.latest = 0.0  # of the last solve
        self._owed = 0.0  # of when the last matrix went out, should nothing come of it
        self._usual = Mean()  # of the first solve with a new factor
        self.lost = 0.0  # to the factor in use
        self.in_use = -1  # its step
        self.sent: int | None = None  # step of the last matrix that went out
        self.in_flight = False
        self.frozen = False  # it has run away and moves no more: needs no factors
        self.wanted: NDArray[np.float64] | None = None  # where the loop copies the matrix asked for
        self.matrix: tuple[int, NDArray[np.float64]] | None = None  # of the job in flight: step and what was sent
        self.asked = 0  # number of the request for it, among those of all bodies
        self.unbuilt = 0  # jobs in a row that were sent positions and came to nothing
        self.sent_positions = False  # with the last job ...
        self.ahead = 0.0  # ... so far ahead [s]
        self.used = 0
        self.refused = 0
        self.mended = 0  # of those used: from a matrix that was not positive definite
        self.refusal = ""  # the last reason why there was no factor
        self.causes: set[str] = set()  # told of
        self.failures = 0  # in a row
        self.newest = -1  # step of the newest factor taken up
        self.age_max = -1  # steps; largest age of a factor so far, -1: none was used
        self.latency = Mean()  # steps from a matrix to its factor
        self.seconds = Mean()  # s, or operations, of a factorization
        self.per_iteration = Mean()  # s, or bytes
        self.choice = Choice(methods) if methods else None
        self._methods: dict[int, Method] = {}  # of the last jobs, by step
        self._makers: dict[int, str] = {}  # workers of the last factors, by step
        self.dropped: tuple[int, int] | None = None  # the newest factor is no use: its step, kind of solves till then
        self._making: dict[str, Mean] = {}  # s, or operations, by name of the method

    def job(self, step: int, method: Method) -> None:
        """The matrix of a step is to be factorized."""
        self._methods[step] = method
        if len(self._methods) > METHODS:
            del self._methods[next(iter(self._methods))]

    def method(self, step: int) -> Method | None:
        """How the factor of a step was made; None where that is not known any more."""
        return self._methods.get(step)

    def maker(self, step: int) -> str:
        """Who made the factor of a step; empty where that is not known any more."""
        return self._makers.get(step, "")

    def making(self, method: Method) -> float:
        """What a factor costs to make."""
        mean = self._making.get(method.name)
        return 0.0 if mean is None or mean.value is None else mean.value

    def age(self, step: int) -> int:
        """Steps since the matrix of the newest factor, -1 without one."""
        return step - self.newest if self.newest >= 0 and self.dropped is None else -1

    def need(self, step: int) -> Need:
        """What the scheduler is told."""
        return Need(
            self.body.name,
            self.excess,
            None if self.sent is None else step - self.sent,
            self.in_flight or self.wanted is not None,
            self.age(step) if self.age(step) >= 0 else None,
            1.0 if self.per_iteration.value is None else self.per_iteration.value,
            1.0 if self.seconds.value is None else self.seconds.value,
            self.failures,
            self.lost,
            self.choice is not None and self.choice.wants_another,
            self.latest,
        )

    def went_out(self, step: int) -> None:
        """What was copied of `step` is on the way; it is kept, as a matrix is what its factor is judged by."""
        self.matrix = None if self.wanted is None else (step, self.wanted)
        self.sent_positions = self.wanted is not None and self.wanted.ndim == 2
        self.in_flight, self.sent, self.wanted = True, step, None
        self._owed, self.excess = self.excess, 0.0

    def came_in(self, factor: Factor, step: int) -> bool:
        """A factor came during `step`; False if a newer one is there already."""
        if self.in_flight and factor.step == self.sent:
            self.latency.add(max(1, step - factor.step))
        self.in_flight, self.failures = False, 0
        if self.sent_positions:
            self.unbuilt = 0
        if factor.step <= self.newest:
            return False
        made = flops(factor.pattern) if self.counted else max(factor.seconds, 1e-6)
        self.seconds.add(made)
        if method := self.method(factor.step):
            self._making.setdefault(method.name, Mean()).add(made)
        self.newest = factor.step
        self._makers[factor.step] = factor.worker
        if len(self._makers) > METHODS:
            del self._makers[next(iter(self._makers))]
        self.lost = 0.0  # what is known of the solves so far is of another factor
        self.excess = self.latest = self._usual.value or 0.0
        self.sent = factor.step if self.sent is None else self.sent  # one made elsewhere
        self.used += 1
        self.mended += bool(factor.remedy)
        return True

    def drop(self, kind: int, reason: str) -> None:
        """The newest factor is not used any more. kind: of the solves till now."""
        self.dropped, self.refusal = (self.newest, kind), reason
        self.failures += 1

    def taken_back(self) -> None:
        """Its job takes too long; it may be sent to another worker."""
        self.in_flight = False
        self.excess += self._owed

    def came_to_nothing(self, reason: str) -> None:
        """Its job failed; it may be sent again."""
        self.in_flight, self.refusal = False, reason
        self.excess += self._owed
        self.refused += 1
        self.failures += 1
        self.unbuilt += self.sent_positions

    def observe(self, record: Any, floor: int, cost: float) -> None:
        """A solve was made (a record of the loop). floor: iterations above it are excess; cost: of the solve."""
        floor *= max(int(record["linearizations"]), 1)
        self.sum_up(excess(int(record["iterations"]), floor), int(record["factor_step"]))
        self.refused += int(record["fallbacks"])
        self.per_iteration.add(cost / (int(record["iterations"]) + 1))
        if record["factor_step"] >= 0:
            self.age_max = max(self.age_max, int(record["step"]) - 1 - int(record["factor_step"]))

    def sum_up(self, above: int, made: int) -> None:
        """Excess of a solve with the factor of step `made`, -1: with none."""
        if 0 <= made < self.newest:  # before the newest factor was taken up
            return
        if made >= 0:
            if made != self.in_use:
                self.in_use, self.lost, self.excess = made, 0.0, 0.0
                self._usual.add(above)
            self.lost += above
        self.excess, self.latest = self.excess + above, float(above)


def observe_steps(tracks: Sequence[Track], r: NDArray[Any], floor: int) -> None:
    """As Track.observe of each record of whole steps, (steps, bodies), in seconds.

    A worker gets a job each time that the service thread comes round: with a thousand bodies this is what it waits for.
    """
    steps, made = len(r), r["factor_step"]
    above = np.maximum(r["iterations"] - floor * np.maximum(r["linearizations"], 1), 0)
    weights = (1 - MEMORY) ** np.arange(steps - 1, -1, -1)
    each = r["solve"] / (r["iterations"] + 1)
    costs = weights @ each / weights.sum()
    rest = float((1 - MEMORY) ** steps)
    age = np.where(made >= 0, r["step"] - 1 - made, -1).max(axis=0)
    columns = (
        above.sum(axis=0),
        above[-1],
        (made == made[0]).all(axis=0),
        made[0],
        costs,
        r["fallbacks"].sum(axis=0),
        age,
    )
    for k, (t, total, last, one, factor, cost, fallbacks, oldest) in enumerate(
        zip(tracks, *(column.tolist() for column in columns), strict=True)
    ):
        t.refused += fallbacks
        t.per_iteration.add_all(cost, rest, float(each[0, k]))
        t.age_max = max(t.age_max, oldest)
        if one and (factor < 0 or factor == t.in_use == t.newest):
            t.excess, t.latest = t.excess + total, float(last)
            t.lost += total if factor >= 0 else 0
            continue
        for i in range(steps):
            t.sum_up(int(above[i, k]), int(made[i, k]))
