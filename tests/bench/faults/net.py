# SPDX-License-Identifier: MIT
"""A network namespace at the end of a cable that can be cut or made slow. Needs root.

The cable is a process of ours between two tun devices (relay.py): it wants nothing of the kernel but these.
"""

import json
import os
import shutil
import subprocess
import sys
from types import TracebackType
from typing import Self

FAR = "wf-far"  # namespace, and the device in it
NEAR = "wf-near"  # device on this side
ADDRESS = "10.231.7.1"  # of this side
THERE = "10.231.7.2"
MTU = 9000  # bytes


class Unavailable(Exception):
    """The text says what is missing here."""


def command(*words: str) -> None:
    """Runs a tool of the system; raises Unavailable with what it said."""
    if not shutil.which(words[0]):
        raise Unavailable(f"{words[0]} is not installed")
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        raise Unavailable(f"{' '.join(words)}: {done.stderr.strip() or done.returncode}")


class Cable:
    """far: words before a command that is to run at the other end, where ADDRESS is this one."""

    far = ("ip", "netns", "exec", FAR)

    def __enter__(self) -> Self:
        if os.geteuid() != 0:
            raise Unavailable("network namespaces need root")
        self._relay: subprocess.Popen[str] | None = None
        self.close()
        try:
            command("ip", "netns", "add", FAR)
            self._begin()
            for words, address, name in (((), ADDRESS, NEAR), (("-n", FAR), THERE, FAR)):
                command("ip", *words, "addr", "add", f"{address}/24", "dev", name)
                command("ip", *words, "link", "set", name, "mtu", str(MTU), "up")
        except Unavailable:
            self.close()
            raise
        return self

    def _begin(self) -> None:
        words = [sys.executable, "-m", "tests.bench.faults.relay", FAR, NEAR, FAR]
        pipe = subprocess.PIPE
        self._relay = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        assert self._relay.stdout is not None
        if self._relay.stdout.readline() != "ready\n":
            said = self._relay.communicate()[1].strip().splitlines()
            raise Unavailable(f"no tun device: {said[-1] if said else 'no message'}")

    def _is_like(self, is_cut: bool = False, rate: float = 0.0) -> None:
        assert self._relay is not None and self._relay.stdin is not None
        self._relay.stdin.write(json.dumps({"is_cut": is_cut, "rate": rate}) + "\n")
        self._relay.stdin.flush()

    def cut(self, is_cut: bool) -> None:
        """No packet passes; or all do again."""
        self._is_like(is_cut=is_cut)

    def pace(self, megabits: int) -> None:
        """At most so many a second each way."""
        self._is_like(rate=megabits * 1e6 / 8)

    def close(self) -> None:
        """The namespace goes, and the cable with it."""
        if self._relay is not None:
            self._relay.kill()
            self._relay.communicate()
            self._relay = None
        if shutil.which("ip"):
            subprocess.run(["ip", "netns", "del", FAR], capture_output=True)

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()
