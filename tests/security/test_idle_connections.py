# SPDX-License-Identifier: MIT
"""Connections that never become a session: others get in beside them."""

import os
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest

from protocol.network.endpoints import port_of
from protocol.network.identity import identity_of
from protocol.network.session import open_session
from tests.ports import free_endpoint
from tests.system.server_process import run

pytestmark = pytest.mark.system
IDLE = 400  # zenoh lets 100 wait by default, and refused all others until these had timed out


def test_they_keep_nobody_out() -> None:
    endpoint = free_endpoint()
    with open_session("server", listen=[endpoint], shared_memory=False), ExitStack() as closing:
        for _ in range(IDLE):
            where = ("127.0.0.1", port_of(endpoint))
            closing.enter_context(socket.create_connection(where, timeout=10.0))
        for _ in range(3):
            open_session("client", connect=[endpoint], shared_memory=False, timeout=1.0).close()


def test_handshakes_that_fail_at_one_endpoint_keep_nobody_out_at_another(tmp_path: Path) -> None:
    """At their own they do: zenoh takes no other connection for 0.1 s after each."""
    assert run("sim_server", "certs", str(tmp_path), "--host", "localhost").returncode == 0
    public, own = (free_endpoint(protocol="tls") for _ in "ab")
    server, client = (identity_of(tmp_path / name, ()) for name in ("server", "operator"))
    with open_session("server", listen=[public, own], shared_memory=False, tls=server), ExitStack() as closing:
        for _ in range(IDLE):
            where = ("127.0.0.1", port_of(public))
            closing.enter_context(socket.create_connection(where, timeout=10.0)).sendall(os.urandom(500))
        for _ in range(3):
            open_session("client", connect=[own], shared_memory=False, timeout=10.0, tls=client).close()
