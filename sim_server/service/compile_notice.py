# SPDX-License-Identifier: MIT
"""Reports on the terminal that kernels are being compiled, which may take a minute."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from sim_server.backends.build_pool import Compilers, Progress, compilers

Say = Callable[[str], None]


class CompileNotice:
    """Reports one line when compiling begins and one when it has ended; nothing if nothing is compiled.

    say: prints a line
    bar: opens a progress bar, which closes with the stack
    clock: monotonic time [s]
    """

    def __init__(
        self, say: Say, bar: Callable[[ExitStack], Progress] | None = None, clock: Callable[[], float] = time.monotonic
    ):
        self._say, self._bar, self._clock = say, bar, clock
        self._begun: float | None = None
        self._ended, self._count = 0.0, 0
        self._show: Progress | None = None
        self._closing = ExitStack()

    def progress(self, done: int, total: int) -> None:
        """Updates the progress; called by Compilers with the number of texts done and in all."""
        if self._begun is None:
            self._begun, self._count = self._clock(), 0
            self._say("compiling kernels for this machine, once: less than a minute")
            self._show = self._bar(self._closing) if self._bar else None
        if self._show is not None:
            self._show(done, total)
        self._ended, self._count = self._clock(), max(self._count, done, total)
        if done == total:
            self.end()

    def end(self) -> None:
        """Reports how long it took, unless that was done."""
        self.close()
        if self._begun is not None:
            texts = f"{self._count} kernel text{'s' * (self._count > 1)}"
            self._say(f"compiled {texts} in {self._ended - self._begun:.0f} s")
            self._begun = None

    def close(self) -> None:
        """Removes the bar."""
        self._closing.close()


@contextmanager
def compile_notices(say: Say, by: Compilers = compilers) -> Iterator[None]:
    """Context in which compiling is reported, with a bar on stderr if that is a terminal."""
    notice = CompileNotice(say, _bar if sys.stderr.isatty() else None)
    by.progress = notice.progress
    try:
        yield
        notice.end()
    finally:
        by.progress = None
        notice.close()


def _bar(closing: ExitStack) -> Progress:
    from rich.console import Console
    from rich.progress import Progress as Bar

    bar: Any = closing.enter_context(Bar(console=Console(stderr=True), transient=True))
    task = bar.add_task("compiling", total=None)
    return lambda done, total: bar.update(task, completed=done, total=total or None)
