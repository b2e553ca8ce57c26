# SPDX-License-Identifier: MIT
"""Begins to build the inverses of factors: chooses their digits, has them planned, and launches those of one plan
together."""

import logging
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int64
from sim_server.backends.gpu.cupy_types import Event
from sim_server.backends.gpu.device import Gpu, no_memory_left
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.inverse.apply_inverse import Applied
from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder, InverseStorage
from sim_server.backends.gpu.inverse.device_digits import is_large
from sim_server.backends.gpu.loop import DeviceLoop
from sim_server.backends.gpu.solver import PcgSolver, PlannedInverse
from sim_server.backends.gpu.upload.body_inverses import BodyInverses, InverseKind
from sim_server.backends.gpu.upload.given_factor import GivenFactor

log = logging.getLogger(__name__)

BUSY = 0.25  # share of dt that steps in real time take, up to which builds may have the whole device
MANY = 16  # inverses that are built together, from which on they may have it for an instant
SHORT = 16 << 20  # bytes of the values of their factors, up to which that is some 200 us


class Alike(NamedTuple):
    """Factors of different bodies whose inverses are built by one plan."""

    bodies: Int64
    given: list[GivenFactor]
    kind: InverseKind
    plan: Future[PlannedInverse]


class BuiltInverses(NamedTuple):
    """Inverses of different bodies and of one kind and plan, that were begun together.

    new: rows of those whose storage is new
    event: after it they are complete
    """

    bodies: Int64
    given: list[GivenFactor]
    kind: InverseKind
    planned: PlannedInverse
    storages: list[InverseStorage]
    new: list[int]
    event: Event

    def of(self, rows: Sequence[int]) -> "BuiltInverses":
        """Returns some of them, none of which has a new storage."""
        given, storages = [self.given[k] for k in rows], [self.storages[k] for k in rows]
        return self._replace(bodies=self.bodies[rows], given=given, storages=storages, new=[])


@dataclass
class Made:
    """What came of factors.

    failed: bodies whose inverse was not begun, and why
    applied: P^-1 r on its way, of those that are applied
    """

    built: list[BuiltInverses] = field(default_factory=list)
    failed: list[tuple[int, Exception]] = field(default_factory=list)
    applied: list[tuple[GivenFactor, Applied]] = field(default_factory=list)

    def tell(self, given: Sequence[GivenFactor]) -> "Made":
        """Tells who waits for P^-1 r of these factors, also that there is none."""
        for each, applied in self.applied:
            each.tell(applied)
        for each in given:
            each.tell(None)  # unless it was told
        return self


