# SPDX-License-Identifier: MIT
"""Runs a simulation under its scene's update policy (policies/): matrices out, factors in, steps.

`advance` makes steps and waits where the policy says so. For async and adaptive the loop may run on its own instead
(Engine.run in a thread, which lets go of Python's lock), and `pump` is called beside it.
"""

import logging
import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from protocol.counters import Counters
from protocol.factor import Factor
from protocol.method import Method
from sim_server.arrays import Float64, Int64
from sim_server.backends.base import Capability
from sim_server.backends.cpu.structs import REACTION
from sim_server.backends.factors_together import FactorsTogether
from sim_server.mechanics.world import Body
from sim_server.simulation import Simulation
from sim_server.updates.body_state import BodyUpdateState, MadeFactors, on_checks, on_factors
from sim_server.updates.factor_check import FactorCheck
from sim_server.updates.factor_source import FactorSource, Inline, Job
from sim_server.updates.jobs_together import JobsTogether
from sim_server.updates.many_factors import MANY, ManyFactors
from sim_server.updates.patterns import Patterns
from sim_server.updates.policies import make_policy
from sim_server.updates.snapshots import SnapshotPool
from sim_server.updates.solve_observer import SolveObserver
from sim_server.updates.update_table import NONE, UpdateRequests, UpdateTable
from sim_server.updates.useless_factors import UselessFactors

log = logging.getLogger(__name__)

LARGE = 4 << 20  # bytes of a factor whose check takes more than a few milliseconds
MAX_CAUSES = 20  # reasons of missing factors that are logged of an object, each once


class CheckFailed(str):
    """Reason of a factor whose check ended in an error: no fault of its worker."""


class FactorsUnderCheck(NamedTuple):
    """A large factor, or many, that are checked beside the service thread.

    memory: of the copy of the matrix of each, to be used again afterwards; None: there is none
    """

    factors: Sequence[Factor]
    memory: Sequence[NDArray[np.float64] | None]
    reasons: Future[list[str]]


