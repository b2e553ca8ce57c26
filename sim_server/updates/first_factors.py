# SPDX-License-Identifier: MIT
"""The first factor of each body, made while the loop stands within its first step, where no other step waits.

The step is assembled and not solved before its own matrices are factorized, so that no solve of a large body has to
do without a factor. All of this is one step that takes long: a replay repeats it as any step with the factor of its
own matrix.
"""

import time
from collections.abc import Callable
from dataclasses import replace

from sim_server.backends.base import Due
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Job

TIMEOUT = 60.0  # s until the first step goes on without factors
WORKER_TIMEOUT = 3.0  # s without any worker, likewise
MAX_FAILURES = 2  # jobs of a body that bring no factor, after which it is not waited for
SMALL = 4 << 20  # bytes of a matrix that may travel with others
NAMED = 3  # objects named in a line


class FirstFactors:
    """Gives the matrices of the first step to workers and waits for their factors, for a bounded time.

    `run` belongs to the thread of the loop; the policy of the driver must not act before it returns.

    clock: monotonic time [s]; sleep: is called between two looks
    """

    def __init__(
        self, driver: Driver, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ):
        self._driver, self._clock, self._sleep = driver, clock, sleep
        self._waiting = {state.body.name: state for state in driver.bodies}
        self._failures: dict[str, int] = {}  # of each body when its matrix was sent
        self.done = False
        self.begun: float | None = None  # when `run` began to wait
        self.seconds = 0.0  # that it has waited

    @property
    def missing(self) -> list[str]:
        """Names of the bodies whose factor is waited for, or did not come in time."""
        return list(self._waiting)

    def run(self, due: Due = Due.NEXT) -> bool:
        """Makes the first step. False: the loop was stopped meanwhile, in the middle of it.

        due: what the engine waited for. A single step counts as one that is to be made until it is over.
        """
        engine = self._driver.engine
        if due is Due.SINGLE:
            engine.loop.single += 1
        engine.assemble()
        begun = seen = self.begun = self._clock()
        while not engine.loop.stop:
            held = self._stand_still()
            if self._waiting:
                self._look()
            now = self._clock()
            seen = now if self._driver.source.worker_count() else seen
            over = not self._waiting or now - begun > TIMEOUT or now - seen > WORKER_TIMEOUT
            if over and not held:
                break
            self._sleep(1e-3)
        self.seconds = self._clock() - begun
        if engine.loop.stop:
            return False
        if engine.loop.pause:
            engine.loop.single -= 1  # this step is one of those that are made in a pause
        for name in self._waiting:
            self._leave(self._driver.by_name[name])
        engine.settle_factors()
        engine.restart_clock()
        engine.solve()
        self.done = True
        return True

    def _stand_still(self) -> bool:
        """Says in the loop's place that it stands still in a pause, as long as no single step is to be made."""
        loop = self._driver.engine.loop
        loop.halted = loop.pause if loop.single <= 0 else 0
        return bool(loop.halted)

    def _look(self) -> None:
        """Takes up factors that have come, and gives matrices to idle workers, those of large bodies first."""
        driver, source = self._driver, self._driver.source
        driver.receive(source, driver.adopt)
        for name in source.reassigned():
            self._failures.pop(name, None)
        for name, state in list(self._waiting.items()):
            failed = state.failures.in_a_row
            if state.factors.newest >= 0 or failed >= MAX_FAILURES:
                del self._waiting[name]
            elif failed > self._failures.get(name, failed):
                del self._failures[name]
        unsent = [state for name, state in self._waiting.items() if name not in self._failures]
        chosen = sorted(unsent, key=lambda state: state.body.first - state.body.last)[: source.ready()]
        sent = source.submit_many([self._job(state) for state in chosen])
        for state, taken in zip(chosen, sent, strict=True):
            if taken:
                self._failures[state.body.name] = state.failures.in_a_row

    def _job(self, state: BodyUpdateState) -> Job:
        """Returns the job of a matrix; with a copy if it may share a message: it is read when that leaves, and again to
        check the factor. Both may be after this step has gone on without, and the next step makes the matrix anew."""
        job = self._driver.assembled_job(state)
        if job.values.nbytes <= SMALL:
            job = replace(job, values=job.values.copy()[:])  # a view is not recycled
            state.job.matrix = job.step, job.values
        return job

    def _leave(self, state: BodyUpdateState) -> None:
        """Leaves the job of a body that is under way to the policy, as one that it has sent."""
        if state.body.name not in self._failures:
            state.job.matrix = None
        elif state.job.matrix is not None:
            step, values = state.job.matrix
            state.job.matrix = step, values.copy()[:]  # the next step assembles anew; a view is not recycled
            state.job.in_flight, state.job.sent = True, step


def few(missing: list[str]) -> str:
    """Returns the first few names, and how many more there are."""
    more = len(missing) - NAMED
    return ", ".join(missing[:NAMED]) + (f" and {more} more" if more > 0 else "")
