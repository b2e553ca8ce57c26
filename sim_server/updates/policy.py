# SPDX-License-Identifier: MIT
"""When matrices go out and factors come in: the update policies of Courtecuisse et al. 2010, sections 4 and 5.

    never       one factor, made in this process from the first matrix (PCG-0)
    every-N     a new one in this process each N-th step, which waits for it (PCG-1, PCG-30)
    async       matrices to workers, one of an object at a time; a factor is taken up as it comes; nothing waits
    adaptive    async, but a matrix goes out only once the excess iterations have cost as much as a factorization
    lockstep-D  async, but a factor made from step t is taken up at step t + D exactly: the deterministic twin

`advance` makes steps and waits where the policy says so. For async and adaptive the loop runs on its own (Engine.run in
a thread that has let go of Python's lock) and `pump` is called beside it.
"""

import logging
import re
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from protocol.messages_pb2 import RUNAWAY
from protocol.method import Method
from sim_server.backends.cpu.engine import Kind
from sim_server.mechanics.world import Body
from sim_server.simulation import Simulation
from sim_server.updates.convergence import Reached, reached
from sim_server.updates.factor_check import Guard
from sim_server.updates.factor_source import FactorSource, Inline, Job
from sim_server.updates.prefetch import Stock
from sim_server.updates.scheduler import Need, oldest_possible, overdue_after, pays, pick
from sim_server.updates.snapshots import Copies
from sim_server.updates.stats import Track, observe_steps
from sim_server.updates.useless_factors import Dropping

log = logging.getLogger(__name__)


COPIES = 32  # matrices that the loop may be asked to copy within one step
CAUSES = 20  # told of an object, each once
TOGETHER = 8  # records at least that are summed up together
KEPT = 2  # steps that a copied matrix may wait for a worker


