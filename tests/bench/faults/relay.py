# SPDX-License-Identifier: MIT
"""The inside of a cable between two network namespaces: a process that hands packets on, slowly or not at all.

    python -m tests.bench.faults.relay NAMESPACE NEAR FAR

Makes a device NEAR here and FAR in the namespace, says `ready`, and reads what the cable is like from lines of JSON:
is_cut and rate [bytes/s, 0: any], of each way. Ends with its input.
"""

import contextlib
import ctypes
import fcntl
import json
import os
import selectors
import struct
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
CLONE_NEWNET = 0x40000000
LONGEST = 1 << 16  # bytes of a packet at most
BACKLOG = 0.05  # s of packets that wait for a slow cable at most


def device(name: str) -> int:
    """A device of this namespace whose packets are read from and written to the file descriptor."""
    fd = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(fd, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI))
    return fd


@contextlib.contextmanager
def inside(namespace: str) -> Iterator[None]:
    """The calling thread is in a network namespace for a while."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/self/ns/net").open() as home, Path(f"/var/run/netns/{namespace}").open() as there:
        for file in (there, home):
            if libc.setns(file.fileno(), CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), f"no way into the network namespace {namespace}")
            if file is there:
                yield


class Way:
    """One direction."""

    def __init__(self, source: int, target: int):
        self.source, self._target = source, target
        self.under_way: deque[tuple[float, bytes]] = deque()
        self._free = 0.0  # when the last packet has left

    def take(self, is_cut: bool, rate: float) -> None:
        """Reads all packets that are there."""
        while True:
            try:
                packet = os.read(self.source, LONGEST)
            except (BlockingIOError, OSError):  # none; or the device is down
                return
            now = time.monotonic()
            begin = max(now, self._free)
            if is_cut or begin - now > BACKLOG:
                continue
            self._free = begin + (len(packet) / rate if rate else 0.0)
            self.under_way.append((self._free, packet))

    def give(self) -> float | None:
        """Writes those that have arrived; seconds until the next one does."""
        while self.under_way:
            due, packet = self.under_way[0]
            if (wait := due - time.monotonic()) > 0:
                return wait
            with contextlib.suppress(OSError):  # nobody there takes it: lost
                os.write(self._target, packet)
            self.under_way.popleft()
        return None


def relay(near: int, far: int) -> None:
    """Until the standard input ends."""
    ways = (Way(near, far), Way(far, near))
    like = {"is_cut": False, "rate": 0.0}
    selector = selectors.DefaultSelector()
    for way in ways:
        selector.register(way.source, selectors.EVENT_READ, way)
    selector.register(sys.stdin.fileno(), selectors.EVENT_READ)
    wait: float | None = None
    while True:
        for key, _ in selector.select(wait):
            if isinstance(key.data, Way):
                key.data.take(**like)
            elif line := sys.stdin.readline():
                like = json.loads(line)
            else:
                return
        waits = [w for way in ways if (w := way.give()) is not None]
        wait = min(waits) if waits else None


def main() -> None:
    namespace, here, there = sys.argv[1:]
    near = device(here)
    with inside(namespace):
        far = device(there)
    print("ready", flush=True)
    relay(near, far)


if __name__ == "__main__":
    main()
