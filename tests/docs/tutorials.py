# SPDX-License-Identifier: MIT
"""Does what a tutorial says, in a folder: writes its files, runs its commands with real processes.

A block of TOML or Python whose first line is `# NAME` is a file of that name. Blocks of `sh` are run in order, each to
its end; one whose first line is `# in a terminal of its own` goes on beside those that follow. Other blocks are output.
Servers listen on a port of the test.
"""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from clients.client import Client
from clients.errors import ClientError
from tests.docs.figures import DOCS, ROOT
from tests.ports import free_endpoint
from tests.system.link_helpers import PATIENCE

FOLDER = DOCS / "tutorials"
LONGEST = 600.0  # s that a command may take, on a machine ten times slower than others
APART = "# in a terminal of its own"
PROGRAMS = {
    "sim-client": '-m clients "$@"',
    "precond-worker": '-m precond_worker "$@"',
    "sim-server": '-m sim_server "$@" --listen {endpoint}',
    "python": '"$@"',
}


class Block(NamedTuple):
    """One fenced block: its language and text."""

    language: str
    text: str

    @property
    def file(self) -> str:
        """The file that it is, if it names one."""
        found = re.match(r"# ([\w.-]+\.(?:toml|py))$", self.text.partition("\n")[0])
        return found[1] if found else ""


class Advice(NamedTuple):
    """What a command says on a machine that is too slow for the page, and what its reader then writes instead."""

    said: str
    text: str
    instead: str


class Done(NamedTuple):
    """What running a tutorial left: its folder, and what its commands printed."""

    folder: Path
    output: str


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page, in order."""
    return [Block(*found) for found in re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)]


def page(name: str) -> list[Block]:
    """The blocks of docs/tutorials/NAME.md."""
    return blocks((FOLDER / f"{name}.md").read_text())


def run(name: str, folder: Path) -> Done:
    """Does all of docs/tutorials/NAME.md in a folder. Raises AssertionError for a command that fails."""
    return Reader(folder).read(page(name))


class Reader:
    """Somebody who does what a tutorial says."""

    def __init__(self, folder: Path, advice: Advice | None = None):
        self.folder, self.endpoint, self.advice = folder / "reader", free_endpoint(), advice
        self.folder.mkdir()
        self.apart: list[tuple[subprocess.Popen[bytes], Path]] = []
        bin_ = folder / "bin"
        bin_.mkdir()
        for name, arguments in PROGRAMS.items():
            script = f'#!/bin/sh\nexec "{sys.executable}" {arguments.format(endpoint=self.endpoint)}\n'
            (bin_ / name).write_text(script)
            (bin_ / name).chmod(0o755)
        self.environment = os.environ | {
            "PATH": f"{bin_}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "WARPFACTOR_CONNECT": self.endpoint,
        }

    def read(self, page: list[Block]) -> Done:
        """Does all blocks, then ends what still runs, as with Ctrl-C."""
        printed = ""
        try:
            for block in page:
                if block.file:
                    (self.folder / block.file).write_text(block.text)
                elif block.text.startswith(APART):
                    self._begin(block.text)
                elif block.language == "sh":
                    printed += self.command(block.text)
            self._end()
        finally:
            for process, _ in self.apart:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait(PATIENCE)
        return Done(self.folder, printed + "".join(log.read_text() for _, log in self.apart))

    def command(self, text: str) -> str:
        """Runs a command as a reader would, and returns what it printed. Raises AssertionError if it fails."""
        found = self._run(text)
        if found.returncode and self.advice is not None and self.advice.said in found.stderr:
            found = self._run(text.replace(self.advice.text, self.advice.instead))
        others = "".join(log.read_text() for _, log in self.apart)
        assert found.returncode == 0, f"{text}\n{found.stdout}{found.stderr}\n{others}"
        return found.stdout + found.stderr

    def _run(self, text: str) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            ["bash", "-euo", "pipefail", "-c", text],
            cwd=self.folder, env=self.environment, capture_output=True, text=True, timeout=LONGEST,
        )  # fmt: skip

    def _begin(self, text: str) -> None:
        """Starts a server or a worker, and waits until it is known."""
        before = self._workers()
        log = self.folder.parent / f"terminal-{len(self.apart)}.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                ["bash", "-euc", text], cwd=self.folder, env=self.environment,
                stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        self.apart.append((process, log))
        deadline = time.monotonic() + PATIENCE
        while self._workers() <= before:
            assert process.poll() is None and time.monotonic() < deadline, f"{text}\n{log.read_text()}"
            time.sleep(0.05)
        with Client(connect=[self.endpoint]) as client:  # a machine that is full takes longer than sim-client waits
            client.timeout = PATIENCE
            client.command("status")

    def _workers(self) -> int:
        """How many workers the server knows; -1 without a server."""
        try:
            with Client(connect=[self.endpoint], timeout=0.5) as client:
                return len(client.status().workers)
        except ClientError:
            return -1

    def _end(self) -> None:
        for process, log in self.apart:
            if "precond-worker" in process.args[-1]:  # type: ignore[operator,index]  # a list of words
                os.killpg(process.pid, signal.SIGINT)
            code = process.wait(PATIENCE)
            assert code in (0, 130), f"code {code}\n{log.read_text()}"