class Driver:
    """Runs one simulation under its scene's update policy.

    source: makes factors; None: this process does
    reactions: (k, obstacles, 6) force [N] and torque [N m] on each obstacle by the object of each record that was
        returned last
    other_reactions: (k,) of struct Reaction, on grabs and other objects, in the steps of those records
    readings: of those records, the numbers of `measured` of the object of each, (k, most of an object)
    counted: the scheduler and `auto` reckon with bytes and operations instead of seconds, so that a run repeats
        exactly; None: unless no step waits for a factor
    """

    def __init__(self, simulation: Simulation, source: FactorSource | None = None, counted: bool | None = None):
        self.simulation, self.engine = simulation, simulation.engine
        self.solver = simulation.scene.solver
        self._method, self._dtype = self.solver.method, self.solver.factor_dtype  # of each of thousands of jobs
        world, self._patterns = simulation.world, Patterns.of(simulation)
        alone = simulation.scene.uses_factor_alone  # in place of A: it must be exact, so nothing is to choose from
        self.inline, self.check = Inline(self._patterns), FactorCheck(self._patterns, alone)
        self.source: FactorSource = source or self.inline
        self.policy = make_policy(self)
        self.counted = not self.policy.free if counted is None else counted
        methods = () if alone else self.solver.choices(world.backend.name)
        bounds = simulation.integrator.error_bounds
        self.table = table = UpdateTable(len(world.bodies))
        self.bodies = [BodyUpdateState(b, methods, self.counted, bounds[b.index], table) for b in world.bodies]
        self.tuned = bool(methods)  # `auto` chooses how systems are solved
        self.by_name = {s.body.name: s for s in self.bodies}
        self.wants_factors = self.solver.wants_factors
        if self.wants_factors:
            self.check.prepare()
            self.engine.prepare_for_factors()
            self.source.use_memory(self.engine.factor_memory)
            if self.policy.free:
                self.engine.prepare_copies()
        self.reactions: Float64 = np.zeros((0, 0, 6))
        self.other_reactions: NDArray[Any] = np.zeros(0, REACTION)
        self.readings: Float64 = np.zeros((0, 0))
        self.counters = Counters(log)  # of errors of checks
        self.wake: Callable[[], None] = lambda: None  # called in another thread when `pump` has something to take up
        self.on_adopt: list[Callable[[Factor], Any]] = []  # called with every factor that the loop is given
        self.on_epoch: list[Callable[[Body, int], None]] = []  # called before the first job of an epoch of a body
        self._many = ManyFactors(self)
        self.snapshots = SnapshotPool(simulation, self.source, table, self.policy.expected_latency)
        if self.wants_factors and self.policy.free:
            self.source.check_with(self._many.begin_check)
        self.useless_factors = UselessFactors(self)
        self.checks: list[FactorsUnderCheck] = []  # oldest first
        self._behind: list[Factor] = []  # that wait for the end of the check of the factor before them
        self._begin_checks()
        self._observer = SolveObserver(self)
        self._names = [b.name for b in world.bodies]
        self._warped = [b.index in simulation.warped for b in world.bodies]
        self._alike = not self.tuned and simulation.splits is None and self.solver.build != "worker"
        """All jobs are of the first epoch, by one method, of matrices."""
        self._blocks = [simulation.system.most_blocks(b.first, b.last) for b in world.bodies]

    # --- steps --------------------------------------------------------------------------------------------------

    def advance(self, steps: int) -> NDArray[Any]:
        """Makes steps; returns their records (structs.RECORD)."""
        out: list[tuple[NDArray[Any], ...]] = []
        for _ in range(steps):
            if self.wants_factors:
                self.policy.step()
            else:
                self.engine.run(1)
            out.append((self._new_records(), *self.beside_records))
        if not out:
            out.append((*self.engine.records_and_reactions(), self.engine.other_reactions(), self.engine.readings))
        records, *others = (np.concatenate(part) for part in zip(*out, strict=True))
        self.reactions, self.other_reactions, self.readings = others
        return records

    @property
    def beside_records(self) -> tuple[Float64, NDArray[Any], Float64]:
        """Reactions, other reactions and readings of the records that were returned last."""
        return self.reactions, self.other_reactions, self.readings

    def pump(self) -> NDArray[Any]:
        """Reads records, posts factors and sends matrices while the loop runs on its own. Returns the new records."""
        records = self._new_records()
        if self.wants_factors:
            self.policy.pump()
        return records

    def step_with_fresh_factors(self) -> NDArray[Any]:
        """Makes a step with the factors of its own matrices, whatever the policy; returns its records."""
        self.solve_with_fresh_factors()
        return self._new_records()

    def solve_with_fresh_factors(self) -> None:
        """Makes a step that waits for the factors of its own matrices, made in this process."""
        self.engine.assemble()
        for state in self.bodies:
            if not state.frozen:
                self.inline.submit(self.assembled_job(state))
        self.receive(self.inline, partial(self.adopt, now=True))
        self.engine.solve()

    def _new_records(self) -> NDArray[Any]:
        records, self.reactions = self.engine.records_and_reactions()
        self.other_reactions, self.readings = self.engine.other_reactions(), self.engine.readings
        self.observe(records)
        return records

    def observe(self, records: NDArray[Any]) -> None:
        """Sums up what solves cost, lets `auto` choose, drops useless factors."""
        records = np.ascontiguousarray(records)
        self.useless_factors.observe(records, self._observer.observe(records))

    # --- matrices out -------------------------------------------------------------------------------------------

    def requests(self, ahead: bool = False) -> UpdateRequests:
        """Returns what the scheduler is told of each body but those that are frozen.

        ahead: only of those whose last factor is checked beside the steps, which count as in flight otherwise: of those
            whose next matrix may go ahead of it, one alone: there are two places for copies. It does where factors
            have been of use and `auto` compares none
        """
        tuners = [state.tuner for state in self.bodies] if self.tuned else []
        on_trial = [t is not None and t.wants_factor for t in tuners]
        compared = [t is not None and t.factorization.candidate is not None for t in tuners]
        return self.table.requests(self.engine.step, ahead, on_trial, compared)

    def make_job(self, state: BodyUpdateState, step: int | None = None) -> Job | None:
        """Returns the job of the copy that the loop has made for a body. None: the copy does not suffice and is
        discarded. step: of the copy, where that is known"""
        copy = state.job.copy
        assert copy is not None
        step = self.snapshots.step(state) if step is None else step
        if self.snapshots.suffices(state, step) and self._is_present(state, step):
            return self._job(state, step, copy, self.engine.staged_matrix(state.body.index))
        self.snapshots.discard(state)
        return None

    def make_jobs(self, bodies: Int64, steps: Int64) -> Sequence[Job]:
        """Returns the jobs of the copies of some steps that the loop has made for bodies. Those that do not suffice are
        discarded."""
        if not self._alike:
            made = [
                self.make_job(self.bodies[k], step) for k, step in zip(bodies.tolist(), steps.tolist(), strict=True)
            ]
            return [job for job in made if job is not None]
        rows = bodies.tolist()
        names, warps, blocks, copies = (
            [column[row] for row in rows] for column in (self._names, self._warped, self._blocks, self.table.copies)
        )
        return JobsTogether(
            bodies, names, [1] * len(rows), steps.tolist(), warps, cast(list[Float64], copies), blocks,
            self.table.copy_at[bodies], self._dtype, self._method, self.engine.staged_matrices(bodies).tolist(),
        )  # fmt: skip

    def _is_present(self, state: BodyUpdateState, step: int) -> bool:
        """False if the copy is of a matrix from before the body was split for the last time, or after it."""
        s, body = self.simulation, state.body
        if s.splits is None:
            return True
        epoch = s.epoch(body.name, step)
        blocks = int(s.system.row_start[body.last] - s.system.row_start[body.first])
        return epoch == s.epoch(body.name, s.engine.step) and blocks == len(self._patterns.at(body.name, epoch)[1])

    def assembled_job(self, state: BodyUpdateState) -> Job:
        """Returns the job of the matrix of a body as last assembled; between `assemble` and `solve` of the engine."""
        step, values = self.engine.step, self.engine.factor_matrix(state.body.index)
        state.job.matrix = step, values
        return self._job(state, step, values)

    def _job(self, state: BodyUpdateState, step: int, values: NDArray[np.float64], on_device: int = 0) -> Job:
        name, epoch = state.body.name, self.simulation.epoch(state.body.name, step)
        if self.simulation.splits is not None:
            if values.ndim == 3:  # the copy has room for more blocks
                values = values[: len(self._patterns.at(name, epoch)[1])]
            if self.source.epoch(name) not in (None, epoch):
                for begin in self.on_epoch:
                    begin(state.body, epoch)
        method = self._method if state.tuner is None else state.tuner.factorization.method
        state.on_job(step, method)
        return Job(name, epoch, step, self._warped[state.body.index], values, self._dtype, method, on_device)

    # --- factors in ---------------------------------------------------------------------------------------------

    def receive(self, source: FactorSource, on_factors: Callable[[Sequence[Factor]], None]) -> None:
        """Passes on the factors that a source has made since the last call, and takes note of failed jobs and of
        patterns that factors will have."""
        self._end_checks()
        self.expect_factors(source)
        together = source.poll_together() if self.policy.free else []
        alone = source.poll()  # at once: what comes while others are adopted would be among these, one by one
        for each in together:
            self._many.adopt(each)
        behind, self._behind = self._behind, []
        if factors := [*behind, *alone]:
            on_factors(factors)
        for name, reason in source.failures():
            self.fail(name, reason)

    def expect_factors(self, source: FactorSource) -> None:
        """Has the loop prepare for the factors whose patterns have come."""
        for name, pattern in source.patterns():
            self.engine.expect_factors(self.by_name[name].body.index, pattern)

    def adopt(self, factors: Sequence[Factor], now: bool = False) -> None:
        """Puts factors into the mailboxes of their bodies, unless a newer one is there or the check refuses it.

        The factor of a frozen body is not checked, since no solve uses it. now: large ones, too, are checked before
        this returns; else, where no step waits for them, that is done beside the caller, and so it is with many.
        """
        beside = self.policy.free and not now
        together: list[Factor] = []
        chosen: set[str] = set()  # objects of these
        for factor in factors:
            state = self.by_name[factor.object]
            if beside and (factor.object in chosen or not self._may_check(state, factor)):
                self._behind.append(factor)  # its job counts as in flight, so that none comes behind it
            elif factor.step <= state.factors.newest or state.frozen:
                self.snapshots.release(state, factor.step)
                self._take_up([factor], [""])
            elif beside and factor.worker != Inline.WORKER and factor.values.nbytes > LARGE:
                self._check_beside([factor])
            else:
                together.append(factor)
                chosen.add(factor.object)
        if beside and len(together) >= MANY and together[0].worker != Inline.WORKER:
            self._check_beside(together)
        elif together:
            at_once = [(f, self.snapshots.release(self.by_name[f.object], f.step)) for f in together]
            self._take_up(together, self.reasons(len(at_once), self.check.reject_reasons, at_once))
        self.policy.on_job_end()

    def _may_check(self, state: BodyUpdateState, factor: Factor) -> bool:
        """False while a factor of the body is checked, or a large one could not be made ready at once: the checks of
        others would wait for it."""
        large = factor.values.nbytes > LARGE
        return self.table.checked[state.body.index] == NONE and (not large or self.engine.may_prepare(state.body.index))

    def _check_beside(self, factors: Sequence[Factor]) -> None:
        states, steps = [self.by_name[factor.object] for factor in factors], [factor.step for factor in factors]
        held = [self.snapshots.hold(state, step) for state, step in zip(states, steps, strict=True)]
        checked = [(factor, matrix) for factor, (_, matrix) in zip(factors, held, strict=True)]
        on_checks(self.table, [state.body.index for state in states], steps)

        def begin() -> Future[list[str]]:
            applied = self._prepare(factors[0]) if len(factors) == 1 else None
            return self._checker.submit(self.reasons, len(checked), self.check.reject_reasons, checked, applied)

        self._begin_check(factors, [memory for memory, _ in held], begin)

    def check_together(
        self, factors: FactorsTogether, memory: Sequence[Float64 | None], matrices: Sequence[Float64 | None]
    ) -> None:  # fmt: skip
        """Begins to check factors beside the caller. memory, matrices: as of FactorsUnderCheck, and of FactorCheck"""
        check = partial(self._checker.submit, self.reasons, len(factors), self.check.reject_together)
        self._begin_check(factors, memory, partial(check, factors, matrices))

    def _begin_check(
        self, factors: Sequence[Factor], memory: Sequence[Float64 | None], begin: Callable[[], Future[list[str]]]
    ) -> None:  # fmt: skip
        reasons: Future[list[str]] = Future()
        try:
            reasons = begin()
        except Exception as error:  # "can't start new thread", or of the device
            reasons.set_result(self._check_failed(error, len(factors)))
        reasons.add_done_callback(lambda _: self.wake())
        self.checks.append(FactorsUnderCheck(factors, memory, reasons))

    def reasons(self, count: int, check: Callable[..., list[str]], *arguments: Any) -> list[str]:
        """Returns why each of so many factors is not used, as a check tells. Whatever error it raises, none of them is,
        and the run goes on. From any thread."""
        try:
            return check(*arguments)
        except Exception as error:
            return self._check_failed(error, count)

    def _check_failed(self, error: Exception, factors: int) -> list[str]:
        """Counts an error of the check of some factors; returns why they are not used."""
        refusal = self.counters.unexpected(error, "its check failed")
        self.counters.refuse(refusal)
        return [CheckFailed(refusal)] * factors

    def _prepare(self, factor: Factor) -> Callable[[], Float64 | None] | None:
        """Has a large factor made ready for use while it is checked, and applied for the check."""
        if self.check.wrong_size(factor):
            return None
        body = self.by_name[factor.object].body.index
        return self.engine.prepare_factor(body, factor, self.check.vector(factor.object, factor.epoch))

    def _begin_checks(self) -> None:
        self._checker, self._process = ThreadPoolExecutor(1, "checks of factors"), os.getpid()

    def _end_checks(self) -> None:
        """Takes up the factors whose checks have ended. In a process that was forked no thread is at those before."""
        if self._process != os.getpid():
            self._begin_checks()
            lost, self.checks = self.checks, []
            for factor in [factor for check in lost for factor in check.factors]:
                self.fail(factor.object, "its check ended with the process that it was in", step=factor.step)
        ended = [each for each in self.checks if each.reasons.done()]
        for check in ended:
            self.checks.remove(check)
            for memory in check.memory:
                if memory is not None:
                    self.snapshots.recycle(memory)
            self.take_up(check.factors, check.reasons.result())

    def take_up(self, factors: Sequence[Factor], reasons: Sequence[str]) -> None:
        """Gives the loop factors whose check has ended. reasons: why each is not to be used; empty if it is"""
        self.policy.on_job_end()
        if isinstance(factors, FactorsTogether) and self._many.take_up(factors, reasons):
            return
        good, why = [], []
        for factor, reason in zip(factors, reasons, strict=True):
            if self.source.epoch(factor.object) not in (None, factor.epoch):
                self.engine.drop_factor(self.by_name[factor.object].body.index, factor)
                self.fail(factor.object, "it was of a mesh that was split since", step=factor.step)
                continue
            good.append(factor)
            why.append(reason)
        self._take_up(good, why)

    def _take_up(self, factors: Sequence[Factor], reasons: Sequence[str]) -> None:
        """Puts factors into the mailboxes of their bodies. reasons: why each is not to be used; empty if it is."""
        good: list[Factor] = []
        for factor, why in zip(factors, reasons, strict=True):
            if why:
                bad = not isinstance(why, CheckFailed)
                if bad:
                    self.useless_factors.on_rejected(factor)
                self.fail(factor.object, f"that of {factor.worker} is not used: {why}", refused=bad, step=factor.step)
            else:
                good.append(factor)
        newer = self._on_factors(good)  # others are older than the newest
        posted = [factor for factor, better in zip(good, newer, strict=True) if better]
        used = {id(factor) for factor in posted}
        for factor in factors:
            if id(factor) not in used:
                self.engine.drop_factor(self.by_name[factor.object].body.index, factor)
        bodies = [self.by_name[factor.object].body.index for factor in posted]
        self.engine.post_factors(bodies, posted)
        for factor in posted:
            self.tell(self.by_name[factor.object], factor)

    def _on_factors(self, factors: Sequence[Factor]) -> list[bool]:
        """Takes note of factors; returns which are newer than those of their bodies."""
        states, step = [self.by_name[factor.object] for factor in factors], self.engine.step
        if self.counted or len(factors) < MANY or len({factor.object for factor in factors}) < len(factors):
            return [state.on_factor(factor, step) for state, factor in zip(states, factors, strict=True)]
        rows = np.array([state.body.index for state in states], np.int64)
        return on_factors(self.bodies, rows, MadeFactors.of(factors), step)

    def tell(self, state: BodyUpdateState, factor: Factor) -> None:
        """Tells observers, and `auto`, of a factor that the loop was given."""
        if not self.policy.free:
            state.factors.kept = replace(factor, values=factor.values.copy())
        # Tell observers how it was made
        method = self.method(state.body.index, factor.step)
        if self.on_adopt:
            at_end = Capability.MATRIX_POSITIONS not in self.engine.capabilities
            later = state.job.positions and at_end and factor.worker != self.inline.WORKER
            name = method.name if method else factor.method
            ahead, later = state.job.extrapolated or factor.ahead, later or factor.later
            if (ahead, later, name) != (factor.ahead, factor.later, factor.method):
                factor = replace(factor, ahead=ahead, later=later, method=name)
            for observe in self.on_adopt:
                observe(factor)
        # Let `auto` try it
        if state.tuner is not None:
            state.tuner.on_factor(method)
            self.apply_choice(state)
        self.useless_factors.resume(state)

    def take_back(self, factor: Factor) -> None:
        """Gives the loop a factor that was in use when the run was saved; nobody is told of it."""
        state = self.by_name[factor.object]
        state.on_job(factor.step, self.solver.method_named(factor.method))
        state.on_factor(factor, self.engine.step)
        state.factors.kept = factor
        self.engine.resume_factor(state.body.index, factor.pattern, factor.values, factor.step)
        self.engine.settle_factors()

    def fail(self, name: str, reason: str, refused: bool = False, step: int | None = None) -> None:
        """Takes note of a job without a factor, or with one that is refused; the object may be sent again.

        step: of its matrix; None: of the one sent last
        """
        state = self.by_name[name]
        if state.on_failure(reason, refused, step):
            self.snapshots.release(state)
        self.policy.on_job_end()
        self.report(state, reason)

    def report(self, state: BodyUpdateState, reason: str) -> None:
        """Logs why a factor is missing or not used: once per cause, since the status counts them."""
        cause, reported = re.sub(r"[0-9.e+-]*[0-9]", "#", reason), state.failures.reported
        if cause not in reported and len(reported) < MAX_CAUSES and not state.frozen:
            reported.add(cause)
            log.warning("object %r: no factor: %s", state.body.name, reason)

    def apply_choice(self, state: BodyUpdateState) -> None:
        """Gives the loop what `auto` has chosen for the next solve of a body."""
        assert state.tuner is not None
        settings = self.engine.settings(state.body.index)
        settings.kind, settings.probe = state.tuner.kind, state.tuner.probe

    def method(self, body: int, step: int) -> Method | None:
        """Returns how the factor of a step was made; None if that is not remembered."""
        return self.bodies[body].factors.method(step) if self.tuned else self._method

    def age_bound(self) -> int:
        """Returns the age [steps] that no factor exceeds while all goes well, by what was measured; -1: not known."""
        return self.policy.max_age() if self.wants_factors else -1
