# SPDX-License-Identifier: MIT
"""Starts, restarts and stops the process of `sim-server --web`: a client that serves a page for browsers."""

import logging
import os
import subprocess
import time
from collections.abc import Callable, Sequence
from typing import Any

from typer.core import TyperCommand

from protocol.network.web_address import HOST, PORT, shown, web_address
from protocol.process.own_python import own_module
from protocol.refused import Refused

log = logging.getLogger(__name__)

FIRST_PAUSE = 1.0  # s before the first restart; doubled each time
LASTED = 60.0  # s that a page runs before it counts as one that lasts
MOST_RESTARTS = 5  # of pages that did not last, one after the other
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
    """Keeps `sim-client web` running as long as `check` is called, and gives it up when it does not last.

    server, connect: name and endpoint of the server
    quiet: it says nothing on standard output
    options: more of sim-client web
    """

    def __init__(
        self, server: str, connect: str, host: str, port: int, quiet: bool = False, options: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic, start: Start | None = None,
    ):  # fmt: skip
        self._command = own_module(
            "clients", "web", "--exit-with-parent", "--parent", str(os.getpid()),
            "--server", server, "--connect", connect, "--host", host, "--port", str(port), *options,
        )  # fmt: skip
        output = subprocess.DEVNULL if quiet else None
        self._clock = clock
        self._start = start or (lambda command: subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output))
        self._restarts = 0  # since a page lasted
        self._due: float | None = None  # time of the next start
        self._began = clock()
        self.process: subprocess.Popen[bytes] | None = None  # None: it is to be started again, or given up
        self._launch()

    def check(self) -> None:
        """Restarts the page if it has ended, after a pause that doubles. Raises nothing."""
        if self.process is not None and self.process.poll() is not None:
            self._ended(f"the page ended with {self.process.returncode}")
        elif self._due is not None and self._clock() >= self._due:
            self._launch()

    def _launch(self) -> None:
        self._due, self._began = None, self._clock()
        try:
            self.process = self._start(self._command)
        except OSError as error:
            self._ended(f"the page cannot be started ({error})")

    def _ended(self, why: str) -> None:
        self.process, now = None, self._clock()
        if now - self._began >= LASTED:
            self._restarts = 0
        if self._restarts == MOST_RESTARTS:
            log.error("%s: it is not started again; sim-client web serves one too", why)
            return
        pause = FIRST_PAUSE * 2**self._restarts
        log.warning("%s: starting it again in %g s", why, pause)
        self._restarts, self._due = self._restarts + 1, now + pause

    def close(self) -> None:
        """Ends it by SIGTERM, and by SIGKILL if that does not help."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
