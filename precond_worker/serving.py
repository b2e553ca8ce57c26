# SPDX-License-Identifier: MIT
"""A worker process and all the servers that it works for, those that appear later too."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Self

import zenoh

from precond_worker.joining import Joining
from precond_worker.places import EVERY, Place
from precond_worker.rota import Rota
from precond_worker.uplink import Uplink
from precond_worker.worker import Worker
from protocol.channels import key, server_in
from protocol.refused import Refused
from protocol.session import Session

log = logging.getLogger(__name__)

MOST = 64  # servers that are found by themselves

# (session, name of the server, bell) -> the uplink to it; (uplink, place) -> the loop that serves it
MakeUplink = Callable[[Session, str, threading.Event], Uplink]
MakeWorker = Callable[[Uplink, Place], Worker]


class Serving:
    """Joins all places, finds the servers there and serves them in turn. Raises NameTaken from step."""

    def __init__(self, places: Sequence[Place], shared_memory: bool, uplink: MakeUplink, worker: MakeWorker):
        self._uplink, self._worker = uplink, worker
        self._rota = Rota(threading.Event())
        self._known: set[str] = set()
        self._found: deque[tuple[Place, Session, str]] = deque(maxlen=4 * MOST)
        self._watching: list[zenoh.Subscriber] = []
        self._closing = ExitStack()
        self._joining = Joining(places, shared_memory, self._rota.bell)
        self._closing.callback(self._joining.close)

    def run(self) -> None:
        """Work until an exception, such as KeyboardInterrupt, ends it."""
        while True:
            self.step(1.0)

    def step(self, timeout: float) -> None:
        """Greet what was reached or found, take in what came, do one job."""
        for place, session in self._joining.reached():
            if EVERY in place.servers:
                self._watch(place, session)
            else:
                for name in place.servers:
                    self._serve(place, session, name)
        while self._found:
            place, session, name = self._found.popleft()
            if name not in self._known and len(self._known) < MOST:
                self._serve(place, session, name)
        self._rota.step(timeout)

    def _serve(self, place: Place, session: Session, name: str) -> None:
        self._known.add(name)
        uplink = self._closing.enter_context(self._uplink(session, name, self._rota.bell))
        self._rota.add(self._worker(uplink, place))

    def _watch(self, place: Place, session: Session) -> None:
        """Every server that lives there, now or later."""

        def found(sample: zenoh.Sample) -> None:
            try:
                self._found.append((place, session, server_in(sample.key_expr)))
            except Refused as refusal:
                log.warning("no server of ours: %s", refusal)
            self._rota.bell.set()

        everybody = key("alive_server", EVERY)
        self._watching.append(session.zenoh.liveliness().declare_subscriber(everybody, found, history=True))

    def close(self) -> None:
        """End heartbeats, then sessions."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
