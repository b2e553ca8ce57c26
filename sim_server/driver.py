# SPDX-License-Identifier: MIT
"""When matrices go out and factors come in: the update policies of Courtecuisse et al. 2010, sections 4 and 5.

    never       one factor, made in this process from the first matrix (PCG-0)
    every-N     a new one in this process each N-th step, which waits for it (PCG-1, PCG-30)
    async       matrices to workers, one of an object at a time; a factor is taken up as it comes; nothing waits
    lockstep-D  async, but a factor made from step t is taken up at step t + D exactly: the deterministic twin

`advance` makes steps and waits where the policy says so. For async the loop runs on its own (Engine.run in a thread
that has let go of Python's lock) and `pump` is called beside it.
"""

import logging
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.choice import Choice
from sim_server.engine import Kind
from sim_server.factors import FactorSource, Inline, Job
from sim_server.schedule import Need, excess, pick
from sim_server.simulation import Simulation
from sim_server.world import Body

log = logging.getLogger(__name__)


class Track:
    """Counters of one body."""

    def __init__(self, body: Body, auto: bool):
        self.body = body
        self.excess = 0.0
        self.sent: int | None = None  # step of the last matrix that went out
        self.in_flight = False
        self.wanted: NDArray[np.float64] | None = None  # where the loop copies the matrix asked for
        self.used = 0
        self.refused = 0
        self.newest = -1  # step of the newest factor taken up
        self.choice = Choice() if auto else None


