# SPDX-License-Identifier: MIT
"""Starts, restarts and stops the process of `sim-server --web`: a client that serves a page for browsers."""

import logging
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from typer.core import TyperCommand

from protocol.network.web_address import HOST, PORT, shown, web_address
from protocol.refused import Refused

log = logging.getLogger(__name__)

FIRST_PAUSE = 1.0  # s before the first restart; doubled each time
LONGEST_PAUSE = 60.0  # s
PATIENCE = 2.0  # s for its end


class WebCommand(TyperCommand):
    """A command whose option --web may stand without a value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Gives --web its default where no HOST:PORT follows, then parses as typer does."""
        filled: list[str] = []
        for number, word in enumerate(args, start=1):
            filled.append(word)
            if word == "--web" and not (number < len(args) and _is_address(args[number])):
                filled.append(shown(HOST, PORT))
        return super().parse_args(ctx, filled)


def _is_address(word: str) -> bool:
    try:
        web_address(word)
    except Refused:
        return ":" in word and not word.startswith("-")  # to be refused by name, not taken for the scene
    return True


Start = Callable[[Sequence[str]], "subprocess.Popen[bytes]"]


class WebPage:
    """Keeps `sim-client web` running as long as `check` is called.

    server, connect: name and endpoint of the server
    quiet: it says nothing on standard output
    """

    def __init__(
        self, server: str, connect: str, host: str, port: int, quiet: bool = False,
        clock: Callable[[], float] = time.monotonic, start: Start | None = None,
    ):  # fmt: skip
        self._command = [
            sys.executable, "-m", "clients", "web", "--exit-with-parent", "--server", server, "--connect", connect,
            "--host", host, "--port", str(port),
        ]  # fmt: skip
        output = subprocess.DEVNULL if quiet else None
        self._clock = clock
        self._start = start or (lambda command: subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output))
        self._pause, self._due = FIRST_PAUSE, 0.0
        self.process = self._start(self._command)

    def check(self) -> None:
        """Restarts the page if it has ended, after a pause that doubles."""
        if self.process.poll() is None:
            return
        now = self._clock()
        if self._due == 0.0:
            self._due = now + self._pause
            log.warning("the page ended with %s: starting it again in %g s", self.process.returncode, self._pause)
            self._pause = min(2 * self._pause, LONGEST_PAUSE)
        elif now >= self._due:
            self._due = 0.0
            self.process = self._start(self._command)

    def close(self) -> None:
        """Ends it by SIGTERM, and by SIGKILL if that does not help."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
