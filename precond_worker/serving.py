# SPDX-License-Identifier: MIT
"""What a worker process makes for each server that it works for, and what it says of them."""

import logging
import sys
from functools import partial
from threading import Event
from typing import TYPE_CHECKING, NamedTuple

from precond_worker.factorization.registry import make_factorization
from precond_worker.network.server_addresses import ServerAddress
from precond_worker.network.server_connection import ServerConnection
from precond_worker.worker import Worker
from protocol.access.roles import identity_in, own_name
from protocol.channels import check_name
from protocol.counters import Counters
from protocol.network.endpoints import given_endpoints
from protocol.network.identity import Identity, usual_identity
from protocol.network.session import Session

if TYPE_CHECKING:
    from precond_worker.metrics import WorkerMetrics
    from protocol.shared_memory.device_probe import OpenedMemory


class WorkerOptions(NamedTuple):
    """Values of the command line.

    connect: endpoints. servers: NAME[@EP] of each. library: of factorizations (cli.chosen_library)
    tls: folder of a certificate. metrics: HOST:PORT; None: not given
    """

    connect: list[str]
    threads: int
    name: str
    servers: list[str]
    shared_memory: bool
    library: str
    tls: str | None
    metrics: str | None


def identified(options: WorkerOptions) -> tuple[str, Identity | None]:
    """Returns the worker's name, which its certificate may prescribe, and the certificate; None: it has none.

    Raises ValueError (BadEndpoint or Refused).
    """
    own = [server.partition("@")[2] for server in options.servers if "@" in server]
    identity = usual_identity(options.tls, ("worker",), [*options.connect, *own] or given_endpoints())
    name = options.name
    if identity is not None and identity.role != "worker":
        text = f"the certificate {identity.name!r} was made for a {identity.role}"
        print(f"precond-worker: {text}: a server that has it as one gives it no jobs", file=sys.stderr, flush=True)
    if identity is not None and identity_in(name) != identity.name:
        name = own_name(identity.name, name[len(identity.name) - 63 :])  # its end tells workers apart
    check_name(name, "--name")
    return name, identity


class Serving:
    """Makes connections and workers for servers (main_loop.MainLoop).

    name: of this worker. title: of the library
    collected: metrics of the process; None: nobody wants them
    """

    def __init__(self, options: WorkerOptions, name: str, title: str, collected: "WorkerMetrics | None"):
        self._options, self._name, self._title, self._collected = options, name, title, collected

    def connection(self, session: Session, server: str, wake: Event) -> ServerConnection:
        """Connects to a server."""
        options, counters = self._options, Counters(logging.getLogger("precond_worker"))
        opened = opened_memory(options.library) if options.shared_memory else None
        made = ServerConnection(session, server, self._name, options.threads, self._title, counters, wake, opened)
        if self._collected is not None:
            self._collected.connections.append(made)
        return made

    def worker(self, connected: ServerConnection, address: ServerAddress) -> Worker:
        """Returns what does the jobs of a server."""
        analyse = partial(make_factorization, library=self._options.library)
        observe = (lambda seconds: None) if self._collected is None else self._collected.factorization.observe
        return Worker(connected, analyse, partial(self._tell, connected, address), observe)

    def left(self, connected: ServerConnection) -> None:
        """Says that a server is served no more."""
        print(f"precond-worker {self._name}: leaves server {connected.server}, others need it more", flush=True)
        if self._collected is not None:
            self._collected.connections.remove(connected)

    def _tell(self, connected: ServerConnection, address: ServerAddress, found: bool) -> None:
        """Says that a server is there, or is gone."""
        server, threads = f"server {connected.server} at {address}", self._options.threads
        if not found:
            print(f"precond-worker {self._name}: {server} is gone, waiting for it", file=sys.stderr, flush=True)
            return
        count = f"{threads} thread{'s' if threads > 1 else ''}"
        memory = "shared memory" if connected.shared_memory else "no shared memory"
        print(f"precond-worker {self._name} ready: {self._title}, {count}, {memory}, {server}", flush=True)


def opened_memory(library: str) -> "OpenedMemory | None":
    """Returns what opens device memory of servers; None: the library is one of the CPU."""
    if not library.startswith("gpu"):
        return None
    from precond_worker.gpu.opened_memory import OpenedDeviceMemory

    return OpenedDeviceMemory()
