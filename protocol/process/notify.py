# SPDX-License-Identifier: MIT
"""Tells systemd that a service is ready, that it goes on, and that it ends: the protocol of sd_notify(3).

A datagram of lines VARIABLE=VALUE goes to the socket that NOTIFY_SOCKET names; elsewhere all of this does nothing.
"""

import contextlib
import os
import socket
import time
from collections.abc import Callable

FEEDINGS = 4  # of the watchdog within its period


class Notifier:
    """Where the service manager of this process listens. watchdog: its period [s]; 0: there is none"""

    def __init__(self, address: str = "", watchdog: float = 0.0, clock: Callable[[], float] = time.monotonic):
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog, self._clock = watchdog, clock
        self._fed = float("-inf")

    @classmethod
    def of_environment(cls) -> "Notifier":
        """Takes the variables of systemd out of the environment, so that no child speaks for this process."""
        address, period = os.environ.pop("NOTIFY_SOCKET", ""), os.environ.pop("WATCHDOG_USEC", "")
        ours = os.environ.pop("WATCHDOG_PID", "") in ("", str(os.getpid()))
        return cls(address, int(period) / 1e6 if ours and period.isascii() and period.isdigit() else 0.0)

    def ready(self, status: str) -> None:
        """Says that the service is up. status: one line for `systemctl status`"""
        self._send(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        """Changes the line of `systemctl status`."""
        self._send(f"STATUS={status}")

    def stopping(self) -> None:
        """Says that the service ends."""
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feeds the watchdog, a few times in its period however often this is called."""
        if self.watchdog and self._clock() - self._fed >= self.watchdog / FEEDINGS:
            self._fed = self._clock()
            self._send("WATCHDOG=1")

    def _send(self, text: str) -> None:
        """Does not wait: a message that finds the socket full, or gone, is lost."""
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as s:
            s.setblocking(False)
            s.sendto(text.encode(), self._address)