class Driver:
    """Runs one simulation under its scene's update policy. source: of factors; None: this process."""

    def __init__(self, simulation: Simulation, source: FactorSource | None = None):
        self.simulation, self.engine = simulation, simulation.engine
        self.solver = simulation.scene.solver
        self.kind, self.n = self.solver.update
        patterns = {b.name: simulation.system.body_pattern(b.first, b.last) for b in simulation.world.bodies}
        self.inline = Inline(patterns)
        self.source: FactorSource = source or self.inline
        self.tracks = [Track(b, self.solver.preconditioner == "auto") for b in simulation.world.bodies]
        self.by_name = {t.body.name: t for t in self.tracks}
        self.wants_factors = self.solver.preconditioner in ("auto", "cholesky")
        self._due: dict[str, int] = {}  # lockstep: step of the matrix whose factor is taken up n steps later
        self._arrived: dict[tuple[str, int], Factor] = {}
        self._alone = False  # there was no worker for a matrix of lockstep
        self._warped = {t.body.name: bool(simulation.system.warped[t.body.nodes].any()) for t in self.tracks}
        bytes_a = {
            t.body.name: 72.0 * len(simulation.system.body_values(t.body.first, t.body.last)) for t in self.tracks
        }
        self._bytes = bytes_a  # of A: deterministic cost of an iteration

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
                self._with_factors_of_this_step()
        elif self.wants_factors and self.kind == "lockstep":
            self._lockstep()
        else:
            if self.wants_factors and self.kind == "async":
                self.pump_factors()
            self.engine.run(1)
        records = self.engine.records()
        self.observe(records)
        return records

    def _with_factors_of_this_step(self) -> None:
        self.engine.assemble()
        for t in self.tracks:
            self.inline.submit(self._job(t, self.engine.step, self._values(t.body)))
        self._take_up(self.inline)
        self.engine.solve()

    def _in_process_now(self) -> bool:
        if self.kind == "never":
            return self.engine.step == 0
        return self.kind == "every" and self.engine.step % self.n == 0

    def _values(self, body: Body) -> NDArray[np.float64]:
        return self.simulation.system.body_values(body.first, body.last)

    def _job(self, t: Track, step: int, values: NDArray[np.float64]) -> Job:
        name = t.body.name
        return Job(name, 1, step, self._warped[name], values, self.solver.factor_dtype)

    def _take_up(self, source: FactorSource) -> None:
        for factor in source.poll():
            self.adopt(factor)
        for name, reason in source.failures():
            self.failed(name, reason)

    def adopt(self, factor: Factor) -> None:
        """Puts a factor into its body's mailbox, unless a newer one is there."""
        t = self.by_name[factor.object]
        t.in_flight = False
        if factor.step <= t.newest:
            return
        t.newest = factor.step
        t.used += 1
        self.engine.post_factor(t.body.index, factor.pattern, factor.values, factor.step)
        if t.choice is not None:
            t.choice.factor_arrived()
            self._settle(t)

    def failed(self, name: str, reason: str) -> None:
        """A job came to nothing; the object may be sent again."""
        t = self.by_name[name]
        t.in_flight = False
        t.refused += 1
        log.warning("object %r: no factor: %s", name, reason)

    # --- lockstep -----------------------------------------------------------------------------------------------

    def _lockstep(self) -> None:
        """Adopt what is due at this step, make it, send the matrices of bodies with nothing under way."""
        now = self.engine.step
        for name, made in list(self._due.items()):
            if made + self.n == now:
                self._await(name, made)
        fresh = [t for t in self.tracks if t.body.name not in self._due]
        for t in fresh:
            self._ask(t)
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
        """To a worker, waiting for an idle one; into this process where there is no worker at all. False: stopped."""
        step = self.engine.matrix_step(t.body.index)
        assert t.wanted is not None
        job = self._job(t, step, t.wanted)
        asked = time.monotonic()
        while not (self.source.ready() and self.source.submit(job)):
            if self.engine.loop.stop:
                t.wanted = None
                return False
            self._collect()
            patient = not self._alone and time.monotonic() - asked < 1  # a worker may be about to join
            if not patient and not getattr(self.source, "workers", lambda: [1])():
                if not self._alone:
                    log.warning("lockstep without a worker: factors are made in this process")
                self._alone = True
                self.inline.submit(job)
                break
            time.sleep(2e-4)
        else:
            self._alone = False
        t.in_flight, t.sent, t.wanted, t.excess = True, step, None, 0.0
        return True

    # --- async --------------------------------------------------------------------------------------------------

    def pump(self) -> NDArray[Any]:
        """What happens beside the running loop: records in, factors in, matrices out. Returns the new records."""
        records = self.engine.records()
        self.observe(records)
        if self.wants_factors and self.kind == "async":
            self.pump_factors()
        return records

    def pump_factors(self) -> None:
        """Takes up what came, sends what was copied, asks for the matrix of whoever needs it most."""
        self._take_up(self.source)
        for t in self.tracks:
            if t.wanted is not None and self.engine.matrix_step(t.body.index) >= 0:
                self._send(t)
        if not self.source.ready() or any(t.wanted is not None for t in self.tracks):
            return
        step = self.engine.step
        needs = [
            Need(t.body.name, t.excess, None if t.sent is None else step - t.sent, t.in_flight) for t in self.tracks
        ]
        for name in pick(needs, 1, self.solver.update_floor_steps):
            self._ask(self.by_name[name])

    def _ask(self, t: Track) -> None:
        t.wanted = np.empty_like(self._values(t.body))
        self.engine.request_matrix(t.body.index, t.wanted)

    def _send(self, t: Track) -> None:
        step = self.engine.matrix_step(t.body.index)
        assert t.wanted is not None
        if self.source.submit(self._job(t, step, t.wanted)):
            t.in_flight, t.sent, t.excess = True, step, 0.0
        t.wanted = None

    # --- what the records say -----------------------------------------------------------------------------------

    def observe(self, records: NDArray[Any]) -> None:
        """Sums up excess iterations and lets `auto` choose."""
        floor = self.solver.update_floor_iterations
        for r in records:
            t, iterations = self.tracks[r["body"]], int(r["iterations"])
            t.excess += excess(iterations, floor)
            t.refused += int(r["fallbacks"])
            if t.choice is not None:
                kind = Kind(r["kind"])
                cost = float(r["solve"]) if self.kind == "async" else self._model(t, kind, iterations)
                t.choice.observe(kind, iterations, cost, Kind(r["asked"]))
                self._settle(t)

    def _model(self, t: Track, kind: int, iterations: int) -> float:
        """Bytes that a solve moved, about: the deterministic stand-in for its time."""
        matrix = self._bytes[t.body.name]
        factor = self.engine.factor_bytes(t.body.index) if kind == Kind.CHOLESKY else 0
        return (iterations + 1) * (matrix + 2.0 * factor)

    def _settle(self, t: Track) -> None:
        assert t.choice is not None
        native = self.engine.settings(t.body.index)
        native.kind, native.probe = t.choice.kind, t.choice.probe