class InverseBuilds:
    """Begins builds, for a caller or in the thread of the plans.

    inverses: of the bodies; of those that are given none is being built by others
    names: of the bodies, for messages
    """

    def __init__(self, gpu: Gpu, solver: PcgSolver, loop: DeviceLoop, inverses: BodyInverses, names: Sequence[str]):
        self._gpu, self._solver, self._loop, self._inverses, self._names = gpu, solver, loop, inverses, names

    def choose(self, bodies: Int64, given: Sequence[GivenFactor], planes: int = 0) -> list[Alike]:
        """Chooses how many digits the inverses of factors need, and begins their plans. planes: as many as these; 0:
        not known yet"""
        needed = [planes] * len(given) if planes else self._planes_of(given)
        rows: dict[tuple[int, int, int], list[int]] = {}
        blocks = self._solver.thread_blocks(bodies)
        for row, (each, own, count) in enumerate(zip(given, needed, blocks, strict=True)):
            rows.setdefault((each.pattern.id, own, count), []).append(row)
        return [
            Alike(bodies[alike], [given[k] for k in alike], (pattern, own), self._plan(bodies, given, alike[0], own))
            for (pattern, own, _), alike in rows.items()
        ]

    def _plan(self, bodies: Int64, given: Sequence[GivenFactor], row: int, planes: int) -> Future[PlannedInverse]:
        return self._solver.begin_plan(int(bodies[row]), given[row].pattern, planes)

    def begin(self, bodies: Int64, given: Sequence[GivenFactor], before: int) -> "list[Alike] | Made":
        """Begins to build inverses in the thread of the plans, as far as it may; returns what is made, or chosen, if
        plans are not made yet. before: float16 numbers per entry of the inverse before, where there is one factor"""
        try:
            unknown = len(given) == 1 and self._solver.planes is None and not given[0].planes
            if unknown and (made := self._build_ahead(bodies, given[0], before)) is not None:
                return made
            chosen = self.choose(bodies, given)
            return self.build(chosen) if all(each.plan.done() for each in chosen) else chosen
        except Exception as error:
            return Made(failed=[(body, error) for body in bodies.tolist()]).tell(given)

    def _build_ahead(self, bodies: Int64, given: GivenFactor, planes: int) -> Made | None:
        """Begins to build an inverse with as many digits as the one before had, and finds out meanwhile how many it
        needs. None: it needs others."""
        chosen, made, fits = self.choose(bodies, [given], planes), Made(), False
        try:
            if planned := chosen[0].plan.done():
                made = self._built(chosen)
            given.planes = self._planes_of([given])[0]
            fits = planned and given.planes == planes
        finally:
            if not fits:
                for each in made.built:
                    each.event.synchronize()  # the device writes into memory that nobody keeps
        return made.tell([given]) if fits else None

    def _planes_of(self, given: Sequence[GivenFactor]) -> list[int]:
        """Returns the float16 numbers per entry that the inverse of each of some factors needs."""
        if self._solver.planes is not None:
            return [self._solver.planes] * len(given)
        if len(given) == 1 and not given[0].planes:
            return [self._planes_of_one(given[0])]
        if not (unknown := [each for each in given if not each.planes]):
            return [each.planes for each in given]
        found = iter(self._solver.planes_of([(each.pattern, _on_host(each.values)) for each in unknown]))
        return [each.planes or next(found) for each in given]

    def _planes_of_one(self, given: GivenFactor) -> int:
        """A large factor is brought to the device first, where its digits are found out."""
        if given.source is None:
            given.source = self._solver.brought(given.values) if is_large(given.values) else given.values
        if isinstance(given.source, DeviceValues):
            return self._solver.planes_on_device(given.pattern, given.source, self._multiprocessors)
        return self._solver.planes_of([(given.pattern, _on_host(given.source))])[0]

    def build(self, chosen: Sequence[Alike]) -> Made:
        """Begins to build inverses; waits for their plans. Tells who waits for their applications."""
        return self._built(chosen).tell([given for alike in chosen for given in alike.given])

    def _built(self, chosen: Sequence[Alike]) -> Made:
        made = Made()
        for alike in chosen:
            self._build_alike(alike, made)
        return made

    def _build_alike(self, alike: Alike, made: Made) -> None:
        """Adds what comes of some factors to what is made."""
        bodies, left = alike.bodies.tolist(), list(range(len(alike.given)))
        try:
            planned = alike.plan.result()
            storages, new = self._storages(alike, planned, made)
            left = list(storages)
            while left:
                some = left[: planned.builder.most]
                made.built.append(self._launch(alike, planned, {row: storages[row] for row in some}, new))
                left = left[len(some) :]
                made.applied += self._applied(made.built[-1])
        except Exception as error:  # those that were begun are there: the device writes into their storages
            made.failed += [(bodies[row], error) for row in left]

    def _storages(
        self, alike: Alike, planned: PlannedInverse, made: Made
    ) -> tuple[dict[int, InverseStorage], set[int]]:  # fmt: skip
        """Returns storages by row, new ones where there are none to spare, and the rows of these; vectors are there,
        too. Without that the build fails."""
        bodies, spare = alike.bodies.tolist(), self._inverses.spare(alike.bodies, alike.kind)
        missing = {row for row, storage in enumerate(spare) if storage is None}
        without = self._solver.without_vectors(bodies, planned.plan)
        if missing or without:
            several = self._new_storages(planned.builder, len(missing))
            for row in sorted(missing.union(without)):
                try:
                    if row in missing:
                        spare[row] = several.pop(0) if several else planned.builder.storage()
                    if row in without:
                        self._solver.reserve_vectors(bodies[row], planned.plan)
                except Exception as error:
                    made.failed.append((bodies[row], error))
                    spare[row] = None
            if without:
                self._gpu.cp.cuda.get_current_stream().synchronize()  # they are complete for other streams
        return {row: storage for row, storage in enumerate(spare) if storage is not None}, missing

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

    def _launch(
        self, alike: Alike, planned: PlannedInverse, storages: dict[int, InverseStorage], new: set[int]
    ) -> BuiltInverses:  # fmt: skip
        """Begins to build the inverses in some rows, each in its storage."""
        rows, own = list(storages), list(storages.values())
        given = alike.given if len(rows) == len(alike.given) else [alike.given[row] for row in rows]
        values = [each.values if each.source is None else each.source for each in given]
        # On few multiprocessors many small ones take some ms, and the next ones wait for them
        short = len(values) >= MANY and sum(each.nbytes for each in values) <= SHORT
        event = planned.builder.build_many(values, own, None if short else self._multiprocessors)
        places = [place for place, row in enumerate(rows) if row in new] if new else []
        return BuiltInverses(alike.bodies[rows], given, alike.kind, planned, own, places, event)

    def _applied(self, built: BuiltInverses) -> list[tuple[GivenFactor, Applied]]:
        """Begins to apply inverses for the check of their factors, which goes without where that cannot be done: the
        inverse is there all the same, and the device writes into its storage."""
        found = []
        for row, given in enumerate(built.given):
            if given.r is None or given.dropped:  # nobody would keep the memory that it comes to
                continue
            try:
                applied = built.planned.builder.apply(built.storages[row], given.r, self._multiprocessors)
                found.append((given, applied))
            except Exception as error:
                name = self._names[built.bodies[row]]
                log.warning("object %r: a factor is not applied for its check: %s", name, error)
        return found

    @property
    def _multiprocessors(self) -> int | None:
        """Multiprocessors that a build may keep busy: those that solves leave free; None: all, where steps in real time
        leave the device idle most of the time. A step then waits some 100 us now and then, and the build is done the
        sooner."""
        loop = self._loop.loop
        idle = loop.realtime and 0 < loop.step_seconds < BUSY * loop.dt
        return None if idle else self._solver.spared


def _on_host(values: NDArray[Any] | DeviceValues) -> NDArray[Any]:
    """Returns values in memory of the host. Those that are there stay as they are: they may know their address
    (Located), which np.asarray drops."""
    return values if isinstance(values, np.ndarray) else cast(NDArray[Any], np.asarray(values))
