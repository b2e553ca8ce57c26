# SPDX-License-Identifier: MIT
"""A network namespace at the end of a cable that can be cut, made to lose or to delay. Needs root."""

import os
import shutil
import subprocess
from types import TracebackType
from typing import Self

FAR = "wf-far"  # namespace, and the device in it
NEAR = "wf-near"  # device on this side
ADDRESS = "10.231.7.1"  # of this side


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
        self.close()
        try:
            command("ip", "netns", "add", FAR)
            command("ip", "link", "add", NEAR, "type", "veth", "peer", "name", FAR, "netns", FAR)
            command("ip", "addr", "add", f"{ADDRESS}/24", "dev", NEAR)
            command("ip", "link", "set", NEAR, "up")
            for words in (("addr", "add", "10.231.7.2/24", "dev", FAR), ("link", "set", FAR, "up")):
                command("ip", "-n", FAR, *words)
        except Unavailable:
            self.close()
            raise
        return self

    def cut(self, is_cut: bool) -> None:
        """No packet passes; or all do again."""
        command("ip", "-n", FAR, "link", "set", FAR, "down" if is_cut else "up")

    def lose(self, percent: int) -> None:
        """So many of a hundred packets in either direction; raises Unavailable where there is no nft."""
        if not shutil.which("nft"):
            raise Unavailable("nft is not installed")
        drop = f"numgen random mod 100 < {percent} drop"
        text = "add table ip wf; "
        for hook in ("input", "output"):
            text += f"add chain ip wf {hook} {{ type filter hook {hook} priority 0; }}; add rule ip wf {hook} {drop}; "
        command(*self.far, "nft", text)

    def delay(self, milliseconds: int) -> None:
        """Each way; raises Unavailable where the kernel has no netem."""
        netem = ("root", "netem", "delay", f"{milliseconds}ms")
        command("tc", "qdisc", "replace", "dev", NEAR, *netem)
        command(*self.far, "tc", "qdisc", "replace", "dev", FAR, *netem)

    def pace(self, megabits: int) -> None:
        """At most so many a second each way; raises Unavailable where the kernel has no token bucket."""
        bucket = ("root", "tbf", "rate", f"{megabits}mbit", "burst", "256kb", "latency", "50ms")
        command("tc", "qdisc", "replace", "dev", NEAR, *bucket)
        command(*self.far, "tc", "qdisc", "replace", "dev", FAR, *bucket)

    def mend(self) -> None:
        """No loss and no delay any more."""
        for words in (
            ("tc", "qdisc", "del", "dev", NEAR, "root"),
            (*self.far, "tc", "qdisc", "del", "dev", FAR, "root"),
            (*self.far, "nft", "delete table ip wf"),
        ):
            if shutil.which(words[0]):
                subprocess.run(words, capture_output=True)

    def close(self) -> None:
        """The namespace goes, and the cable with it."""
        if shutil.which("ip"):
            for words in (("netns", "del", FAR), ("link", "del", NEAR)):
                subprocess.run(["ip", *words], capture_output=True)

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()
