# SPDX-License-Identifier: MIT
"""A zenoh session that connects to given endpoints only, reports clearly why it cannot, and is always closed."""

import json
import logging
import os
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Literal, Self

import zenoh

from protocol.channels import everything
from protocol.network.endpoints import BadEndpoint, check_endpoint, default_endpoint, usual_endpoints
from protocol.network.hosts import unknown_hosts
from protocol.network.identity import AUTHORITY, CERTIFICATE, KEY, Identity
from protocol.network.refusals import why_refused
from protocol.shared_memory import limits as shm_limits

log = logging.getLogger(__name__)

LINK_LEASE = 2000  # ms without a keep-alive after which a link is considered dead
ACCEPT_TIMEOUT = 3000  # ms that a connection may take to become a session
ACCEPT_PENDING = 4096  # connections that are no session yet; beyond that new ones wait
EXTRA_CONFIG = "WARPFACTOR_ZENOH_CONFIG"  # JSON5 file: certificates, users, access control


class ConnectionFailed(Exception):
    """No session could be opened; the text says where and why."""


class UnknownHost(ConnectionFailed):
    """A host name of an endpoint does not resolve."""


class ConnectionRefused(ConnectionFailed):
    """Somebody listens there, but one side does not accept the other: no TLS, or certificates that do not fit."""


class AddressInUse(ConnectionFailed):
    """Another process listens there."""


def open_session(
    role: Literal["server", "client"],
    *,
    listen: Sequence[str] | None = None,
    connect: Sequence[str] | None = None,
    shared_memory: bool = True,
    timeout: float = 2.0,
    name: str | None = None,
    tls: Identity | None = None,
    access: Mapping[str, Any] | None = None,
) -> "Session":
    """Opens a session: a server listens and routes messages between clients, a client connects.

    listen (server) and connect (client, unless WARPFACTOR_CONNECT is set) default to loopback, port 7447. timeout:
    seconds a client tries to connect. name: of the server; messages to it do not wait for other
    receivers. tls: certificate with which it shows itself, and the authority of those that it accepts. access: rules
    by certificate, as zenoh has them.
    Raises BadEndpoint or ConnectionFailed.
    """
    server = role == "server"
    certified = tls is not None
    listening = [default_endpoint(certified)] if server and listen is None else list(listen or [])
    connecting = list(connect or []) or ([] if server else usual_endpoints(certified))
    for endpoint in listening:
        check_endpoint(endpoint, listen=True, certified=certified)
    for endpoint in connecting:
        check_endpoint(endpoint, certified=certified)
    shared_memory = shared_memory and _shared_memory_works()
    try:
        if server or len(connecting) == 1:
            config = _config(server, listening, connecting, shared_memory, timeout, tls)
            if name is not None:
                _never_wait_for_others(config, name)
            if access is not None:
                config.insert_json5("access_control", json.dumps(access))
            return Session(zenoh.open(config), shared_memory)
        return Session(_open_first(connecting, shared_memory, timeout, tls), shared_memory)
    except zenoh.ZError as error:
        where = f"listen on {', '.join(listening)}" if server else f"connect to {', '.join(connecting)}"
        if unknown := unknown_hosts(listening if server else connecting):
            names = ", ".join(repr(name) for name in unknown)
            raise UnknownHost(f"cannot {where}: the name {names} does not resolve") from error
        taken = server and ("in use" in str(error) or "acquire lock" in str(error))  # of a port, of a socket file
        if not server and (why := why_refused(connecting, tls)):
            raise ConnectionRefused(f"cannot {where}: {why}") from error
        failure = AddressInUse if taken else ConnectionFailed
        raise failure(f"cannot {where}: {_reason(error)}") from error


def _open_first(connect: list[str], shared_memory: bool, timeout: float, tls: Identity | None) -> zenoh.Session:
    """Tries all endpoints in turn until one answers; with a time-out zenoh would try the first one only."""
    end = time.monotonic() + timeout
    while True:
        try:
            return zenoh.open(_config(False, [], connect, shared_memory, 0, tls))
        except zenoh.ZError:
            if time.monotonic() >= end:
                raise
            time.sleep(0.1)


def _shared_memory_works() -> bool:
    obstacle = shm_limits.obstacle()
    if obstacle:
        _warn_once(f"shared memory is off, arrays travel as bytes, which is slower for large bodies: {obstacle}")
    return not obstacle


