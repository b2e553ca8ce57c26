# SPDX-License-Identifier: MIT
"""Upload of factors: a partitioned inverse is built beside the steps, then posted into the mailbox of the body.

Each body has two storages per pattern and number of binary digits (double buffering). A build begins once the inverse
before it is in use and no step under way reads the other storage. A factor that arrives earlier is queued; a newer one
replaces it. Plans, made once per pattern, and the copies of large factors, or of many, are left to a thread
(PcgSolver.beside), for which the thread that serves the loop does not wait.

A factor may be *prepared* while it is checked: its inverse is built, applied once for the check, and kept out of use
until the factor is posted, or dropped.
"""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, InvalidStateError, wait
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, cast

from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.compiler import CompileError
from sim_server.backends.gpu.device import Gpu, no_memory_left
from sim_server.backends.gpu.inverse.apply_inverse import Applied
from sim_server.backends.gpu.inverse.build_inverse import InverseStorage, PartitionedInverse
from sim_server.backends.gpu.loop import DeviceLoop
from sim_server.backends.gpu.mailbox import DeviceMailbox
from sim_server.backends.gpu.solver import SETTINGS_BYTES, PcgSolver, PlannedInverse

log = logging.getLogger(__name__)

SMALL = 1 << 20  # bytes of a factor that is copied at once
MANY = 4  # small factors that come together, from which on none is built at once
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

    @property
    def kind(self) -> InverseKind:
        """Of its inverse."""
        return self.pattern.id, self.planes


Build = Future[UploadedFactor] | Future[UploadedFactor | Future[UploadedFactor]]
"""In the thread of the plans; it may end with one behind it."""


@dataclass(eq=False)
class GivenFactor:
    """A factor that came. Its values do not change any more.

    r: vector that its inverse is to be applied to. None: to none
    applied: P^-1 r on its way; None: nobody applies it
    wanted: it is to be used; False: once it is posted
    dropped: nobody wants it any more
    """

    pattern: FactorPattern
    values: NDArray[Any]
    step: int
    r: Float64 | None = None
    applied: "Future[Applied | None]" = field(default_factory=Future)
    wanted: bool = True
    dropped: bool = False

    def drop(self) -> None:
        """Gives it up."""
        self.dropped = True
        self.tell(None)

    def tell(self, applied: Applied | None) -> None:
        """Tells who waits for P^-1 r, if it is not told yet."""
        with suppress(InvalidStateError):
            self.applied.set_result(applied)


