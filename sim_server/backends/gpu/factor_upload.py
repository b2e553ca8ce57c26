# SPDX-License-Identifier: MIT
"""Upload of factors: a partitioned inverse is built beside the steps, then posted into the mailbox of the body.

Each body has two storages per pattern and number of binary digits (double buffering). A build begins once the inverse
before it is in use and no step under way reads the other storage. A factor that arrives earlier is queued; a newer one
replaces it. Plans, made once per pattern, and the copies of large factors, or of many, are left to a thread
(PcgSolver.beside), for which the thread that serves the loop does not wait; it posts what it has built. Many small ones
are built together.

A factor may be *prepared* while it is checked: its inverse is built, applied once for the check, and kept out of use
until the factor is posted, or dropped.
"""

import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64, Int64
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.inverse.apply_inverse import Applied
from sim_server.backends.gpu.inverse.device_digits import LARGE
from sim_server.backends.gpu.loop import DeviceLoop
from sim_server.backends.gpu.mailbox import Mailboxes
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.upload.body_inverses import BodyInverses
from sim_server.backends.gpu.upload.given_factor import Given, GivenFactor
from sim_server.backends.gpu.upload.inverse_builds import Alike, BuiltInverses, InverseBuilds, Made
from sim_server.backends.gpu.upload.inverse_posts import InversePosts

SMALL = LARGE  # bytes of a factor that is copied at once
MANY = 4  # small factors that come together, from which on none is built at once
TOGETHER = 64  # factors that are handed over together
AHEAD = 2  # such batches beside the caller: one is built, the next is there; what waits otherwise may be replaced


@dataclass(eq=False)
class Builds:
    """Inverses that are built beside the caller.

    given: by body
    together: they are some of many small ones
    done: they were posted, or are kept until they are
    """

    given: dict[int, GivenFactor]
    together: bool
    done: Future[None] = field(default_factory=Future)