class Driver:
    """Runs one simulation under its scene's update policy.

    source: of factors; None: this process. counted: the scheduler and `auto` reckon with bytes and operations instead
    of seconds, so that a run repeats exactly (None: unless the loop runs freely).
    """

    def __init__(self, simulation: Simulation, source: FactorSource | None = None, counted: bool | None = None):
        self.simulation, self.engine = simulation, simulation.engine
        self.solver = simulation.scene.solver
        self.kind, self.n = self.solver.update
        self.free = self.solver.update.free
        patterns = {b.name: simulation.system.body_pattern(b.first, b.last) for b in simulation.world.bodies}
        self.inline, self.guard = Inline(patterns), Guard(patterns)
        self.source: FactorSource = source or self.inline
        self.counted = not self.free if counted is None else counted
        methods = self.solver.choices(simulation.world.backend.name)
        self.tracks = [Track(b, methods, self.counted) for b in simulation.world.bodies]
        self.by_name = {t.body.name: t for t in self.tracks}
        self.wants_factors = self.solver.wants_factors
        if self.wants_factors:
            self.guard.prepare()
        self.adopted: Callable[[Factor], None] = lambda factor: None  # told of every factor put into a mailbox
        self._due: dict[str, int] = {}  # lockstep: step of the matrix whose factor is taken up n steps later
        self._arrived: dict[tuple[str, int], Factor] = {}
        self._nobody_at = -1  # step at which nobody was left to be asked
        self._stock = Stock()
        self._copies = Copies(simulation, self.source)
        self._dropping = Dropping(self, self.source)
        self._alone = False  # there was no worker for a matrix of lockstep
        self._warped = {t.body.name: t.body.index in simulation.warped for t in self.tracks}
        values = {t.body.name: simulation.system.body_values(t.body.first, t.body.last) for t in self.tracks}
        self._bytes = {name: 72.0 * len(v) for name, v in values.items()}  # of A: deterministic cost of an iteration

    # --- one step after another ---------------------------------------------------------------------------------

    def advance(self, steps: int) -> NDArray[Any]:
        """Makes steps; returns their records (engine.RECORD)."""
        out = []
        for _ in range(steps):
            out.append(self._one())
        return np.concatenate(out) if out else self.engine.records()

    def _one(self) -> NDArray[Any]:
        if self.wants_factors and self._in_process_now():
            if self.engine.wait():
                return self.step_with_fresh_factors()
        elif self.wants_factors and self.kind == "lockstep":
            self._lockstep()
        else:
            if self.wants_factors and self.free:
                self.pump_factors()
            self.engine.run(1)
        return self._observed()

    def _observed(self) -> NDArray[Any]:
        records = self.engine.records()
        self.observe(records)
        return records

    def step_with_fresh_factors(self) -> NDArray[Any]:
        """A step that waits for the factors of its own matrices, made in this process; returns its records."""
        moving = [t for t in self.tracks if not t.frozen]
        self.engine.assemble()
        for t in moving:
            values = self._values(t.body)
            t.matrix = self.engine.step, values
            self.inline.submit(self._job(t, self.engine.step, values))
        self._take_up(self.inline)
        self.engine.solve()
        return self._observed()

    def _in_process_now(self) -> bool:
        if self.kind == "never":
            return self.engine.step == 0
        return self.kind == "every" and self.engine.step % self.n == 0

    def _values(self, body: Body) -> NDArray[np.float64]:
        return self.simulation.system.body_values(body.first, body.last)

    def _job(self, t: Track, step: int, values: NDArray[np.float64]) -> Job:
        name, method = t.body.name, self.solver.method if t.choice is None else t.choice.making.method
        t.job(step, method)
        if t.choice is not None:
            t.choice.making.sent()
        return Job(name, 1, step, self._warped[name], values, self.solver.factor_dtype, method)

    def _take_up(self, source: FactorSource) -> None:
        for factor in source.poll():
            self.adopt(factor)
        for name, reason in source.failures():
            self.failed(name, reason)

    def adopt(self, factor: Factor) -> None:
        """Puts a factor into its body's mailbox, unless a newer one is there or it is no good (factor_check.py)."""
        t = self.by_name[factor.object]
        self._nobody_at = -1
        matrix = self._copies.take_back(t, factor.step)
        if factor.step > t.newest and not t.frozen and (why := self.guard.complaint(factor, matrix)):
            self._dropping.refused(factor)
            self.failed(factor.object, f"that of {factor.worker} is not used: {why}")
            return
        if not t.came_in(factor, self.engine.step):
            return
        self.engine.post_factor(t.body.index, factor.pattern, factor.values, factor.step)
        later = t.sent_positions and self.engine.positions_later and factor.worker != self.inline.WORKER
        method = t.method(factor.step)
        told = replace(factor, ahead=t.ahead, later=later) if t.ahead or later else factor
        self.adopted(replace(told, method=method.name) if method else told)
        if t.choice is not None:
            t.choice.factor_arrived(method)
            self._settle(t)
        self._dropping.use_again(t)

    def failed(self, name: str, reason: str) -> None:
        """A job came to nothing; the object may be sent again. Told once per cause: the status counts them."""
        t = self.by_name[name]
        self._copies.take_back(t)
        t.came_to_nothing(reason)
        if t.choice is not None:
            t.choice.making.failed()
        self._nobody_at = -1
        self.tell(t, reason)

    def tell(self, t: Track, reason: str) -> None:
        """Why a factor that there was or should have been is not used."""
        cause = re.sub(r"[0-9.e+-]*[0-9]", "#", reason)
        if cause not in t.causes and len(t.causes) < CAUSES and not t.frozen:
            t.causes.add(cause)
            log.warning("object %r: no factor: %s", t.body.name, reason)

    # --- lockstep -----------------------------------------------------------------------------------------------

    def _lockstep(self) -> None:
        """Adopt what is due at this step, make it, send the matrices of bodies with nothing under way."""
        now = self.engine.step
        for name, made in list(self._due.items()):
            if made + self.n == now:
                self._await(name, made)
        fresh = [t for t in self.tracks if t.body.name not in self._due and not t.frozen]
        for t in fresh:
            self._copies.ask(t)
        self.engine.run(1)
        if self.engine.step == now:
            return  # stopped
        for t in fresh:
            if self._send_patiently(t):
                self._due[t.body.name] = now

    def _await(self, name: str, made: int) -> None:
        """The factor of step `made`, waited for; without one (a failure) the body goes on as it is."""
        asked = time.monotonic()
        while (name, made) not in self._arrived and self.by_name[name].in_flight:
            self._collect()
            if (name, made) in self._arrived or self.engine.loop.stop:
                break
            if time.monotonic() - asked > 5:
                log.warning("object %r: lockstep waits for the factor of step %d", name, made)
                asked = time.monotonic()
            time.sleep(2e-4)
        if factor := self._arrived.pop((name, made), None):
            self.adopt(factor)
            self.engine.settle_factors()
        for late in [key for key in self._arrived if key[0] == name]:  # of a job that was given up
            del self._arrived[late]
        self._due.pop(name)

    def _collect(self) -> None:
        for source in {id(s): s for s in (self.source, self.inline)}.values():
            for factor in source.poll():
                self._arrived[(factor.object, factor.step)] = factor
            for name, reason in source.failures():
                self.failed(name, reason)

    def _send_patiently(self, t: Track) -> bool:
        """To a worker, waiting for an idle one; into this process where there is no worker at all. False: stopped, or
        what was copied will not do."""
        step = self._copies.step(t)
        assert t.wanted is not None
        if not self._copies.will_do(t):
            self._copies.discard(t)
            return False
        job = self._job(t, step, t.wanted)
        asked = time.monotonic()
        while not (self.source.ready() and self.source.submit(job)):
            if self.engine.loop.stop:
                self._copies.discard(t)
                return False
            self._collect()
            patient = not self._alone and time.monotonic() - asked < 1  # a worker may be about to join
            if not patient and not self._workers():
                if not self._alone:
                    log.warning("lockstep without a worker: factors are made in this process")
                self._alone = True
                self.inline.submit(job)
                break
            time.sleep(2e-4)
        else:
            self._alone = False
        t.went_out(step)
        return True

    # --- async, adaptive ----------------------------------------------------------------------------------------

    def pump(self) -> NDArray[Any]:
        """What happens beside the running loop: records in, factors in, matrices out. Returns the new records."""
        records = self._observed()
        if self.wants_factors and self.free:
            if self._stock.paced(self.engine.step, time.monotonic()) and not self.counted:
                self._stock.reckon([t.seconds.value for t in self.tracks], self._workers())
            self.pump_factors()
        return records

    def pump_factors(self) -> None:
        """Takes up what came, sends what was copied, asks for the matrix of whoever needs it most."""
        self._take_up(self.source)
        for name in self.source.reassigned():
            self._copies.take_back(self.by_name[name])
            self.by_name[name].taken_back()
            self._nobody_at = -1
        self._send_copies()
        step, waiting = self.engine.step, sum(t.wanted is not None for t in self.tracks)
        idle = max(min(self.source.ready(), COPIES) - waiting, 0)
        places = max(idle, self._stock.size - waiting)
        if places <= 0 or step == self._nobody_at:
            return
        overdue = max(self._overdue(), self.solver.update_floor_steps)
        needs = self._needs(step)
        if self.kind == "adaptive":
            needs = [need for need in needs if pays(need, self.solver.update_threshold)]
        left = self.source.faster_busy_workers()  # so many of the most urgent objects are left for them
        chosen = pick(needs, left + places, self.solver.update_floor_steps, self.solver.schedule, overdue)[left:]
        tracks = [self.by_name[name] for name in chosen]
        wanted = tracks[:idle] + [t for t in tracks[idle:] if t.sent is None or t.excess > 0]  # in stock: who needs one
        for t in wanted:
            self._copies.ask(t)
        if len(wanted) < places:
            self._nobody_at = step

    def _needs(self, step: int) -> list[Need]:
        """Of all bodies but frozen ones and those that are better left for another worker than the idle ones."""
        needs = [t.need(step) for t in self.tracks if not t.frozen]
        failures = self.source.consecutive_failures()
        if failures is not None:
            reserved = self.source.reserved()
            if reserved or failures or any(need.failures for need in needs):
                needs = [replace(n, failures=failures.get(n.object, 0)) for n in needs if n.object not in reserved]
        return needs

    def _send_copies(self) -> None:
        """To idle workers, in the order in which they were asked for; others wait their turn while there is a stock."""
        copied = self._copies.made(self.tracks)
        idle = self.source.ready() if copied else 0
        for t in copied:
            waited = self.engine.step - self._copies.step(t)
            if idle <= 0 and self._stock.size and waited <= KEPT:
                continue
            self._send(t)
            idle -= t.in_flight

    def _overdue(self) -> float:
        return overdue_after(self.solver.schedule_rounds, self._latencies(), self._workers())

    def _latencies(self) -> list[float]:
        """Steps from matrix to factor, of each body; those not yet known are like the mean of the others."""
        known = [t.latency.value for t in self.tracks if t.latency.value is not None]
        mean = sum(known) / len(known) if known else 1.0
        return [mean if t.latency.value is None else t.latency.value for t in self.tracks]

    def _workers(self) -> int:
        return self.source.worker_count()

    def age_bound(self) -> int:
        """Oldest [steps] that a factor gets while all goes well, by what was measured so far; -1: no bound known."""
        if not self.wants_factors or self.kind == "never":
            return -1
        if self.kind == "adaptive":
            return -1  # a factor that does is kept
        if self.kind != "async":
            return self.n - 1 if self.kind == "every" else 2 * self.n - 1
        if all(t.latency.value is None for t in self.tracks):
            return -1
        overdue = max(self._overdue(), self.solver.update_floor_steps)
        return oldest_possible(overdue, self._latencies(), self._workers())

    def _send(self, t: Track) -> None:
        step = self._copies.step(t)
        assert t.wanted is not None
        if self._copies.will_do(t) and self.source.submit(self._job(t, step, t.wanted)):
            t.went_out(step)
            return
        self._copies.discard(t)

    # --- what the records say -----------------------------------------------------------------------------------

    def observe(self, records: NDArray[Any]) -> None:
        """Sums up excess iterations, lets `auto` choose, drops factors that are no use."""
        floor, bodies = self.solver.update_floor_iterations, len(self.tracks)
        if self.simulation.energies.on_runaway == "freeze":
            for body in np.unique(records["body"][records["status"] == RUNAWAY]):
                self.tracks[body].frozen = True
        if not self.counted and len(records) >= max(bodies, TOGETHER) and len(records) % bodies == 0:
            self._observe_steps(records.reshape(-1, bodies))
        else:
            self._observe_each(records, floor)
        self._dropping.judge(records)

    def _observe_each(self, records: NDArray[Any], floor: int) -> None:
        for r in records:
            t, iterations, kind = self.tracks[r["body"]], int(r["iterations"]), Kind(r["kind"])
            cost = self._model(t, kind, iterations) if self.counted else float(r["solve"])
            t.observe(r, floor, cost)
            if t.choice is not None:
                factor = (t.method(int(r["factor_step"])), int(r["factor_step"]))
                lack, used = reached(r, self.solver)
                solves, waited = max(int(r["linearizations"]), 1), self._waited(t, factor[0])
                t.choice.observe(
                    kind, iterations / solves, cost / solves, Kind(r["asked"]), factor, waited,
                    Reached(float(lack), float(used)), int(r["fallbacks"]),
                )  # fmt: skip
                self._settle(t)

    def _observe_steps(self, r: NDArray[Any]) -> None:
        """Of whole steps, (steps, bodies): where bodies are many, this is what decides how many factors they get."""
        observe_steps(self.tracks, r, self.solver.update_floor_iterations)
        if any(t.choice for t in self.tracks):
            lack, used = reached(r, self.solver)
            solves = np.maximum(r["linearizations"], 1)
            begun = (r["kind"], r["iterations"] / solves, r["solve"] / solves, r["asked"])
            ended = (lack, used, r["fallbacks"], r["factor_step"])
            columns = (column.T.tolist() for column in (*begun, *ended))
            for t, *rows, made in zip(self.tracks, *columns, strict=True):
                if t.choice is not None:
                    t.choice.observe_steps(*rows, [(t.method(step), step) for step in made])
                    self._settle(t)

    def _waited(self, t: Track, method: Method | None) -> float:
        """What falls to each solve of the making of a factor that a step waits for."""
        return t.making(method) / self.n if method and self.kind == "every" else 0.0

    def _model(self, t: Track, kind: int, iterations: int) -> float:
        """Bytes that a solve moved, about: the deterministic stand-in for its time."""
        matrix = self._bytes[t.body.name]
        other = matrix if kind == Kind.SSOR else 0.0
        if kind == Kind.CHOLESKY:
            other = 2.0 * self.engine.factor_bytes(t.body.index)
        return (iterations + 1) * (matrix + other)

    def _settle(self, t: Track) -> None:
        assert t.choice is not None
        native = self.engine.settings(t.body.index)
        native.kind, native.probe = t.choice.kind, t.choice.probe