@cache
def _warn_once(text: str) -> None:
    log.warning(text)


def _config(
    server: bool, listen: list[str], connect: list[str], shared_memory: bool, timeout: float, tls: Identity | None
) -> zenoh.Config:  # fmt: skip
    extra = os.environ.get(EXTRA_CONFIG)
    try:
        config = zenoh.Config.from_file(extra) if extra else zenoh.Config()
    except zenoh.ZError as error:
        raise BadEndpoint(f"{EXTRA_CONFIG}={extra} cannot be used: {_reason(error)}") from error
    settings: dict[str, Any] = {
        # A router passes messages on between its clients, so that no router process is needed. Where one is, the server
        # is a peer of it: among routers that come and go, declarations get lost (seen with zenoh 1.10.2).
        "mode": ("peer" if connect else "router") if server else "client",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": -1 if server else int(timeout * 1000),
        "connect/exit_on_failure": not server,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "adminspace/enabled": False,
        "transport/link/tx/lease": LINK_LEASE,
        "transport/unicast/accept_timeout": ACCEPT_TIMEOUT,
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/shared_memory/enabled": shared_memory,
        # Only the server's slots use shared memory. An implicit pool in each worker would stay mapped and locked
        # in the server for every worker that ever lived (eclipse-zenoh/zenoh issue 2787).
        "transport/shared_memory/transport_optimization/enabled": False,
    }
    if tls is not None:
        settings["transport/link/tls"] = _certificates(tls)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _certificates(tls: Identity) -> dict[str, Any]:
    """Returns zenoh's settings of TLS: both sides show a certificate, and a link ends when that of one expires."""
    own, private = tls.file(CERTIFICATE), tls.file(KEY)
    return {
        "root_ca_certificate": tls.file(AUTHORITY),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "listen_certificate": own,
        "listen_private_key": private,
        "connect_certificate": own,
        "connect_private_key": private,
    }


def _never_wait_for_others(config: zenoh.Config, name: str) -> None:
    """Drops patterns and factors to other subscribers than the server when those do not keep up.

    Workers send them so that they wait for the receiver. A subscriber of all keys that stops reading would block the
    receiving thread for all. They have a queue of their own, as a waiting message locks the queue of its priority.
    """
    rule = {
        "messages": ["put"],
        "flows": ["ingress"],
        "key_exprs": [everything(name)],
        "qos": {"congestion_control": "block"},
        "overwrite": {"congestion_control": "drop", "priority": "background"},
    }
    rules = json.loads(config.get_json("qos/network")) or []
    config.insert_json5("qos/network", json.dumps([*rules, rule]))
    queue = "transport/link/tx/queue"
    config.insert_json5(f"{queue}/size/background", "16")  # batches of 64 KiB, made as they are needed
    for wait, microseconds in (("wait_before_drop", 5000), ("max_wait_before_drop_fragments", 250_000)):
        config.insert_json5(f"{queue}/congestion_control/drop/{wait}", str(microseconds))


def _reason(error: Exception) -> str:
    text = re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error)).strip()
    return "no answer" if "Unable to connect" in text else text


class Session:
    """zenoh: the open session. shared_memory: whether it may use shared memory. A context manager.

    A process whose zenoh threads still run when the interpreter ends hangs or aborts. So a guardian thread closes the
    session when the main thread ends without having done so.
    """

    def __init__(self, session: zenoh.Session, shared_memory: bool):
        self.zenoh = session
        self.shared_memory = shared_memory
        self._closed = threading.Event()
        self._closing = threading.Lock()
        self._threads: list[threading.Thread] = []
        threading.Thread(target=self._guard, name="session-guardian", daemon=False).start()

    def _guard(self) -> None:
        while threading.main_thread().is_alive():
            if self._closed.wait(0.25):
                return
        self.close()

    def thread(self, name: str, run: Callable[[], None]) -> None:
        """Starts a thread that receives from this session, and so ends (by a ZError) when the session closes.

        close() waits for it: a thread inside zenoh when the interpreter ends aborts the process.
        """
        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)

    def close(self) -> None:
        """Closes the session and waits for its threads; a second call does nothing."""
        with self._closing:
            if self._closed.is_set():
                return
            try:
                self.zenoh.close()
            except zenoh.ZError as error:
                log.warning("the session did not close cleanly: %s", _reason(error))
            for thread in self._threads:
                if thread is not threading.current_thread():
                    thread.join(5.0)
            self._closed.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
