# SPDX-License-Identifier: MIT
"""Upload of factors: a partitioned inverse is built beside the steps, then posted into the mailbox of the body.

Each body has two storages per pattern and number of binary digits (double buffering). A build begins once the inverse
before it is in use and no step under way reads the other storage. A factor that arrives earlier is queued; a newer one
replaces it. Plans, made once per pattern, and the copies of large factors, or of many, are left to a thread
(PcgSolver.beside), for which the thread that serves the loop does not wait. Many small ones of one
plan are built together.

A factor may be *prepared* while it is checked: its inverse is built, applied once for the check, and kept out of use
until the factor is posted, or dropped.
"""

import logging
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, InvalidStateError, wait
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.compiler import CompileError
from sim_server.backends.gpu.device import Gpu, no_memory_left
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.inverse.apply_inverse import Applied
from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder, InverseStorage, PartitionedInverse
from sim_server.backends.gpu.inverse.device_digits import LARGE, is_large
from sim_server.backends.gpu.loop import DeviceLoop
from sim_server.backends.gpu.mailbox import DeviceMailbox, post_all
from sim_server.backends.gpu.solver import SETTINGS_BYTES, PcgSolver, PlannedInverse
from sim_server.backends.gpu.structs import Mail

log = logging.getLogger(__name__)

SMALL = LARGE  # bytes of a factor that is copied at once
MANY = 4  # small factors that come together, from which on none is built at once
TOGETHER = 64  # factors of one plan that are handed over together
AHEAD = 2  # such batches beside the caller: one is built, the next is there; what waits otherwise may be replaced
BUSY = 0.25  # share of dt that steps in real time take, up to which builds may have the whole device
MAX_KINDS = 2  # of inverses of a body at a time; workers with different libraries send different patterns
InverseKind = tuple[int, int]
"""Of inverses: id of the pattern, float16 numbers per entry."""


class UploadedFactor(NamedTuple):
    """A factor on the device, complete once the event of its inverse is.

    step: of the matrix it was made from
    planes: float16 numbers per entry
    """

    inverse: PartitionedInverse
    storage: InverseStorage
    step: int
    pattern: FactorPattern
    planes: int
    planned: PlannedInverse

    @property
    def kind(self) -> InverseKind:
        """Of its inverse."""
        return self.pattern.id, self.planes


@dataclass(eq=False, slots=True)
class GivenFactor:
    """A factor that came. Its values do not change any more.

    source: its values where the inverse is built from, once its digits are chosen
    r: vector that its inverse is to be applied to. None: to none
    applied: P^-1 r on its way; None: nobody applies it
    wanted: it is to be used; False: once it is posted
    dropped: nobody wants it any more
    """

    pattern: FactorPattern
    values: NDArray[Any] | DeviceValues
    step: int
    source: NDArray[Any] | DeviceValues | None = None
    r: Float64 | None = None
    applied: "Future[Applied | None] | None" = None
    wanted: bool = True
    dropped: bool = False

    def drop(self) -> None:
        """Gives it up."""
        self.dropped = True
        self.tell(None)

    def tell(self, applied: Applied | None) -> None:
        """Tells who waits for P^-1 r, if it is not told yet."""
        _tell(self.applied, applied)


Given = tuple[int, FactorPattern, NDArray[Any] | DeviceValues, int]
"""A body, and of its factor pattern, values and step."""
Work = tuple[int, GivenFactor, Mapping[InverseKind, InverseStorage]]
"""A body, its factor, and by kind a storage that no step reads, if there is one."""


class ChosenPlan(NamedTuple):
    """What the inverse of a factor is built by.

    planes: float16 numbers per entry
    spare: a storage that no step reads; None: one is to be made
    applied: P^-1 r on its way, if the factor is to be applied
    """

    body: int
    given: GivenFactor
    planes: int
    plan: Future[PlannedInverse]
    spare: InverseStorage | None
    applied: "Future[Applied | None] | None"

    def tell(self, applied: Applied | None) -> None:
        """Tells who waits for P^-1 r, if it is not told yet."""
        _tell(self.applied, applied)


@dataclass(eq=False)
class Builds:
    """Inverses that are built beside the caller.

    given: by body
    made: of each, in this order, or why there is none
    together: they are some of many small ones
    """

    given: dict[int, GivenFactor]
    made: Future[list[UploadedFactor | Exception]]
    together: bool


