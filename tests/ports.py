# SPDX-License-Identifier: MIT
"""Ports of the loopback address for processes that tests start."""

import itertools
import os
import socket

# Below those that Linux deals out by itself (32768 and up): between the choice and the process that listens nobody who
# asks for any port is given this one. Another process of tests begins elsewhere.
FIRST, COUNT = 16_000, 16_000
_next = itertools.count(os.getpid() * 2017)


def free_port() -> int:
    """One that nobody listens on and that this process has not chosen lately."""
    for number in itertools.islice(_next, COUNT):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", FIRST + number % COUNT))
            except OSError:
                continue
            return FIRST + number % COUNT
    raise OSError(f"no free port from {FIRST} to {FIRST + COUNT - 1}")


def free_endpoint(host: str = "127.0.0.1", protocol: str = "tcp") -> str:
    """An endpoint of such a port."""
    return f"{protocol}/{host}:{free_port()}"
