# SPDX-License-Identifier: MIT
"""The main loop of a worker process: connects to servers, finds new ones and serves them in turn."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Self

import zenoh

from precond_worker.network.connect import Connector
from precond_worker.network.server_addresses import EVERY, ServerAddress
from precond_worker.network.server_connection import ServerConnection
from precond_worker.round_robin import RoundRobin
from precond_worker.worker import Worker
from protocol.channels import key, server_in
from protocol.network.identity import Identity
from protocol.network.session import Session
from protocol.refused import Refused

log = logging.getLogger(__name__)

MAX_SERVERS = 64  # found without being named

# (session, name of the server, wake) -> connection; (connection, address) -> worker
MakeConnection = Callable[[Session, str, threading.Event], ServerConnection]
MakeWorker = Callable[[ServerConnection, ServerAddress], Worker]


class MainLoop:
    """Connects to all addresses and serves the servers there in turn. Raises NameTaken from `step`."""

    def __init__(
        self,
        addresses: Sequence[ServerAddress],
        shared_memory: bool,
        connection: MakeConnection,
        worker: MakeWorker,
        tls: Identity | None = None,
    ):
        self._connection, self._worker = connection, worker
        self._round_robin = RoundRobin(threading.Event())
        self._known: set[str] = set()
        self._found: deque[tuple[ServerAddress, Session, str]] = deque(maxlen=4 * MAX_SERVERS)
        self._watching: list[zenoh.Subscriber] = []
        self._closing = ExitStack()
        self._connector = Connector(addresses, shared_memory, self._round_robin.wake, tls)
        self._closing.callback(self._connector.close)

    def run(self) -> None:
        """Works until an exception such as KeyboardInterrupt."""
        while True:
            self.step(1.0)

    def step(self, timeout: float) -> None:
        """Serves new servers, takes in what was received, and does one job."""
        for address, session in self._connector.reached():
            if EVERY in address.servers:
                self._watch(address, session)
            else:
                for name in address.servers:
                    self._serve(address, session, name)
        while self._found:
            address, session, name = self._found.popleft()
            if name not in self._known and len(self._known) < MAX_SERVERS:
                self._serve(address, session, name)
        self._round_robin.step(timeout)

    def _serve(self, address: ServerAddress, session: Session, name: str) -> None:
        self._known.add(name)
        connection = self._closing.enter_context(self._connection(session, name, self._round_robin.wake))
        self._round_robin.add(self._worker(connection, address))

    def _watch(self, address: ServerAddress, session: Session) -> None:
        """Finds every server at an address, present and future ones."""

        def found(sample: zenoh.Sample) -> None:
            try:
                self._found.append((address, session, server_in(sample.key_expr)))
            except Refused as refusal:
                log.warning("no server of ours: %s", refusal)
            self._round_robin.wake.set()

        everybody = key("alive_server", EVERY)
        self._watching.append(session.zenoh.liveliness().declare_subscriber(everybody, found, history=True))

    def close(self) -> None:
        """Ends heartbeats, then sessions."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
