# SPDX-License-Identifier: MIT
"""What is known of the updates of one body: its solves, the job in flight, failures and factors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from protocol.factor import Factor
from protocol.method import Method
from protocol.shared_memory.located import address
from sim_server.arrays import Float64, Int64
from sim_server.backends.rosenbrock import FORMS
from sim_server.mechanics.world import Body
from sim_server.updates.autotune.preconditioner import PreconditionerTuner
from sim_server.updates.stats import RunningMean, flops
from sim_server.updates.update_table import NONE, TEXT, Cell, MeanCell, UpdateTable

MAX_REMEMBERED = 32  # factors whose method and worker are remembered
ONE_SOLVE, FACTOR = FORMS["ONE_SOLVE"], FORMS["FACTOR"]
STAGES: int = TEXT.constant("STAGES")  # linear solves of a step of the other forms
MIN_SECONDS = 1e-6  # s; a factorization is never taken to be faster


class SolveStatistics:
    """Sums over the solves of a body; excess is the number of iterations above the floor.

    excess: since the last matrix was sent, or its factor taken up
    latest: excess of the last solve
    lost: excess of the solves with the factor in use
    factor_step: of the factor in use
    max_factor_age: steps; -1: no factor was used
    iteration_cost: s, or bytes
    first_excess: of the first solve with a new factor
    """

    excess, latest, lost, factor_step, max_factor_age = Cell(), Cell(), Cell(), Cell(), Cell()

    def __init__(self, table: UpdateTable, index: int):
        self._table, self._index = table, index
        self.iteration_cost = MeanCell(table.iteration_cost, index)
        self.first_excess = MeanCell(table.first_excess, index)

    def add(self, excess: Iterable[float], factor_steps: Iterable[int], newest: int) -> None:
        """Adds solves, one after another.

        factor_steps: of their factors, -1: it had none
        newest: step of the newest factor that was taken up
        """
        total, latest, lost, last = self.excess, self.latest, self.lost, self.factor_step
        for each, step in zip(excess, factor_steps, strict=True):
            if 0 <= step < newest:  # made before the newest factor was taken up
                continue
            if step >= 0:
                if step != last:
                    last, lost, total = step, 0.0, 0.0
                    self.first_excess.add(each)
                lost += each
            total, latest = total + each, each
        self.excess, self.latest, self.lost, self.factor_step = total, latest, lost, last

    def restart(self) -> None:
        """A new factor was taken up: what is known of the solves so far is of another one."""
        self.lost = 0.0
        self.excess = self.latest = self.first_excess.value or 0.0


class JobState:
    """The matrix that is being copied or factorized.

    copy: into which the loop copies the matrix or the positions requested (`set_copy`)
    request: number of the request for that copy, among those of all bodies; requested: when it was [s, monotonic]
    extrapolated: by how much the positions requested were extrapolated [s]
    sent: step of the last matrix that was sent; None: none was
    checked: step of the matrix whose factor has come and is checked beside the steps; NONE: there is none
    matrix: of the job in flight: step and what was sent
    positions: the last job held positions, from which the worker assembles the matrix
    excess_sent: of the body when the last matrix was sent: to be restored if the job fails
    """

    in_flight, checked, excess_sent = Cell(), Cell(), Cell()
    request, requested, extrapolated, positions = Cell(), Cell(), Cell(), Cell()

    def __init__(self, table: UpdateTable, index: int):
        self._table, self._index = table, index

    @property
    def copy(self) -> Float64 | None:
        return self._table.copies[self._index]

    def set_copy(self, copy: Float64 | None) -> None:
        """Takes note of the memory that the loop is asked to copy into; None: the copy is given up."""
        self._table.copies[self._index], self._table.copying[self._index] = copy, copy is not None
        self._table.copy_at[self._index] = 0 if copy is None else address(copy)

    @property
    def matrix(self) -> tuple[int, Float64] | None:
        held = self._table.matrices[self._index]
        return None if held is None else (self._table.matrix_steps.item(self._index), held)

    @matrix.setter
    def matrix(self, matrix: tuple[int, Float64] | None) -> None:
        step, held = (NONE, None) if matrix is None else matrix
        self._table.matrix_steps[self._index], self._table.matrices[self._index] = step, held

    @property
    def sent(self) -> int | None:
        step = int(self._table.sent[self._index])
        return None if step == NONE else step

    @sent.setter
    def sent(self, step: int | None) -> None:
        self._table.sent[self._index] = NONE if step is None else step


class FailureState:
    """Jobs and factors that were of no use.

    in_a_row: jobs without a factor that is used
    assemblies: jobs in a row with positions that brought no factor
    refused: factors, and solves that abandoned theirs
    reason: of the last one
    reported: causes that the log has
    """

    in_a_row, refused, assemblies = Cell("failures"), Cell(), Cell()

    def __init__(self, table: UpdateTable, index: int):
        self._table, self._index = table, index
        self.reason = ""
        self.reported: set[str] = set()


class FactorStatistics:
    """Factors that were taken up.

    used: how many; regularized: of these, made from a matrix that was not positive definite
    newest: step of the matrix of the newest factor
    kept: the newest one, under policies by which a run repeats
    latency: steps from a matrix to its factor
    cost, cost_by_method: of a factorization [s, or operations]
    methods: of the last jobs by step, where methods are chosen
    """

    newest, used, regularized = Cell(), Cell(), Cell()

    def __init__(self, table: UpdateTable, index: int):
        self._table, self._index = table, index
        self.kept: Factor | None = None
        self._dropped: tuple[int, int] | None = None
        self.latency, self.cost = MeanCell(table.latency, index), MeanCell(table.cost, index)
        self.cost_by_method: dict[str, RunningMean] = {}
        self.methods: dict[int, Method] = {}

    @property
    def dropped(self) -> tuple[int, int] | None:
        """The newest factor is useless: its step, kind of the solves until then."""
        return self._dropped

    @dropped.setter
    def dropped(self, dropped: tuple[int, int] | None) -> None:
        self._dropped, self._table.dropped[self._index] = dropped, dropped is not None

    def age(self, step: int) -> int:
        """Returns the steps since the matrix of the newest factor, -1 without one."""
        return step - self.newest if self.newest >= 0 and self.dropped is None else -1

    def method(self, step: int) -> Method | None:
        """Returns how the factor of a step was made; None if that is not remembered."""
        return self.methods.get(step)

    def worker(self, step: int) -> str:
        """Returns who made the factor of a step; empty if that is not remembered."""
        return self._table.makers.worker(self._index, step)

    @property
    def workers(self) -> dict[int, str]:
        """Who made the last factors, by step."""
        return self._table.makers.of(self._index)

    def method_cost(self, method: Method) -> float:
        """Returns the mean cost of a factorization by a method [s, or operations]; 0 if there was none."""
        mean = self.cost_by_method.get(method.name)
        return 0.0 if mean is None or mean.value is None else mean.value

    def add(self, factor: Factor, cost: float) -> None:
        """Adds a factor. cost: of its making."""
        self.cost.add(cost)
        self.newest = factor.step
        self.used += 1
        self.regularized += bool(factor.remedy)
        self._table.makers.note(np.array([self._index]), np.array([factor.step]), [factor.worker])
        self.note_method(factor.step, cost)

    def note_method(self, step: int, cost: float) -> None:
        """Remembers what a factor has cost by the method of its job."""
        if (method := self.methods.get(step)) is not None:
            if (mean := self.cost_by_method.get(method.name)) is None:
                mean = self.cost_by_method[method.name] = RunningMean()
            mean.add(cost)


class BodyUpdateState:
    """The updates of one body.

    methods: by which `auto` may have its factors made; empty: the scene names the preconditioner
    error_bound: largest estimate of the error of a step that is not made again [m]
    counted: costs are bytes and operations instead of seconds, so that runs repeat exactly. A byte counts like an
        operation, which is about what a core makes of them.
    table: of all bodies, with a row for this one; None: one of its own
    """

    frozen = Cell()  # it has run away and moves no more: needs no factors

    def __init__(
        self, body: Body, methods: Sequence[Method] = (), counted: bool = False, error_bound: float = np.inf,
        table: UpdateTable | None = None,
    ):  # fmt: skip
        self.body, self.counted, self.error_bound = body, counted, error_bound
        self._table, self._index = (UpdateTable(1), 0) if table is None else (table, body.index)
        row = self._table, self._index
        self._table.error_bound[self._index] = error_bound
        self.solves, self.job, self.failures, self.factors = (
            SolveStatistics(*row), JobState(*row), FailureState(*row), FactorStatistics(*row),
        )  # fmt: skip
        self.tuner = PreconditionerTuner(methods) if methods else None

    def on_job(self, step: int, method: Method) -> None:
        """Takes note that the matrix of a step is to be factorized."""
        if self.tuner is not None:
            _remember(self.factors.methods, step, method)
            self.tuner.factorization.on_sent()

    def on_sent(self, step: int) -> None:
        """Takes note that the copy of `step` was sent. It is kept until its factor came, which is checked with it."""
        on_sent(self._table, [self._index], [step])

    def on_factor(self, factor: Factor, step: int) -> bool:
        """Takes note of a factor that came during `step`; False if a newer one is there already."""
        job = self.job
        if self._end_check(factor.step) or (job.in_flight and factor.step == job.sent):
            self.factors.latency.add(max(1, step - factor.step))
        job.in_flight, self.failures.in_a_row = job.in_flight and (job.sent or 0) > factor.step, 0
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
        self.solves.excess += self.job.excess_sent

    def on_failure(self, reason: str, refused: bool = False, step: int | None = None) -> bool:
        """Takes note that a job failed; it may be sent again. Returns False if a newer one has been sent since.

        refused: it brought a factor that is not used
        step: of its matrix; None: of the one sent last
        """
        last = step is None or step == self.job.sent
        if step is not None:
            self._end_check(step)
        if last:
            self.on_reassignment()
        failures = self.failures
        failures.reason = reason
        failures.refused += 1
        failures.in_a_row += 1
        failures.assemblies += self.job.positions
        if last and self.tuner is not None:
            self.tuner.factorization.on_failure(refused)
        return last

    def _end_check(self, step: int) -> bool:
        """True if the factor of a step was checked beside the steps, which is over now."""
        was = bool(self.job.checked == step)
        if was:
            self.job.checked = NONE
        return was

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
        self.solves.add([float(lost)], [factor_step], self.factors.newest)
        self.failures.refused += int(record["fallbacks"])
        self.solves.iteration_cost.add(cost / (iterations + 1))
        if factor_step >= 0:
            self.solves.max_factor_age = max(self.solves.max_factor_age, int(record["step"]) - 1 - factor_step)


def on_requests(
    table: UpdateTable, rows: Int64, copies: Sequence[Float64], at: Int64, first: int, now: float
) -> None:  # fmt: skip
    """Takes note of the memory that the loop is asked to copy the matrices of different bodies into.

    at: addresses of the copies. first: number of the first request, in their order. now: [s, monotonic]
    """
    for row, copy in zip(rows.tolist(), copies, strict=True):
        table.copies[row] = copy
    table.copying[rows], table.copy_at[rows] = True, at
    table.request[rows], table.requested[rows] = np.arange(first, first + len(rows)), now
    table.extrapolated[rows] = 0.0


def on_sent(table: UpdateTable, bodies: Sequence[int] | Int64, steps: Sequence[int] | Int64) -> None:
    """Takes note of copies that were sent, of some steps. They are kept until their factors came."""
    rows, copies, matrices = np.asarray(bodies, np.int64), table.copies, table.matrices
    for row in rows.tolist():
        matrices[row], copies[row] = copies[row], None
    sent = [matrices[row] for row in rows.tolist()]
    table.positions[rows] = [matrix is not None and matrix.ndim == 2 for matrix in sent]
    table.sent[rows] = steps
    table.matrix_steps[rows] = np.where([matrix is None for matrix in sent], NONE, table.sent[rows])
    table.in_flight[rows], table.copying[rows] = True, False
    table.excess_sent[rows], table.excess[rows] = table.excess[rows], 0.0


def on_checks(table: UpdateTable, rows: Sequence[int], steps: Sequence[int]) -> None:
    """Takes note that factors of different bodies, of some steps, have come, which are checked beside the steps: their
    next matrices may be sent meanwhile."""
    row, made = np.asarray(rows), np.asarray(steps)
    table.checked[row] = made
    table.in_flight[row] &= table.sent[row] != made


class MadeFactors(NamedTuple):
    """What is noted of factors, a column each: step of the matrix, time of the factorization [s], worker, and whether
    the matrix was not positive definite."""

    steps: Sequence[int]
    seconds: Sequence[float]
    workers: Sequence[str]
    regularized: Sequence[bool]

    @classmethod
    def of(cls, factors: Sequence[Factor]) -> MadeFactors:
        """Returns it of factors."""
        workers, regularized = [factor.worker for factor in factors], [bool(factor.remedy) for factor in factors]
        return cls([factor.step for factor in factors], [factor.seconds for factor in factors], workers, regularized)


def on_factors(states: Sequence[BodyUpdateState], bodies: Int64, made: MadeFactors, step: int) -> list[bool]:
    """Takes note of factors of different bodies, as BodyUpdateState.on_factor does of each, with costs in seconds.
    Returns of each whether it is newer than that of its body.

    states: of all bodies of one table. step: during which they came
    """
    table, steps, costs = states[0]._table, np.array(made.steps, np.int64), np.maximum(made.seconds, MIN_SECONDS)
    newer = np.array(table.on_factors(bodies, steps, costs, step), np.bool_)
    table.assemblies[bodies[table.positions[bodies]]] = 0
    own, places = bodies[newer], np.flatnonzero(newer).tolist()
    table.makers.note(own, steps[newer], [made.workers[k] for k in places])
    table.regularized[own] += np.array(made.regularized, np.int64)[newer]
    if states[0].tuner is not None:
        for k in places:
            states[bodies[k]].factors.note_method(made.steps[k], float(costs[k]))
    return list(newer.tolist())


def _remember(table: dict[int, Any], step: int, value: Any) -> None:
    table[step] = value
    if len(table) > MAX_REMEMBERED:
        del table[next(iter(table))]
