# SPDX-License-Identifier: MIT
"""Connections that never become a session: others get in beside them."""

import socket
from contextlib import ExitStack

import pytest

from protocol.network.endpoints import port_of
from protocol.network.session import open_session
from tests.ports import free_port

pytestmark = pytest.mark.system
IDLE = 400  # zenoh lets 100 wait by default, and refused all others until these had timed out


def test_they_keep_nobody_out() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session("server", listen=[endpoint], shared_memory=False), ExitStack() as closing:
        for _ in range(IDLE):
            where = ("127.0.0.1", port_of(endpoint))
            closing.enter_context(socket.create_connection(where, timeout=10.0))
        for _ in range(3):
            open_session("client", connect=[endpoint], shared_memory=False, timeout=1.0).close()
