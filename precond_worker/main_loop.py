# SPDX-License-Identifier: MIT
"""The main loop of a worker process: connects to servers, finds those of a pool and serves them in turn."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import NamedTuple, Self

from precond_worker.network.connect import Connector
from precond_worker.network.pool import Pool
from precond_worker.network.server_addresses import EVERY, ServerAddress
from precond_worker.network.server_connection import ServerConnection
from precond_worker.round_robin import RoundRobin
from precond_worker.worker import Worker
from protocol.counters import Counters
from protocol.network.identity import Identity
from protocol.network.session import Session

log = logging.getLogger(__name__)

POOL_PERIOD = 0.5  # s between two looks at needs
LEAVE_TIME = 0.5  # s in which a server hears that this worker leaves, and its last job may still come

# (session, name of the server, wake) -> connection; (connection, address) -> worker
MakeConnection = Callable[[Session, str, threading.Event], ServerConnection]
MakeWorker = Callable[[ServerConnection, ServerAddress], Worker]


class _Served(NamedTuple):
    """A server of a pool that is served, or is being left."""

    connection: ServerConnection
    worker: Worker


class MainLoop:
    """Connects to all addresses and serves the servers there in turn. Raises NameTaken from `step`.

    name: of this worker
    left: called with the connection to a server of a pool that is served no more
    alive: called between two jobs, and every second or so
    """

    def __init__(
        self,
        addresses: Sequence[ServerAddress],
        shared_memory: bool,
        connection: MakeConnection,
        worker: MakeWorker,
        tls: Identity | None = None,
        name: str = "",
        left: Callable[[ServerConnection], None] = lambda connection: None,
        alive: Callable[[], None] = lambda: None,
    ):
        self._connection, self._worker, self._name, self._left = connection, worker, name, left
        self._alive = alive
        self._round_robin = RoundRobin(threading.Event())
        self._pools: list[tuple[Pool, ServerAddress, Session]] = []
        self._served: dict[str, _Served] = {}  # by name, of pools
        self._named: set[str] = set()
        self._pool_due = 0.0
        self._closing = ExitStack()
        self._connector = Connector(addresses, shared_memory, self._round_robin.wake, tls)
        self._closing.callback(self._connector.close)

    def run(self) -> None:
        """Works until an exception such as KeyboardInterrupt."""
        while True:
            self.step(1.0)
            self._alive()

    def step(self, timeout: float) -> None:
        """Serves new servers, takes in what was received, and does one job."""
        for address, session in self._connector.reached():
            if EVERY in address.servers:
                counters = Counters(log)
                self._pools.append(
                    (Pool(session.zenoh, self._name, counters, self._round_robin.wake), address, session)
                )
            else:
                for name in address.servers:
                    self._named.add(name)
                    self._round_robin.add(self._serve(address, session, name).worker)
        if self._pools and time.monotonic() >= self._pool_due:
            self._pool_due = time.monotonic() + POOL_PERIOD
            for pool in self._pools:
                self._look(*pool)
        self._round_robin.step(min(timeout, POOL_PERIOD) if self._pools else timeout)

    def _serve(self, address: ServerAddress, session: Session, name: str) -> _Served:
        connection = self._connection(session, name, self._round_robin.wake)
        self._closing.callback(connection.close)
        return _Served(connection, self._worker(connection, address))

    def _look(self, pool: Pool, address: ServerAddress, session: Session) -> None:
        """Begins to serve the servers that the pool wants served, and leaves others without losing a job."""
        wanted = pool.wanted({name: served.connection.counters.jobs for name, served in self._served.items()})
        for name in wanted.keys() - self._served.keys() - self._named:
            self._served[name] = served = self._serve(address, session, name)
            self._round_robin.add(served.worker)
        for name, (connection, worker) in list(self._served.items()):
            if name in wanted:
                connection.share = wanted[name]
                if connection.leaving is not None:
                    connection.stay()
                continue
            connection.leave()
            since = time.monotonic() - (connection.leaving or 0.0)
            if worker.idle and since > LEAVE_TIME:
                del self._served[name]
                self._round_robin.remove(worker)
                connection.withdraw()
                self._left(connection)

    def close(self) -> None:
        """Ends heartbeats, then sessions."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
