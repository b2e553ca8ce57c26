# SPDX-License-Identifier: MIT
"""What is known of the updates of one body: its solves, the job in flight, failures and factors."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from protocol.method import Method
from sim_server.backends.rosenbrock import FORMS
from sim_server.mechanics.world import Body
from sim_server.updates.autotune.preconditioner import PreconditionerTuner
from sim_server.updates.scheduler import UpdateRequest
from sim_server.updates.stats import MEMORY, RunningMean, flops

MAX_REMEMBERED = 32  # factors whose method and worker are remembered
ONE_SOLVE, FACTOR = FORMS["ONE_SOLVE"], FORMS["FACTOR"]
STAGES = 2  # linear solves of a step of the other forms
MIN_SECONDS = 1e-6  # s; a factorization is never taken to be faster


@dataclass(slots=True)
class SolveStatistics:
    """Sums over the solves of a body; excess is the number of iterations above the floor."""

    excess: float = 0.0  # since the last matrix was sent, or its factor taken up
    latest: float = 0.0  # excess of the last solve
    lost: float = 0.0  # excess of the solves with the factor in use
    factor_step: int = -1  # of the factor in use
    max_factor_age: int = -1  # steps; -1: no factor was used
    iteration_cost: RunningMean = field(default_factory=RunningMean)  # s, or bytes
    first_excess: RunningMean = field(default_factory=RunningMean)  # of the first solve with a new factor

    def add(self, excess: float, factor_step: int, newest: int) -> None:
        """Adds a solve.

        factor_step: of its factor, -1: it had none
        newest: step of the newest factor that was taken up
        """
        if 0 <= factor_step < newest:  # made before the newest factor was taken up
            return
        if factor_step >= 0:
            if factor_step != self.factor_step:
                self.factor_step, self.lost, self.excess = factor_step, 0.0, 0.0
                self.first_excess.add(excess)
            self.lost += excess
        self.excess, self.latest = self.excess + excess, float(excess)

    def restart(self) -> None:
        """A new factor was taken up: what is known of the solves so far is of another one."""
        self.lost = 0.0
        self.excess = self.latest = self.first_excess.value or 0.0


@dataclass(slots=True)
class JobState:
    """The matrix that is being copied or factorized."""

    copy: NDArray[np.float64] | None = None  # into which the loop copies the matrix or the positions requested
    request: int = 0  # number of the request for that copy, among those of all bodies
    extrapolated: float = 0.0  # s; by how much the positions requested were extrapolated
    in_flight: bool = False
    sent: int | None = None  # step of the last matrix that was sent; None: none was
    matrix: tuple[int, NDArray[np.float64]] | None = None  # of the job in flight: step and what was sent
    positions: bool = False  # the last job held positions, from which the worker assembles the matrix
    excess: float = 0.0  # of the body when the last matrix was sent: to be restored if the job fails


@dataclass(slots=True)
class FailureState:
    """Jobs and factors that were of no use."""

    in_a_row: int = 0  # jobs without a factor that is used
    assemblies: int = 0  # jobs in a row with positions that brought no factor
    refused: int = 0  # factors, and solves that abandoned theirs
    reason: str = ""  # of the last one
    reported: set[str] = field(default_factory=set)  # causes that the log has


@dataclass(slots=True)
class FactorStatistics:
    """Factors that were taken up."""

    used: int = 0
    regularized: int = 0  # of these, made from a matrix that was not positive definite
    newest: int = -1  # step of the matrix of the newest factor
    kept: Factor | None = None  # the newest one, under policies by which a run repeats
    dropped: tuple[int, int] | None = None  # the newest factor is useless: its step, kind of the solves until then
    latency: RunningMean = field(default_factory=RunningMean)  # steps from a matrix to its factor
    cost: RunningMean = field(default_factory=RunningMean)  # s, or operations, of a factorization
    cost_by_method: dict[str, RunningMean] = field(default_factory=dict)
    methods: dict[int, Method] = field(default_factory=dict)  # of the last jobs, by step
    workers: dict[int, str] = field(default_factory=dict)  # of the last factors, by step

    def age(self, step: int) -> int:
        """Returns the steps since the matrix of the newest factor, -1 without one."""
        return step - self.newest if self.newest >= 0 and self.dropped is None else -1

    def method(self, step: int) -> Method | None:
        """Returns how the factor of a step was made; None if that is not remembered."""
        return self.methods.get(step)

    def worker(self, step: int) -> str:
        """Returns who made the factor of a step; empty if that is not remembered."""
        return self.workers.get(step, "")

    def method_cost(self, method: Method) -> float:
        """Returns the mean cost of a factorization by a method [s, or operations]; 0 if there was none."""
        mean = self.cost_by_method.get(method.name)
        return 0.0 if mean is None or mean.value is None else mean.value

    def add(self, factor: Factor, cost: float) -> None:
        """Adds a factor. cost: of its making."""
        self.cost.add(cost)
        if method := self.method(factor.step):
            self.cost_by_method.setdefault(method.name, RunningMean()).add(cost)
        self.newest = factor.step
        _remember(self.workers, factor.step, factor.worker)
        self.used += 1
        self.regularized += bool(factor.remedy)


class BodyUpdateState:
    """The updates of one body.

    methods: by which `auto` may have its factors made; empty: the scene names the preconditioner
    error_bound: largest estimate of the error of a step that is not made again [m]
    counted: costs are bytes and operations instead of seconds, so that runs repeat exactly. A byte counts like an
        operation, which is about what a core makes of them.
    """

    def __init__(self, body: Body, methods: Sequence[Method] = (), counted: bool = False, error_bound: float = np.inf):
        self.body, self.counted, self.error_bound = body, counted, error_bound
        self.frozen = False  # it has run away and moves no more: needs no factors
        self.solves, self.job, self.failures, self.factors = (
            SolveStatistics(), JobState(), FailureState(), FactorStatistics(),
        )  # fmt: skip
        self.tuner = PreconditionerTuner(methods) if methods else None

    def request(self, step: int) -> UpdateRequest:
        """Returns what the scheduler is told at a step."""
        solves, job, factors = self.solves, self.job, self.factors
        age = factors.age(step)
        return UpdateRequest(
            self.body.name,
            solves.excess,
            None if job.sent is None else step - job.sent,
            job.in_flight or job.copy is not None,
            age if age >= 0 else None,
            1.0 if solves.iteration_cost.value is None else solves.iteration_cost.value,
            1.0 if factors.cost.value is None else factors.cost.value,
            self.failures.in_a_row,
            solves.lost,
            self.tuner is not None and self.tuner.wants_factor,
            solves.latest,
        )

    def on_job(self, step: int, method: Method) -> None:
        """Takes note that the matrix of a step is to be factorized."""
        _remember(self.factors.methods, step, method)
        if self.tuner is not None:
            self.tuner.factorization.on_sent()

    def on_sent(self, step: int) -> None:
        """Takes note that the copy of `step` was sent. It is kept until its factor came, which is checked with it."""
        job, solves = self.job, self.solves
        job.matrix = None if job.copy is None else (step, job.copy)
        job.positions = job.copy is not None and job.copy.ndim == 2
        job.in_flight, job.sent, job.copy = True, step, None
        job.excess, solves.excess = solves.excess, 0.0

    def on_factor(self, factor: Factor, step: int) -> bool:
        """Takes note of a factor that came during `step`; False if a newer one is there already."""
        job = self.job
        if job.in_flight and factor.step == job.sent:
            self.factors.latency.add(max(1, step - factor.step))
        job.in_flight, self.failures.in_a_row = False, 0
        if job.positions:
            self.failures.assemblies = 0
        if factor.step <= self.factors.newest:
            return False
        self.factors.add(factor, flops(factor.pattern) if self.counted else max(factor.seconds, MIN_SECONDS))
        self.solves.restart()
        job.sent = factor.step if job.sent is None else job.sent  # a factor made elsewhere
        return True

    def on_drop(self, kind: int, reason: str) -> None:
        """Takes note that the newest factor is not used any more. kind: of the solves until now."""
        self.factors.dropped, self.failures.reason = (self.factors.newest, kind), reason
        self.failures.in_a_row += 1

    def on_reassignment(self) -> None:
        """Takes note that its job takes too long; it may be sent to another worker."""
        self.job.in_flight = False
        self.solves.excess += self.job.excess

    def on_failure(self, reason: str, refused: bool = False) -> None:
        """Takes note that its job failed; it may be sent again. refused: it brought a factor that is not used."""
        self.on_reassignment()
        failures = self.failures
        failures.reason = reason
        failures.refused += 1
        failures.in_a_row += 1
        failures.assemblies += self.job.positions
        if self.tuner is not None:
            self.tuner.factorization.on_failure(refused)

    def observe(self, record: Any, floor: int, cost: float) -> None:
        """Takes note of a solve (a record of the loop).

        floor: iterations of a linear solve above which they are excess
        cost: of the solve [s, or bytes]
        """
        iterations, factor_step = int(record["iterations"]), int(record["factor_step"])
        form = int(record["form"])
        if form == FACTOR:
            lost = float(record["estimate"]) / self.error_bound
        else:
            solves = max(int(record["linearizations"]), 1) * (1 if form == ONE_SOLVE else STAGES)
            lost = max(iterations - floor * solves, 0)
        self.solves.add(lost, factor_step, self.factors.newest)
        self.failures.refused += int(record["fallbacks"])
        self.solves.iteration_cost.add(cost / (iterations + 1))
        if factor_step >= 0:
            self.solves.max_factor_age = max(self.solves.max_factor_age, int(record["step"]) - 1 - factor_step)


def excess(records: Any, floor: int, error_bound: Any) -> Any:
    """Returns what steps add to the sum by which their objects are ranked for a factor (scheduler.py).

    Of a step that iterates: its iterations above `floor` in each solve. Of a step by the factor alone: the estimate of
    its error over the bound [m], since it has no iterations, and a factor that ages costs accuracy instead.
    records: of the loop, of any shape that error_bound is broadcast to
    """
    stages = np.where(records["form"] == ONE_SOLVE, 1, STAGES)
    above = np.maximum(records["iterations"] - floor * stages * np.maximum(records["linearizations"], 1), 0)
    alone = records["form"] == FACTOR
    return np.where(alone, np.where(alone, records["estimate"], 0.0) / error_bound, above)


def observe_steps(states: Sequence[BodyUpdateState], r: NDArray[Any], floor: int) -> None:
    """Takes note of whole steps, as BodyUpdateState.observe does of each record of (steps, bodies), in seconds.

    Each round of the service thread gives a worker one job: with a thousand bodies this function is what it waits for.
    """
    steps, factor = len(r), r["factor_step"]
    above = excess(r, floor, np.array([state.error_bound for state in states]))
    weights = (1 - MEMORY) ** np.arange(steps - 1, -1, -1)
    each = r["solve"] / (r["iterations"] + 1)
    costs = weights @ each / weights.sum()
    rest = float((1 - MEMORY) ** steps)
    age = np.where(factor >= 0, r["step"] - 1 - factor, -1).max(axis=0)
    columns = (
        above.sum(axis=0),
        above[-1],
        (factor == factor[0]).all(axis=0),
        factor[0],
        costs,
        r["fallbacks"].sum(axis=0),
        age,
    )
    for k, (state, total, last, one, made, cost, fallbacks, oldest) in enumerate(
        zip(states, *(column.tolist() for column in columns), strict=True)
    ):
        solves, newest = state.solves, state.factors.newest
        state.failures.refused += fallbacks
        solves.iteration_cost.add_all(cost, rest, float(each[0, k]))
        solves.max_factor_age = max(solves.max_factor_age, oldest)
        if one and (made < 0 or made == solves.factor_step == newest):
            solves.excess, solves.latest = solves.excess + total, float(last)
            solves.lost += total if made >= 0 else 0
            continue
        for i in range(steps):
            solves.add(float(above[i, k]), int(factor[i, k]), newest)


def _remember(table: dict[int, Any], step: int, value: Any) -> None:
    table[step] = value
    if len(table) > MAX_REMEMBERED:
        del table[next(iter(table))]
