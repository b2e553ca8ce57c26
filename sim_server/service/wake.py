# SPDX-License-Identifier: MIT
"""Wakes the thread that serves the loop when something is there that it waits for."""

import contextlib
import os
import select
import time
import weakref


class Wake:
    """An event that any thread sets, native ones by writing to its descriptor, and one thread waits for.

    fd: eventfd; closed once nobody refers to this object
    """

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        weakref.finalize(self, os.close, self.fd)
        self._poll = select.poll()
        self._poll.register(self.fd, select.POLLIN)

    def set(self) -> None:
        """Ends the wait under way, or else the next one at once."""
        with contextlib.suppress(BlockingIOError):  # it has been set 2^64 - 2 times
            os.eventfd_write(self.fd, 1)

    def wait(self, seconds: float) -> bool:
        """Waits until it is set, `seconds` at most, rounded up to milliseconds; True if it was."""
        if not self._poll.poll(1e3 * seconds):
            return False
        os.eventfd_read(self.fd)
        return True

    def rest(self, begin: float, most: float) -> None:
        """Waits likewise after work that began at `begin` [s, monotonic], and about as long as that took at least,
        however often it is set: half of the time is kept for other threads. most: [s]"""
        due = 2 * (end := time.monotonic()) - begin
        if self.wait(most) and (left := min(due, end + most) - time.monotonic()) > 0:
            time.sleep(left)