@dataclass
class BodyUploads:
    """Factors of one body.

    planes: float16 numbers per entry of the last factor's inverse, or of the first one's as expected
    storages: by kind
    leaving: the factor in use before, and the number of steps after whose completion no step reads it
    posted: not taken by the loop yet
    building: in the thread of the plans, and the factor that it is of
    built: prepared, and the factor that it is of, which is neither posted nor dropped yet
    queued: a factor that waits for a storage, or for that thread
    warned: True after the first factor that could not be used
    """

    name: str
    mailbox: DeviceMailbox
    planes: int
    storages: dict[InverseKind, list[InverseStorage]] = field(default_factory=dict)
    in_use: UploadedFactor | None = None
    leaving: tuple[UploadedFactor, int] | None = None
    posted: UploadedFactor | None = None
    building: tuple[Build, GivenFactor] | None = None
    built: tuple[UploadedFactor, GivenFactor] | None = None
    queued: GivenFactor | None = None
    warned: bool = False

    @property
    def free(self) -> bool:
        """True if a build may begin: a storage is free, or will be made."""
        return self.posted is None and self.leaving is None and self.building is None and self.built is None

    @property
    def kinds(self) -> set[InverseKind]:
        """Kinds of inverses whose plans are needed, or may be."""
        coming = [given for given in (self.queued, self.building and self.building[1]) if given]
        return {*self.storages, *((given.pattern.id, planes) for given in coming for planes in (1, 2))}


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
        self._waiting: set[int] = set()  # bodies with a queued factor, or one that is built

    def expect(self, body: int, pattern: FactorPattern) -> None:
        """Begins to plan the inverses of factors of a pattern, beside the caller."""
        self._solver.begin_plan(body, pattern, self._uploads[body].planes)

    def post(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Takes a factor: begins to build its inverse now, or once a storage is free.

        Returns at once: what takes long, plans and large factors, is done beside the caller. The values must not change
        any more.
        """
        with self._lock:
            self._refresh(body)
            if not self._use_prepared(body, values):
                self._enqueue(body, GivenFactor(pattern, values, step))
                self._begin_queued(body)

    def prepare(
        self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int, r: Float64
    ) -> "Future[Applied | None]":  # fmt: skip
        """Builds the inverse of a factor, beside the caller, and applies it to r (n,); it is used once these very
        values are posted. Returns P^-1 r; None as its result if it comes to nothing."""
        given = GivenFactor(pattern, values, step, r, wanted=False)
        with self._lock:
            self._refresh(body)
            self._enqueue(body, given)
            self._begin_queued(body, beside=True)
        return given.applied

    def drop(self, body: int, values: NDArray[Any]) -> None:
        """Gives up a factor that was prepared and not posted; any other one is let alone."""
        with self._lock:
            uploads = self._uploads[body]
            self._refresh(body)
            given = self._prepared(uploads, values)
            if given is None:
                return
            given.drop()
            if uploads.built is not None and uploads.built[1] is given:
                uploads.built = None
            if uploads.queued is given:
                uploads.queued = None
            self._begin_queued(body)

    def _prepared(self, uploads: BodyUploads, values: NDArray[Any]) -> GivenFactor | None:
        """Returns the factor with these values that is prepared and not posted."""
        coming = (uploads.queued, *(each[1] for each in (uploads.building, uploads.built) if each is not None))
        return next((each for each in coming if each is not None and not each.wanted and each.values is values), None)

    def _use_prepared(self, body: int, values: NDArray[Any]) -> bool:
        """Has a prepared factor used, at once if it is built; False if there is none with these values."""
        uploads = self._uploads[body]
        given = self._prepared(uploads, values)
        if given is None:
            return False
        given.wanted = True
        if uploads.built is not None and uploads.built[1] is given:
            (factor, _), uploads.built = uploads.built, None
            self._finish(body, given, lambda: factor)
        return True

    def _enqueue(self, body: int, given: GivenFactor) -> None:
        """Puts a factor in the place of the one that waits, or that waits to be posted."""
        uploads = self._uploads[body]
        if uploads.queued is not None:
            uploads.queued.drop()
        if uploads.built is not None:
            uploads.built[1].drop()
            uploads.built = None
        uploads.queued = given

    def post_many(self, given: Sequence[tuple[int, FactorPattern, NDArray[Any], int]]) -> None:
        """Takes factors of different bodies, each as `post` takes one. Inverses of many are built beside the caller,
        who would wait for one after another."""
        with self._lock:
            for body, pattern, values, step in given:
                self._refresh(body)
                if not self._use_prepared(body, values):
                    self._enqueue(body, GivenFactor(pattern, values, step))
                    self._begin_queued(body, len(given) >= MANY)

    def advance(self) -> None:
        """Posts what was built beside the caller, and begins the builds that have waited for a storage."""
        with self._lock:
            waiting = sorted(self._waiting)
            for body in waiting:
                self._refresh(body)
                self._begin_queued(body, len(waiting) >= MANY)

    def settle(self) -> None:
        """Waits until the next step will use the newest factors. Only while the loop stands still."""
        for body in range(len(self._uploads)):
            while (building := self._settled(body)) is not None:
                wait([building])  # without the lock: the thread that serves the loop goes on

    def _settled(self, body: int) -> Future[Any] | None:
        """Has the next step use the newest factor of a body; returns a build that must be waited for first."""
        with self._lock:
            uploads = self._uploads[body]
            self._refresh(body)
            if uploads.queued is not None and uploads.building is None:
                uploads.built = None
                if uploads.posted is not None and uploads.mailbox.withdraw():
                    uploads.posted.inverse.event.synchronize()  # its storage may be reused
                    uploads.posted = None
                self._refresh(body)
                uploads.leaving = None
                self._begin_queued(body)
            if uploads.building is not None:
                return uploads.building[0]
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
        while uploads.building is not None and uploads.building[0].done():
            (future, given), uploads.building = uploads.building, None
            made = None if future.exception() else future.result()
            if isinstance(made, Future):
                uploads.building = made, given
            else:
                self._finish(body, given, cast(Future[UploadedFactor], future).result)
        if uploads.posted is not None and uploads.mailbox.taken:
            if uploads.in_use is not None:  # steps launched until now may still read it
                uploads.leaving = (uploads.in_use, int(self._loop.loop.launched))
            uploads.in_use, uploads.posted = uploads.posted, None
        if uploads.leaving is not None and self._loop.step >= uploads.leaving[1]:
            uploads.leaving = None

    def _begin_queued(self, body: int, beside: bool = False) -> None:
        """Begins to build the queued factor, if there is one and it need not wait. beside: not in this thread"""
        uploads = self._uploads[body]
        if uploads.queued is not None and uploads.free:
            given, uploads.queued = uploads.queued, None
            self._begin(body, given, beside)
        if uploads.queued is None and uploads.building is None:
            self._waiting.discard(body)
        else:
            self._waiting.add(body)

    def _begin(self, body: int, given: GivenFactor, beside: bool) -> None:
        """Builds an inverse: at once if it is small, planned and not `beside`, else in the thread of the plans."""
        uploads = self._uploads[body]
        used = uploads.in_use.storage if uploads.in_use else None
        spare = {kind: next((s for s in made if s is not used), None) for kind, made in uploads.storages.items()}
        if given.values.nbytes > SMALL or beside:
            uploads.building = self._solver.beside(partial(self._choose_and_build, body, given, spare)), given
            return
        build, planned = self._chosen(body, given, spare)
        if planned.done():
            self._finish(body, given, build)
        else:
            uploads.building = self._solver.beside(build), given

    def _choose_and_build(
        self, body: int, given: GivenFactor, spare: Mapping[InverseKind, InverseStorage | None]
    ) -> UploadedFactor | Future[UploadedFactor]:
        """Begins to build an inverse, in the thread of the plans: now, or behind its plan."""
        build, planned = self._chosen(body, given, spare)
        return build() if planned.done() else self._solver.beside(build)

    def _chosen(
        self, body: int, given: GivenFactor, spare: Mapping[InverseKind, InverseStorage | None]
    ) -> tuple[Callable[[], UploadedFactor], Future[PlannedInverse]]:
        """Returns what builds an inverse, with as many digits as it needs, once its plan is made, and that plan."""
        planes = self._solver.planes_for(given.pattern, given.values)
        plan = self._solver.begin_plan(body, given.pattern, planes)
        return partial(self._build, plan, given, planes, spare.get((given.pattern.id, planes))), plan

    def _build(
        self, plan: Future[PlannedInverse], given: GivenFactor, planes: int, spare: InverseStorage | None
    ) -> UploadedFactor:  # fmt: skip
        """Begins to build an inverse in a storage, a new one unless there is one to spare. The plan is made."""
        try:
            builder, multiprocessors = plan.result().builder, self._multiprocessors
            storage = builder.storage() if spare is None else spare
            self._gpu.cp.cuda.get_current_stream().synchronize()  # new arrays are complete for other streams
            inverse = builder.build(given.values, storage, multiprocessors)  # beside the steps
            if given.r is not None:
                given.tell(builder.apply(inverse, given.r, multiprocessors))
        finally:
            given.tell(None)
        return UploadedFactor(inverse, storage, given.step, given.pattern, planes)

    @property
    def _multiprocessors(self) -> int | None:
        """Multiprocessors that a build may keep busy: those that solves leave free; None: all, where steps in real time
        leave the device idle most of the time. A step then waits some 100 us now and then, and the build is done the
        sooner."""
        loop = self._loop.loop
        idle = loop.realtime and 0 < loop.step_seconds < BUSY * loop.dt
        return None if idle else self._solver.spared

    def _finish(self, body: int, given: GivenFactor, build: Callable[[], UploadedFactor]) -> None:
        """Posts the factor that `build` returns, if it is wanted already, or warns if it cannot be used."""
        uploads = self._uploads[body]
        try:
            factor = build()
            self._keep(uploads, factor)
            if not given.wanted:
                uploads.built = None if given.dropped else (factor, given)
                return
            self._solver.use(body, given.pattern, factor.inverse, factor.planes, factor.step)
        except (ValueError, CompileError) as error:
            self._warn(uploads, str(error))
            return
        except Exception as error:
            if not no_memory_left(error):
                raise
            self._warn(uploads, f"not enough GPU memory: {error}")
            return
        self._tell(uploads, factor.planes)
        uploads.posted = factor
        row = self._solver.bodies[body : body + 1].tobytes()[SETTINGS_BYTES:]
        self._gpu.cp.cuda.get_current_stream().synchronize()  # arrays that `use` may have made are complete
        uploads.mailbox.post(row, keep=factor, event=factor.inverse.event.ptr)

    def _keep(self, uploads: BodyUploads, factor: UploadedFactor) -> None:
        """Keeps the storage of a factor, and forgets those of kinds that are not used any more."""
        if factor.kind not in uploads.storages:
            in_use = uploads.in_use.kind if uploads.in_use else None
            for old in [k for k in uploads.storages if k != in_use]:
                if len(uploads.storages) >= MAX_KINDS:
                    del uploads.storages[old]
            kept = {each for other in self._uploads for each in other.kinds}
            self._solver.forget_plans({*kept, factor.kind})
        storages = uploads.storages.setdefault(factor.kind, [])
        if all(storage is not factor.storage for storage in storages):
            storages.append(factor.storage)

    def _tell(self, uploads: BodyUploads, planes: int) -> None:
        """Takes note of how many digits the inverse of a factor has, and logs it where that changes."""
        if planes != uploads.planes:
            uploads.planes = planes
            log.info("object %r: its factors keep %d binary digits on the GPU from now on", uploads.name, 11 * planes)

    def _warn(self, uploads: BodyUploads, reason: str) -> None:
        if not uploads.warned:
            uploads.warned = True
            held = "the factor that it has" if uploads.in_use else "block Jacobi"
            log.warning(
                "object %r: a factor cannot be used on the GPU: %s; it goes on with %s", uploads.name, reason, held
            )
