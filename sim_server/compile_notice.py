# SPDX-License-Identifier: MIT
"""Tells people that kernels are being compiled, where they would wait without a word."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from sim_server.compiling import Compilers, Progress, compilers

Say = Callable[[str], None]


class Notice:
    """Says one line when compiling begins and one when it has ended; nothing if nothing is compiled.

    clock: monotonic time [s]. bar: opens what shows the progress between the two lines.
    """

    def __init__(
        self, say: Say, bar: Callable[[], Progress] | None = None, clock: Callable[[], float] = time.monotonic
    ):
        self._say, self._bar, self._clock = say, bar, clock
        self._begun = 0.0
        self._show: Progress | None = None
        self._most = 0

    def progress(self, done: int, total: int) -> None:
        """As Compilers.progress."""
        if not self._most:
            self._begun = self._clock()
            self._say("compiling kernels for this machine, once: less than a minute")
            self._show = self._bar() if self._bar else None
        if self._show is not None:
            self._show(done, total)
        self._most = max(self._most, total)

    def end(self) -> None:
        """Says how long it took."""
        if self._most:
            texts = f"{self._most} kernel text{'s' * (self._most > 1)}"
            self._say(f"compiled {texts} in {self._clock() - self._begun:.0f} s")


@contextmanager
def compiling_told(say: Say, by: Compilers = compilers) -> Iterator[None]:
    """Within, what is compiled is told; a bar on stderr, if that is a terminal, vanishes at the end."""
    with ExitStack() as closing:
        notice = Notice(say, (lambda: _bar(closing)) if sys.stderr.isatty() else None)
        by.progress = notice.progress
        try:
            yield
        finally:
            by.progress = None
    notice.end()


def _bar(closing: ExitStack) -> Progress:
    from rich.console import Console
    from rich.progress import Progress as Bar

    bar: Any = closing.enter_context(Bar(console=Console(stderr=True), transient=True))
    task = bar.add_task("compiling", total=None)
    return lambda done, total: bar.update(task, completed=done, total=total)
