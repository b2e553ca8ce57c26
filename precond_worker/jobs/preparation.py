# SPDX-License-Identifier: MIT
"""What a worker does before the first jobs of a server: the symbolic phase of its large objects."""

import logging
import time
from collections import deque
from math import inf

from precond_worker.errors import DeviceUnusable
from precond_worker.jobs.analyses import Analyses
from precond_worker.network.server_connection import ServerConnection
from precond_worker.symbolic.preparation import LEAST_NODES, objects_to_prepare
from protocol.method import Method
from protocol.process.exhausted import exhausted
from protocol.refused import Refused

log = logging.getLogger(__name__)

ASK_AGAIN = 0.1  # s until a server that does not tell yet what it simulates is asked again
ASK_FOR = 60.0  # s for which it is: its name is there before its scene is made


class Preparation:
    """Objects to be made ready for, one at a time, while no job waits.

    unprepared: these; None: the scene tells which
    ask_at: when it is asked for [s, monotonic]
    """

    def __init__(self, connection: ServerConnection, analyses: Analyses):
        self._connection, self._analyses = connection, analyses
        self.unprepared: deque[str | None] = deque()
        self.ask_at = self._ask_until = 0.0

    def begin(self) -> None:
        """Begins to look what there is to prepare at a server."""
        self.unprepared.append(None)
        self.ask_at, self._ask_until = 0.0, time.monotonic() + ASK_FOR

    def clear(self) -> None:
        """Leaves what is not prepared yet."""
        self.unprepared.clear()

    @property
    def pause(self) -> float:
        """Time [s] until there is something to prepare; inf: there is nothing."""
        return max(0.0, self.ask_at - time.monotonic()) if self.unprepared else inf

    def do_next(self) -> None:
        """Does the symbolic phase of the next object, unless it is small, or finds out of which objects it is to be
        done. Raises DeviceUnusable, and what shows that the process lacks something for good."""
        object = self.unprepared.popleft()
        try:
            if object is None:
                self.unprepared.extend(self._objects())
            else:
                self._prepare(object)
        except DeviceUnusable:
            raise
        except Exception as error:  # the first job will tell of it, if it is still so then
            if exhausted(error) and not isinstance(error, MemoryError):
                raise
            log.debug("nothing is prepared: %s", error)

    def _prepare(self, object: str) -> None:
        topology = self._connection.topology(object)
        if topology.nodes < LEAST_NODES:
            return
        analysis = self._analyses.of_object(object, topology, Method()).factorization
        self._connection.send_pattern(analysis.pattern, object, topology.header.epoch)
        if (make_ready := getattr(analysis, "make_ready", None)) is not None:
            make_ready()

    def _objects(self) -> list[str | None]:
        """Returns the objects that are to be made ready for; None in place of them where the server is to be asked
        again: it does not tell yet, and has sent no job."""
        try:
            return [*objects_to_prepare(self._connection.scene())]
        except Refused:
            now = time.monotonic()
            if self._analyses or now > self._ask_until:
                raise
            self.ask_at = now + ASK_AGAIN
            return [None]
