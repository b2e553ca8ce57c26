# SPDX-License-Identifier: MIT
"""Records the inputs of a run that records and frames lack, so that it can be repeated bit for bit (replay/run.py).

The loop decides at which step a push, a move or a release takes effect, when it reads its mailbox; so the whole list
of interactions is written with the step at which the loop took it up, and so are the poses that clients gave to
obstacles and holders, and parameters of the scene that were set. Each factor is written with the step of its matrix and
its maker; step records tell which one a solve used.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from protocol import messages_pb2 as pb
from protocol.factor import Factor
from sim_server.arrays import Float64
from sim_server.backends.base import PendingUpdate
from sim_server.effects._base import Effect
from sim_server.network.link import ServerLink
from sim_server.parameters import ParameterUpdate
from sim_server.recording import messages
from sim_server.recording.obstacles import target_messages
from sim_server.recording.recorder import Recorder
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import EXACT

if TYPE_CHECKING:
    from sim_server.effects._movable import Movable
    from sim_server.effects.touch import Interaction


MAKERS = 512  # workers that are remembered
PENDING = 1024  # updates kept after the last that the loop took up; in a pause each one replaces the one before

T = TypeVar("T")
Updates = deque[tuple[PendingUpdate, T]]  # what the loop was given, oldest first


def _taken(updates: Updates[T]) -> list[tuple[int, T]]:
    """Removes the updates up to the newest that the loop has taken up; returns those that it has, with the step.

    The others were replaced before the loop saw them.
    """
    taken = [i for i, (pending, _) in enumerate(updates) if pending.taken >= 0]
    removed = [updates.popleft() for _ in range(taken[-1] + 1 if taken else 0)]
    return [(removed[i][0].taken, removed[i][1]) for i in taken]


class ReplayRecorder:
    """Collects factors, interactions, moves of obstacles and holders, and parameters as the loop gets them.

    Call `write` before the steps that they act in are recorded.
    """

    def __init__(self, driver: Driver, link: ServerLink, recorder: Recorder):
        self._driver, self._link, self._recorder = driver, link, recorder
        self._factors: deque[tuple[Factor, pb.WorkerInfo]] = deque()  # with their makers; appended by who posts them
        self._touched: Updates[list[Interaction]] = deque(maxlen=PENDING)
        movers = [m for m in (driver.simulation.contact, driver.simulation.holders) if m is not None]
        self._movers: dict[Movable, Updates[dict[str, Float64]]] = {m: deque(maxlen=PENDING) for m in movers}
        self._with_nodes: set[int] = set()  # ids of the interactions of the last list; the log holds their nodes
        self._workers: dict[str, pb.WorkerInfo] = {}  # makers of factors, the one of the newest last
        driver.on_adopt.append(lambda factor: self._factors.append((factor, self._maker(factor))))
        self._touch = driver.simulation.touch
        driver.simulation.on_effect_update.append(self._on_update)
        self._parameters: deque[ParameterUpdate] = deque()
        driver.simulation.parameters.on_set.append(self._on_set)

    def _on_update(self, effect: Effect, pending: PendingUpdate) -> None:
        if self._touch is not None and effect is self._touch:
            self._touched.append((pending, self._touch.applied))
        for mover, moved in self._movers.items():
            if effect is mover:
                moved.append((pending, mover.targets))

    def _on_set(self, update: ParameterUpdate) -> None:
        if self._parameters and self._parameters[-1] is update.replaces:  # which the loop never took up
            self._parameters.pop()
        if update.values:
            self._parameters.append(update)

    def write(self, block: bool) -> None:
        """Writes all that was taken up since the last call; so a log that is cut off holds the inputs of its steps."""
        for _ in range(len(self._factors)):
            self._recorder.factor(self._factor(*self._factors.popleft()), block)
        for step, interactions in _taken(self._touched):
            self._recorder.touch_set(self._touch_set(step, interactions), self._dt * step, block)
        while self._parameters and self._parameters[0].taken >= 0:
            update = self._parameters.popleft()
            message = messages.parameter_set(update.taken, update)
            self._recorder.parameters(message, self._dt * update.taken, block)
        taken = [each for moved in self._movers.values() for each in _taken(moved)]
        for step, targets in sorted(taken, key=lambda each: each[0]):
            self._recorder.targets(target_messages(step, targets), self._dt * step, block)

    @property
    def _dt(self) -> float:
        return self._driver.simulation.world.dt

    def _touch_set(self, step: int, interactions: list[Interaction]) -> pb.TouchSet:
        found = pb.TouchSet(step=step, interactions=map(messages.interaction, interactions))
        for a, message in zip(interactions, found.interactions, strict=True):
            if a.id not in self._with_nodes:
                message.held = a.nodes.astype("<i4").tobytes()
                message.offsets = np.ascontiguousarray(a.offset, "<f8").tobytes()
        self._with_nodes = {a.id for a in interactions}  # one that has left a list is in none after it
        return found

    def _maker(self, factor: Factor) -> pb.WorkerInfo:
        """Returns what the worker of a factor last said of itself: one that is started again may have another library.

        Of one that has left since, what it had said when its last factor came.
        """
        name = factor.worker
        if name == self._driver.inline.WORKER:
            return pb.WorkerInfo(worker=name, library=self._driver.inline.library(factor.object), threads=1)
        maker = self._link.dispatch.worker_info(name)
        if maker is None:
            return self._workers.get(name, pb.WorkerInfo(worker=name))
        self._workers.pop(name, None)
        self._workers[name] = maker
        if len(self._workers) > MAKERS:
            del self._workers[next(iter(self._workers))]
        return maker

    def _factor(self, factor: Factor, maker: pb.WorkerInfo) -> pb.FactorUse:
        exact = factor.method in ("", EXACT.name)
        library = maker.library if exact else "native"
        return pb.FactorUse(
            header=pb.Header(object=factor.object, epoch=factor.epoch), step=factor.step, pattern=factor.pattern.id,
            checksum=factor.checksum(), dtype=factor.values.dtype.name, worker=factor.worker,
            library=library, threads=maker.threads, seconds=factor.seconds, remedy=factor.remedy,
            method=factor.method, ahead=factor.ahead, later=factor.later,
        )  # fmt: skip