@dataclass
class BodyUploads:
    """Factors of one body.

    planes: float16 numbers per entry of the last factor's inverse, or of the first one's as expected
    storages: by kind
    leaving: the factor in use before, and the number of steps after whose completion no step reads it
    posted: not taken by the loop yet, in this mail
    building: in the thread of the plans, with others
    built: prepared, and the factor that it is of, which is neither posted nor dropped yet
    queued: a factor that waits for a storage, or for that thread
    expected: id of the pattern that factors to come have; None once one of a new pattern came
    warned: True after the first factor that could not be used
    """

    name: str
    mailbox: DeviceMailbox
    planes: int
    storages: dict[InverseKind, list[InverseStorage]] = field(default_factory=dict)
    in_use: UploadedFactor | None = None
    leaving: tuple[UploadedFactor, int] | None = None
    posted: UploadedFactor | None = None
    mail: Mail | None = None
    building: Builds | None = None
    built: tuple[UploadedFactor, GivenFactor] | None = None
    queued: GivenFactor | None = None
    expected: int | None = None
    warned: bool = False

    @property
    def free(self) -> bool:
        """True if a build may begin: a storage is free, or will be made."""
        return self.built is None and self.may_replace

    @property
    def may_replace(self) -> bool:
        """True if a build may begin once what is prepared is dropped."""
        return self.posted is None and self.leaving is None and self.building is None

    @property
    def comes(self) -> bool:
        """True if a factor waits, is being built, or is prepared."""
        return self.queued is not None or self.building is not None or self.built is not None

    def spare(self) -> dict[InverseKind, InverseStorage]:
        """Returns a storage of each kind that no step reads, if there is one; only where a build may begin."""
        used, found = self.in_use.storage if self.in_use else None, {}
        for kind, made in self.storages.items():
            for storage in made:
                if storage is not used:
                    found[kind] = storage
                    break
        return found

    def kinds(self, body: int) -> set[InverseKind]:
        """Kinds of inverses whose plans are needed, or may be. body: number of this one"""
        given = [each for each in (self.queued, self.building and self.building.given[body]) if each]
        coming = [each.pattern.id for each in given] + [each for each in (self.expected,) if each is not None]
        return {*self.storages, *((pattern, planes) for pattern in coming for planes in (1, 2))}


