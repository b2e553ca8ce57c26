# SPDX-License-Identifier: MIT
"""The main loop of a worker process: connects to servers, finds those of a pool and serves them in turn."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import NamedTuple, Self

from precond_worker.errors import NameTaken
from precond_worker.network.connect import Connector
from precond_worker.network.pool import Pool
from precond_worker.network.server_addresses import EVERY, ServerAddress
from precond_worker.network.server_connection import ServerConnection
from precond_worker.network.trust import Sent
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
    """A server that is served, or is being left. pool: that found it, if one did"""

    connection: ServerConnection
    worker: Worker
    pool: Pool | None


class MainLoop:
    """Connects to all addresses and serves the servers there in turn. Raises NameTaken from `step`, unless it is of a
    server of a pool: that one is left alone for a while.

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
        self._named: dict[str, _Served] = {}
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
                    self._named[name] = self._serve(address, session, name, None)
        if self._pools and time.monotonic() >= self._pool_due:
            self._pool_due = time.monotonic() + POOL_PERIOD
            for pool in self._pools:
                self._look(*pool)
        try:
            self._round_robin.step(min(timeout, POOL_PERIOD) if self._pools else timeout)
        except NameTaken as error:
            served = self._served.get(error.server)
            if served is None or served.pool is None:
                raise
            with self._taken(error.server, served.pool):
                raise

    def _serve(self, address: ServerAddress, session: Session, name: str, pool: Pool | None) -> _Served:
        connection = self._connection(session, name, self._round_robin.wake)
        served = _Served(connection, self._worker(connection, address), pool)
        self._round_robin.add(served.worker)
        return served

    def _look(self, pool: Pool, address: ServerAddress, session: Session) -> None:
        """Begins to serve the servers that the pool wants served, and leaves others without losing a job."""
        sent = {}
        for name, one in self._of(pool):
            with self._taken(name, pool):
                one.worker.take_in(0.0)  # a job may have come during a long one of another server
                sent[name] = Sent(one.connection.counters.factors, one.worker.waiting > 0)
        wanted = pool.wanted(sent)
        for name in wanted.keys() - self._served.keys() - self._named.keys():
            with self._taken(name, pool):
                self._served[name] = self._serve(address, session, name, pool)
        for name, (connection, worker, _) in self._of(pool):
            if name in wanted:
                connection.share = wanted[name]
                if connection.leaving is not None:
                    connection.stay()
                continue
            connection.leave()
            since = time.monotonic() - (connection.leaving or 0.0)
            if worker.idle and since > LEAVE_TIME:
                self._leave(name)

    def _of(self, pool: Pool) -> list[tuple[str, _Served]]:
        return [(name, one) for name, one in self._served.items() if one.pool is pool]

    @contextlib.contextmanager
    def _taken(self, server: str, pool: Pool) -> Iterator[None]:
        """Leaves a server of a pool alone that has another worker of this name: its token may be forged."""
        try:
            yield
        except NameTaken as error:
            log.warning("%s; this one leaves that server alone for a while", error)
            pool.reject(server)
            if server in self._served:
                self._leave(server)

    def _leave(self, name: str) -> None:
        connection, worker, _ = self._served.pop(name)
        self._round_robin.remove(worker)
        connection.withdraw()
        self._left(connection)

    def close(self) -> None:
        """Ends heartbeats, then sessions."""
        for served in (*self._named.values(), *self._served.values()):
            served.connection.close()
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