class FactorUpload:
    """Builds inverses of factors and posts them.

    solver: its rows of the bodies are what is posted
    names: of the bodies, for messages
    mailboxes: of the factors, one per body
    """

    def __init__(self, gpu: Gpu, solver: PcgSolver, loop: DeviceLoop, names: Sequence[str], mailboxes: Mailboxes):
        self._solver, self._loop = solver, loop
        self._inverses = BodyInverses(mailboxes)
        self._maker = InverseBuilds(gpu, solver, loop, self._inverses, names)
        self._posts = InversePosts(solver, self._inverses, mailboxes, names, self._coming)
        self._lock = threading.RLock()
        self._queued: dict[int, GivenFactor] = {}  # by body, those first whose body has waited longest
        self._builds: list[Builds] = []  # under way beside the caller
        self._building: dict[int, Builds] = {}  # the same, by body
        self._built: dict[int, tuple[BuiltInverses, int]] = {}  # prepared, neither posted nor dropped yet; and its row
        self._errors: list[Exception] = []  # of posting what was built beside the caller

    def expect(self, body: int, pattern: FactorPattern) -> None:
        """Begins to plan the inverses of factors of a pattern, beside the caller. From any thread."""
        with self._lock:
            self._inverses.expect(body, pattern.id)
        self._solver.begin_plan(body, pattern)

    def post(self, body: int, pattern: FactorPattern, values: NDArray[Any] | DeviceValues, step: int) -> None:
        """Takes a factor: begins to build its inverse now, or once a storage is free.

        Returns at once: what takes long, plans and large factors, is done beside the caller. The values must not change
        any more.
        """
        self.post_many([(body, pattern, values, step, 0)])

    def post_many(self, given: Iterable[Given]) -> None:
        """Takes factors, each as `post` takes one; of several of a body the last one counts. Inverses of many are built
        beside the caller, who would wait for one after another, those of one plan together."""
        with self._lock:
            built: dict[int, tuple[BuiltInverses, list[int]]] = {}  # with rows, by what was built together
            for body, pattern, values, step, planes in given:
                prepared = self._prepared(body, values)
                if prepared is None:
                    self._enqueue(body, GivenFactor(pattern, values, step, planes))
                    continue
                self._want(body, prepared)
                if body in self._built and self._queued.get(body) is not prepared:
                    inverses, row = self._built.pop(body)
                    built.setdefault(id(inverses), (inverses, []))[1].append(row)
            self._post([inverses.of(rows) for inverses, rows in built.values()])
            self._begin_queued()

    def prepare(
        self, body: int, pattern: FactorPattern, values: NDArray[Any] | DeviceValues, step: int, r: Float64
    ) -> "Future[Applied | None]":  # fmt: skip
        """Builds the inverse of a factor, beside the caller, and applies it to r (n,); it is used once these very
        values are posted. Returns P^-1 r; None as its result if it comes to nothing."""
        applied: Future[Applied | None] = Future()
        with self._lock:
            self._enqueue(body, GivenFactor(pattern, values, step, wanted=False, r=r, applied=applied))
            self._begin_queued([body], beside=True)
        return applied

    def prepare_many(self, given: Iterable[Given]) -> None:
        """Begins to build the inverses of factors of different bodies, beside the caller; each is used once these very
        values are posted. A body that has a factor coming is left out."""
        with self._lock:
            coming = self._queued.keys() | self._building.keys() | self._built.keys()
            chosen = [each for each in given if each[0] not in coming]
            if len(chosen) >= MANY:
                for body, pattern, values, step, planes in chosen:
                    self._queued[body] = GivenFactor(pattern, values, step, planes, wanted=False)
                self._begin_queued([each[0] for each in chosen])

    def may_prepare(self, body: int) -> bool:
        """True if the inverse of another factor would be begun at once. One that is prepared is in nobody's way: it may
        be of a job that ended meanwhile, and is never posted then, nor dropped before another one takes its place."""
        with self._lock:
            return body not in self._queued and body not in self._building and self._has_room([body]) == [True]

    def drop(self, body: int, values: NDArray[Any] | DeviceValues) -> None:
        """Gives up a factor that was prepared and not posted; any other one is let alone."""
        with self._lock:
            given = self._prepared(body, values)
            if given is None:
                return
            given.drop()
            if self._queued.get(body) is given:
                del self._queued[body]
            elif body in self._built:
                del self._built[body]
            self._begin_queued([body])

    def _prepared(self, body: int, values: NDArray[Any] | DeviceValues) -> GivenFactor | None:
        """Returns the factor with these values that is prepared and not posted."""
        for given in (self._queued.get(body), self._under_way(body)):
            if given is not None and given.values is values and not given.wanted:
                return given
        return None

    def _under_way(self, body: int) -> GivenFactor | None:
        """Returns the factor of a body whose inverse is being built, or is built and neither posted nor dropped."""
        if (builds := self._building.get(body)) is not None:
            return builds.given[body]
        built = self._built.get(body)
        return None if built is None else built[0].given[built[1]]

    def _want(self, body: int, given: GivenFactor) -> None:
        """Has a prepared factor used. One that waits was posted before, while this one was built: it is older."""
        given.wanted = True
        waits = self._queued.get(body)
        if waits is not None and waits is not given and waits.wanted:
            waits.drop()
            del self._queued[body]

    def _enqueue(self, body: int, given: GivenFactor) -> None:
        """Puts a factor in the place of the one that waits, or that waits to be posted."""
        if (waits := self._queued.get(body)) is not None:
            waits.drop()
        if (before := self._under_way(body)) is not None and not before.wanted:
            if body in self._built:
                del self._built[body]
                before.drop()
            else:
                before.dropped = True  # unless it is posted: who waits for it is told
        self._queued[body] = given

    def advance(self) -> None:
        """Begins the builds that have waited for a storage. Raises what went wrong beside the caller."""
        if self._errors or self._queued:
            with self._lock:
                if self._errors:
                    raise self._errors.pop(0)
                self._begin_queued()

    def settle(self) -> None:
        """Waits until the next step will use the newest factors. Only while the loop stands still."""
        for body in range(len(self._posts.planes)):
            while (building := self._settled(body)) is not None:
                wait([building])  # without the lock: the thread that serves the loop goes on
        if self._errors:
            raise self._errors.pop(0)

    def _settled(self, body: int) -> Future[None] | None:
        """Has the next step use the newest factor of a body; returns a build that must be waited for first."""
        with self._lock:
            waits = self._queued.get(body)
            if waits is not None and waits.wanted and body not in self._building:
                self._built.pop(body, None)
                self._inverses.take_back(body)
                self._has_room([body])
                self._inverses.at_rest(body)
                self._begin_queued([body], at_once=True)
            if (builds := self._building.get(body)) is not None:
                return builds.done
            self._has_room([body])
            if (event := self._inverses.posted(body)) is not None:
                event.synchronize()
            return None

    def step(self, body: int) -> int:
        """Returns the step of the factor in use, -1 without one."""
        with self._lock:
            self._has_room([body])
            return self._inverses.step(body)

    def _coming(self) -> set[int]:
        """Returns the ids of the patterns of factors that wait, or are being built."""
        given = [*self._queued.values(), *(each for builds in self._builds for each in builds.given.values())]
        return {each.pattern.id for each in given}

    def _has_room(self, bodies: Sequence[int]) -> list[bool]:
        """Takes note of what the loop has done; returns of which bodies a storage is free, or will be made."""
        rows = np.array(bodies, np.int64)
        self._inverses.refresh(rows, self._loop.step)
        free: list[bool] = self._inverses.free(rows).tolist()
        return free

    def _begin_queued(
        self, bodies: Sequence[int] | None = None, beside: bool = False, at_once: bool | None = None
    ) -> None:  # fmt: skip
        """Begins to build the queued factors of some bodies that need not wait: at once if they are few, small and
        planned and not `beside`, else in the thread of the plans, to which no more are given than it is about to build:
        what waits here is replaced by what is newer. bodies: None: all. at_once: None: if they are few"""
        waiting = list(self._queued) if bodies is None else [body for body in bodies if body in self._queued]
        if not waiting:
            return
        together = sum(builds.together for builds in self._builds)
        few, left = len(waiting) < MANY and not together, TOGETHER * (AHEAD - together)
        at_once, small = few if at_once is None else at_once, list[int]()
        for body, able in zip(waiting, self._has_room(waiting), strict=True):
            if not able or body in self._building or body in self._built:
                continue
            if beside or self._queued[body].values.nbytes > SMALL:
                self._begin_beside([body])
            elif at_once:
                self._begin_now(body)
            elif len(small) < left:
                small.append(body)
        for k in range(0, len(small), TOGETHER):
            self._begin_beside(small[k : k + TOGETHER], together=True)

    def _begin_now(self, body: int) -> None:
        """Begins a build in the caller's thread, unless it has no plan yet."""
        bodies, given = np.array([body]), self._queued.pop(body)
        chosen = self._maker.choose(bodies, [given])
        if chosen[0].plan.done():
            self._take(self._maker.build(chosen))
        else:
            builds = self._note([body], [given])
            self._solver.beside(partial(self._end, builds, chosen))

    def _begin_beside(self, bodies: Sequence[int], together: bool = False) -> None:
        """Leaves builds to the thread of the plans."""
        builds = self._note(bodies, [self._queued.pop(body) for body in bodies], together)
        self._solver.beside(partial(self._begin, builds, np.array(bodies)))

    def _note(self, bodies: Sequence[int], given: Sequence[GivenFactor], together: bool = False) -> Builds:
        builds = Builds(dict(zip(bodies, given, strict=True)), together)
        self._building.update(dict.fromkeys(bodies, builds))
        self._builds.append(builds)
        return builds

    def _begin(self, builds: Builds, bodies: Int64) -> None:
        """Begins to build inverses in the thread of the plans: now, or behind their plans."""
        made = self._maker.begin(bodies, list(builds.given.values()), int(self._posts.planes[bodies[0]]))
        if isinstance(made, Made):
            self._finish(builds, made)
        else:
            self._solver.beside(partial(self._end, builds, made))

    def _end(self, builds: Builds, chosen: Sequence[Alike]) -> None:
        self._finish(builds, self._maker.build(chosen))

    def _finish(self, builds: Builds, made: Made) -> None:
        """Posts what was built beside the caller, in the thread that built it: mail is taken once the device has built,
        and nobody need look at it before. Then those that waited are begun."""
        with self._lock:
            try:
                self._take(made, builds)
                self._begin_queued(at_once=False)
            except Exception as error:  # for who serves the loop
                self._errors.append(error)
            builds.done.set_result(None)

    def _take(self, made: Made, builds: Builds | None = None) -> None:
        """Posts inverses that are wanted already, and warns of factors that cannot be used. Raises in the end what is
        neither of a factor nor lack of memory; all others are posted. builds: that they come from"""
        try:
            for built in made.built:
                self._posts.keep(built)
        finally:
            if builds is not None:  # not before: the plans of those behind it are needed
                self._builds.remove(builds)
                for body in builds.given:
                    del self._building[body]
        for built in made.built:
            bodies = built.bodies.tolist()
            for row, (body, given) in enumerate(zip(bodies, built.given, strict=True)):
                if not given.wanted and not given.dropped:
                    self._built[body] = built, row
        wanted = [[row for row, given in enumerate(built.given) if given.wanted] for built in made.built]
        posted = [built.of(rows) for built, rows in zip(made.built, wanted, strict=True) if rows]
        self._post(posted, [each for body, error in made.failed for each in self._posts.unusable(body, error)])

    def _post(self, built: Sequence[BuiltInverses], errors: Sequence[Exception] = ()) -> None:
        """Posts inverses; raises the first error in the end."""
        found = [*errors, *(error for inverses in built for error in self._posts.post(inverses))]
        if found:
            raise found[0]