class FactorUpload:
    """Builds inverses of factors and posts them.

    solver: its rows of the bodies are what is posted
    names: of the bodies, for messages
    mailboxes: of the factors, one per body
    """

    def __init__(
        self, gpu: Gpu, solver: PcgSolver, loop: DeviceLoop, names: Sequence[str], mailboxes: Sequence[DeviceMailbox]
    ):
        self._gpu, self._solver, self._loop = gpu, solver, loop
        planes = solver.planes or 1
        self._uploads = [BodyUploads(name, box, planes) for name, box in zip(names, mailboxes, strict=True)]
        self._lock = threading.RLock()
        self._waiting: dict[int, None] = {}  # bodies with a queued factor, those that wait longest first
        self._builds: list[Builds] = []  # under way beside the caller
        self._errors: list[Exception] = []  # of posting what was built there
        self._known: set[InverseKind] = set()  # of which storages were made

    def expect(self, body: int, pattern: FactorPattern) -> None:
        """Begins to plan the inverses of factors of a pattern, beside the caller. From any thread."""
        self._uploads[body].expected = pattern.id
        self._solver.begin_plan(body, pattern)

    def post(self, body: int, pattern: FactorPattern, values: NDArray[Any] | DeviceValues, step: int) -> None:
        """Takes a factor: begins to build its inverse now, or once a storage is free.

        Returns at once: what takes long, plans and large factors, is done beside the caller. The values must not change
        any more.
        """
        with self._lock:
            self._refresh(body)
            if not self._use_prepared(body, values):
                self._enqueue(body, GivenFactor(pattern, values, step))
                self._begin_queued([body])

    def prepare(
        self, body: int, pattern: FactorPattern, values: NDArray[Any] | DeviceValues, step: int, r: Float64
    ) -> "Future[Applied | None]":  # fmt: skip
        """Builds the inverse of a factor, beside the caller, and applies it to r (n,); it is used once these very
        values are posted. Returns P^-1 r; None as its result if it comes to nothing."""
        applied: Future[Applied | None] = Future()
        given = GivenFactor(pattern, values, step, r=r, applied=applied, wanted=False)
        with self._lock:
            self._refresh(body)
            self._enqueue(body, given)
            self._begin_queued([body], beside=True)
        return applied

    def may_prepare(self, body: int) -> bool:
        """True if the inverse of another factor would be begun at once. One that is prepared is in nobody's way: it may
        be of a job that ended meanwhile, and is never posted then, nor dropped before another one takes its place."""
        with self._lock:
            self._refresh(body)
            return self._uploads[body].may_replace and self._uploads[body].queued is None

    def drop(self, body: int, values: NDArray[Any] | DeviceValues) -> None:
        """Gives up a factor that was prepared and not posted; any other one is let alone."""
        with self._lock:
            uploads = self._uploads[body]
            self._refresh(body)
            given = self._prepared(body, values)
            if given is None:
                return
            given.drop()
            if uploads.built is not None and uploads.built[1] is given:
                uploads.built = None
            if uploads.queued is given:
                uploads.queued = None
            self._begin_queued([body])

    def _prepared(self, body: int, values: NDArray[Any] | DeviceValues) -> GivenFactor | None:
        """Returns the factor with these values that is prepared and not posted."""
        uploads = self._uploads[body]
        building = None if uploads.building is None else uploads.building.given[body]
        coming = (uploads.queued, building, None if uploads.built is None else uploads.built[1])
        return next((each for each in coming if each is not None and not each.wanted and each.values is values), None)

    def _use_prepared(self, body: int, values: NDArray[Any] | DeviceValues) -> bool:
        """Has a prepared factor used, at once if it is built; False if there is none with these values."""
        uploads = self._uploads[body]
        given = self._prepared(body, values)
        if given is None:
            return False
        self._want(uploads, given)
        if uploads.built is not None and uploads.built[1] is given:
            (factor, _), uploads.built = uploads.built, None
            self._post(body, given, factor)
        return True

    def _want(self, uploads: BodyUploads, given: GivenFactor) -> None:
        """Has a prepared factor used. One that waits was posted before, while this one was built: it is older."""
        given.wanted = True
        waits = uploads.queued
        if waits is not None and waits is not given and waits.wanted:
            waits.drop()
            uploads.queued = None

    def _enqueue(self, body: int, given: GivenFactor) -> None:
        """Puts a factor in the place of the one that waits, or that waits to be posted."""
        uploads = self._uploads[body]
        if uploads.queued is not None:
            uploads.queued.drop()
        if uploads.built is not None:
            uploads.built[1].drop()
            uploads.built = None
        if uploads.building is not None and not (built := uploads.building.given[body]).wanted:
            built.dropped = True  # unless it is posted: who waits for it is told
        uploads.queued = given

    def prepare_many(self, given: Sequence[Given]) -> None:
        """Begins to build the inverses of factors of different bodies, beside the caller; each is used once these very
        values are posted. A body that has a factor coming is left out."""
        with self._lock:
            chosen = [each for each in given if not self._uploads[each[0]].comes]
            if len(chosen) >= MANY:
                for body, pattern, values, step in chosen:
                    self._enqueue(body, GivenFactor(pattern, values, step, wanted=False))
                self._begin_queued([each[0] for each in chosen])

    def post_many(self, given: Sequence[Given]) -> None:
        """Takes factors, each as `post` takes one; of several of a body the last one counts. Inverses of many are built
        beside the caller, who would wait for one after another, those of one plan together."""
        with self._lock:
            waiting: dict[int, None] = {}  # in this order
            built: list[tuple[int, GivenFactor, UploadedFactor | Exception]] = []
            for body, pattern, values, step in given:
                uploads = self._uploads[body]
                prepared = self._prepared(body, values) if uploads.comes else None
                if prepared is None:
                    self._enqueue(body, GivenFactor(pattern, values, step))
                    waiting[body] = None
                    continue
                self._want(uploads, prepared)
                if uploads.built is not None and uploads.built[1] is prepared:
                    built.append((body, prepared, uploads.built[0]))
                    uploads.built = None
            self._post_all(built)
            self._begin_queued([*self._waiting, *(body for body in waiting if body not in self._waiting)])

    def advance(self) -> None:
        """Posts what was built beside the caller, and begins the builds that have waited for a storage."""
        with self._lock:
            if self._errors:
                raise self._errors.pop(0)
            for builds in [each for each in self._builds if each.made.done()]:
                self._finish(builds)
            if self._waiting:
                self._begin_queued(list(self._waiting))

    def settle(self) -> None:
        """Waits until the next step will use the newest factors. Only while the loop stands still."""
        for body in range(len(self._uploads)):
            while (building := self._settled(body)) is not None:
                wait([building])  # without the lock: the thread that serves the loop goes on

    def _settled(self, body: int) -> "Future[list[UploadedFactor | Exception]] | None":
        """Has the next step use the newest factor of a body; returns a build that must be waited for first."""
        with self._lock:
            uploads = self._uploads[body]
            self._refresh(body)
            if uploads.queued is not None and uploads.building is None:
                uploads.built = None
                if uploads.posted is not None and uploads.mailbox.withdraw():
                    uploads.posted.inverse.event.synchronize()  # its storage may be reused
                    uploads.posted = uploads.mail = None
                self._refresh(body)
                uploads.leaving = None
                self._begin_queued([body], now=True)
            if uploads.building is not None:
                return uploads.building.made
            if uploads.posted is not None:
                uploads.posted.inverse.event.synchronize()
            return None

    def step(self, body: int) -> int:
        """Returns the step of the factor in use, -1 without one."""
        with self._lock:
            self._refresh(body)
            factor = self._uploads[body].in_use
            return factor.step if factor else -1

    def _refresh(self, body: int) -> None:
        """Updates the state of the factors: built, taken by the loop, out of use."""
        uploads = self._uploads[body]
        if uploads.building is not None and uploads.building.made.done():
            self._finish(uploads.building)
        if uploads.posted is not None and uploads.mail is not None and uploads.mailbox.taken:
            if uploads.in_use is not None:  # steps launched until then may still read it
                uploads.leaving = (uploads.in_use, int(uploads.mail.taken))
            uploads.in_use, uploads.posted, uploads.mail = uploads.posted, None, None
        if uploads.leaving is not None and self._loop.step >= uploads.leaving[1]:
            uploads.leaving = None

    def _begin_queued(self, bodies: Sequence[int], beside: bool = False, now: bool = False) -> None:
        """Begins to build the queued factors of some bodies that need not wait: at once if they are few, small and
        planned and not `beside`, else in the thread of the plans, to which no more are given than it is about to build:
        what waits here is replaced by what is newer. now: none waits for builds of other bodies"""
        small: list[int] = []
        together = sum(builds.together for builds in self._builds)
        room, few = TOGETHER * (AHEAD - together), now or (len(bodies) < MANY and not together)
        for body in bodies:
            uploads = self._uploads[body]
            if uploads.queued is None:
                self._waiting.pop(body, None)
                continue
            large = uploads.queued.values.nbytes > SMALL or beside
            full = not (large or few) and len(small) >= room
            if not full:
                self._refresh(body)
            if full or not uploads.free:
                self._waiting[body] = None
            elif large:
                self._begin_beside([body])
            elif few:
                self._begin_now(body)
            else:
                small.append(body)
        for k in range(0, len(small), TOGETHER):
            self._begin_beside(small[k : k + TOGETHER], together=True)

    def _take_queued(self, body: int) -> Work:
        """Takes the queued factor of a body, with the storages that no step reads."""
        uploads = self._uploads[body]
        given, uploads.queued = uploads.queued, None
        assert given is not None
        self._waiting.pop(body, None)
        return body, given, uploads.spare()

    def _begin_now(self, body: int) -> None:
        work = self._take_queued(body)
        chosen = self._chosen([work])
        if chosen[0].plan.done():
            self._post(body, chosen[0].given, self._build(chosen)[0])
        else:
            builds = self._note([work[1]], [body])
            self._solver.beside(partial(self._end, chosen, builds.made))

    def _begin_beside(self, bodies: Sequence[int], together: bool = False) -> None:
        work = [self._take_queued(body) for body in bodies]
        builds = self._note([given for _, given, _ in work], bodies, together)
        if together:
            builds.made.add_done_callback(lambda _: self._finish_beside(builds))
        self._solver.beside(partial(self._choose_and_build, work, builds.made))

    def _note(self, given: Sequence[GivenFactor], bodies: Sequence[int], together: bool = False) -> Builds:
        builds = Builds(dict(zip(bodies, given, strict=True)), Future(), together)
        for body in bodies:
            self._uploads[body].building = builds
        self._builds.append(builds)
        return builds

    def _chosen(self, work: Sequence[Work], planes: int = 0) -> list[ChosenPlan]:
        """Chooses how many digits each of some inverses needs, and begins its plan. planes: as many as these; 0: not
        known yet"""
        own = [planes] * len(work) if planes else self._planes_of([given for _, given, _ in work])
        chosen = []
        for (body, given, spare), needed in zip(work, own, strict=True):
            plan = self._solver.begin_plan(body, given.pattern, needed)
            spare_one = spare.get((given.pattern.id, needed))
            chosen.append(ChosenPlan(body, given, needed, plan, spare_one, given.applied))
        return chosen

    def _planes_of(self, given: Sequence[GivenFactor]) -> list[int]:
        """Returns the float16 numbers per entry that the inverse of each of some factors needs."""
        sources = [self._source(each) for each in given]
        if len(given) == 1 and isinstance(sources[0], DeviceValues):
            return [self._solver.planes_on_device(given[0].pattern, sources[0], self._multiprocessors)]
        return self._solver.planes_of([(g.pattern, _on_host(s)) for g, s in zip(given, sources, strict=True)])

    def _source(self, given: GivenFactor) -> NDArray[Any] | DeviceValues:
        """Returns values of a factor as its inverse is built from them: large ones are brought to the device first if
        their digits are to be chosen."""
        if given.source is None:
            large = is_large(given.values) and self._solver.planes is None
            given.source = self._solver.brought(given.values) if large else given.values
        return given.source

    def _choose_and_build(self, work: Sequence[Work], made: Future[list[UploadedFactor | Exception]]) -> None:
        """Begins to build inverses, in the thread of the plans: now, or behind their plans."""
        planes = 0
        try:
            if len(work) == 1 and self._solver.planes is None:
                planes, built = self._built_ahead(*work[0])
                if built is not None:
                    made.set_result([built])
                    return
            chosen = self._chosen(work, planes)
        except Exception as error:
            for _, given, _ in work:
                given.tell(None)
            made.set_result([error for _ in work])
            return
        if all(each.plan.done() for each in chosen):
            self._end(chosen, made)
        else:
            self._solver.beside(partial(self._end, chosen, made))

    def _built_ahead(
        self, body: int, given: GivenFactor, spare: Mapping[InverseKind, InverseStorage]
    ) -> tuple[int, UploadedFactor | Exception | None]:  # fmt: skip
        """Begins to build an inverse with as many digits as the one before had, and finds out meanwhile how many it
        needs. Returns the float16 numbers per entry that it needs, and what is made; None: it needs others."""
        expected = self._uploads[body].planes
        plan, applied, built = self._solver.begin_plan(body, given.pattern, expected), Future[Applied | None](), None
        if plan.done():
            spare_one = spare.get((given.pattern.id, expected))
            built = self._build([ChosenPlan(body, given, expected, plan, spare_one, applied)])[0]
        planes = self._planes_of([given])[0]
        if built is not None and planes == expected:
            given.tell(applied.result())
            return planes, built
        if isinstance(built, UploadedFactor):
            built.inverse.event.synchronize()  # the device writes into memory that nobody keeps
        return planes, None

    def _end(self, chosen: Sequence[ChosenPlan], made: Future[list[UploadedFactor | Exception]]) -> None:
        try:
            made.set_result(self._build(chosen))
        except BaseException as error:
            made.set_exception(error)

    def _build(self, chosen: Sequence[ChosenPlan]) -> list[UploadedFactor | Exception]:
        """Begins to build inverses whose plans are made, those of one plan together."""
        made: list[UploadedFactor | Exception] = [ValueError("not built")] * len(chosen)
        try:
            for plan in dict.fromkeys(each.plan for each in chosen):
                places = [place for place, each in enumerate(chosen) if each.plan is plan]
                try:
                    self._build_by(plan.result(), chosen, places, made)
                except Exception as error:
                    for place in places:  # of those that are there the device writes into the storage
                        if not isinstance(made[place], UploadedFactor):
                            made[place] = error
        finally:
            for each in chosen:
                if each.applied is not None:
                    each.tell(None)
        return made

    def _build_by(
        self, planned: PlannedInverse, chosen: Sequence[ChosenPlan], places: Sequence[int],
        made: list[UploadedFactor | Exception],
    ) -> None:  # fmt: skip
        """Fills in what is made at some places, each in a storage, a new one unless there is one to spare."""
        storages: dict[int, InverseStorage] = {}  # by place
        made_new = iter(self._new_storages(planned.builder, sum(chosen[place].spare is None for place in places)))
        reserved = False
        for place in places:
            try:
                storage = chosen[place].spare
                if storage is None:
                    storage = next(made_new, None)
                if storage is None:
                    storage = planned.builder.storage()
                reserved |= self._solver.reserve_vectors(chosen[place].body, planned.plan)
                storages[place] = storage
            except Exception as error:
                made[place] = error
        if reserved:
            self._gpu.cp.cuda.get_current_stream().synchronize()  # new vectors are complete for other streams
        builder, able, multiprocessors = planned.builder, list(storages), self._multiprocessors
        for k in range(0, len(able), builder.most):
            some = able[k : k + builder.most]
            values = [self._source(chosen[place].given) for place in some]
            inverses = builder.build_many(values, [storages[place] for place in some], multiprocessors)
            for place, inverse in zip(some, inverses, strict=True):
                given, planes = chosen[place].given, chosen[place].planes
                made[place] = UploadedFactor(inverse, storages[place], given.step, given.pattern, planes, planned)
            for place, inverse in zip(some, inverses, strict=True):
                if chosen[place].given.r is not None:
                    self._apply(builder, inverse, chosen[place])

    def _new_storages(self, builder: InverseBuilder, count: int) -> list[InverseStorage]:
        """Makes storages for several inverses at once; none for one, or where there is too little memory."""
        if count < 2:
            return []
        try:
            return builder.several_storages(count)
        except Exception as error:
            if not no_memory_left(error):
                raise
            return []

    def _apply(self, builder: InverseBuilder, inverse: PartitionedInverse, chosen: ChosenPlan) -> None:
        """Begins to apply an inverse for the check of its factor, which goes without where that cannot be done: the
        inverse is there all the same, and the device writes into its storage."""
        if chosen.given.dropped:  # nobody would keep the memory that it comes to
            return
        assert chosen.given.r is not None
        try:
            chosen.tell(builder.apply(inverse, chosen.given.r, self._multiprocessors))
        except Exception as error:
            log.warning("object %r: a factor is not applied for its check: %s", self._uploads[chosen.body].name, error)

    @property
    def _multiprocessors(self) -> int | None:
        """Multiprocessors that a build may keep busy: those that solves leave free; None: all, where steps in real time
        leave the device idle most of the time. A step then waits some 100 us now and then, and the build is done the
        sooner."""
        loop = self._loop.loop
        idle = loop.realtime and 0 < loop.step_seconds < BUSY * loop.dt
        return None if idle else self._solver.spared

    def _finish_beside(self, builds: Builds) -> None:
        """Posts what was built in the thread that built it, unless that is done: mail is taken once the device has
        built, and nobody need look at it before."""
        with self._lock:
            try:
                if builds in self._builds:
                    self._finish(builds)
            except Exception as error:  # for who serves the loop
                self._errors.append(error)

    def _finish(self, builds: Builds) -> None:
        """Posts what was built beside the caller."""
        self._builds.remove(builds)
        if builds.made.exception() is not None:
            for body in builds.given:
                self._uploads[body].building = None
        given = builds.given.items()
        self._post_all([(*each, made) for each, made in zip(given, builds.made.result(), strict=True)])

    def _post(self, body: int, given: GivenFactor, made: UploadedFactor | Exception) -> None:
        self._post_all([(body, given, made)])

    def _post_all(self, built: Sequence[tuple[int, GivenFactor, UploadedFactor | Exception]]) -> None:
        """Posts factors of different bodies, those that are wanted already, or warns of those that cannot be used.
        Raises in the end what is neither of a factor nor lack of memory; all others are posted."""
        wanted: dict[InverseKind, list[tuple[int, UploadedFactor]]] = {}
        errors = []
        for body, given, made in built:
            uploads = self._uploads[body]
            uploads.building = None  # not before: the plans of those behind it are needed
            if isinstance(made, Exception):
                errors += self._unusable(uploads, made)
                continue
            kind = made.kind
            if not any(storage is made.storage for storage in uploads.storages.get(kind, ())):
                self._keep(uploads, made)
            if given.wanted:
                wanted.setdefault(kind, []).append((body, made))
            else:
                uploads.built = None if given.dropped else (made, given)
        for posted in wanted.values():
            errors += self._use(posted)
        if errors:
            raise errors[0]

    def _use(self, built: Sequence[tuple[int, UploadedFactor]]) -> list[Exception]:
        """Posts factors of one kind; returns errors as `_unusable`."""
        bodies, factors = [body for body, _ in built], [made for _, made in built]
        planned, inverses = [made.planned for made in factors], [made.inverse for made in factors]
        try:
            self._solver.use(bodies, planned, inverses, factors[0].planes, [made.step for made in factors])
        except Exception as error:
            if len(built) == 1:
                return self._unusable(self._uploads[bodies[0]], error)
            return [each for one in built for each in self._use([one])]  # those that can be are used
        self._mail(bodies, factors)
        return []

    def _mail(self, bodies: Sequence[int], factors: Sequence[UploadedFactor]) -> None:
        """Posts the rows of bodies that have new factors."""
        each = [self._uploads[body] for body in bodies]
        rows = self._solver.bodies[list(bodies)].view(np.uint8).reshape(len(bodies), -1)[:, SETTINGS_BYTES:]
        events = [made.inverse.event.ptr for made in factors]
        mails = post_all([uploads.mailbox for uploads in each], rows, factors, events)
        for uploads, made, mail in zip(each, factors, mails, strict=True):
            if made.planes != uploads.planes:
                self._tell(uploads, made.planes)
            uploads.posted, uploads.mail = made, mail

    def _unusable(self, uploads: BodyUploads, error: Exception) -> list[Exception]:
        """Warns that a factor of a body cannot be used; returns the error if it is neither of the factor nor lack of
        memory."""
        if isinstance(error, ValueError | CompileError):
            self._warn(uploads, str(error))
        elif no_memory_left(error):
            self._warn(uploads, f"not enough GPU memory: {error}")
        else:
            return [error]
        return []

    def _keep(self, uploads: BodyUploads, factor: UploadedFactor) -> None:
        """Keeps the new storage of a factor, and forgets those of kinds that are not used any more."""
        if factor.kind not in uploads.storages:
            in_use = uploads.in_use.kind if uploads.in_use else None
            outdated = [k for k in uploads.storages if k != in_use]
            for old in outdated:
                if len(uploads.storages) >= MAX_KINDS:
                    factor.inverse.event.synchronize()  # a build before it, of one that was dropped, may write there
                    del uploads.storages[old]
            uploads.expected = None
            if outdated or factor.kind not in self._known:
                self._forget_plans(factor.kind)
        uploads.storages.setdefault(factor.kind, []).append(factor.storage)

    def _forget_plans(self, needed: InverseKind) -> None:
        """Forgets the plans of kinds that no body has. needed: one that is about to be used"""
        self._known = {needed}.union(*(each.kinds(body) for body, each in enumerate(self._uploads)))
        self._solver.forget_plans(self._known)

    def _tell(self, uploads: BodyUploads, planes: int) -> None:
        """Takes note that inverses have another number of digits from now on, and logs it."""
        uploads.planes = planes
        log.info("object %r: its factors keep %d binary digits on the GPU from now on", uploads.name, 11 * planes)

    def _warn(self, uploads: BodyUploads, reason: str) -> None:
        if not uploads.warned:
            uploads.warned = True
            held = "the factor that it has" if uploads.in_use else "block Jacobi"
            log.warning(
                "object %r: a factor cannot be used on the GPU: %s; it goes on with %s", uploads.name, reason, held
            )


def _on_host(values: NDArray[Any] | DeviceValues) -> NDArray[Any]:
    """Returns values in memory of the host. Those that are there stay as they are: they may know their address
    (Located), which np.asarray drops."""
    return values if isinstance(values, np.ndarray) else np.asarray(values)


def _tell(waiting: "Future[Applied | None] | None", applied: Applied | None) -> None:
    if waiting is not None:
        with suppress(InvalidStateError):
            waiting.set_result(applied)
