# SPDX-License-Identifier: MIT
"""What the command lines of the programs have in common: the option --version, signals, messages and exit codes.

Exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from types import FrameType
from typing import Any, NoReturn

import typer

from protocol.process.exhausted import exhausted
from protocol.process.extras import missing_extra

_held: list[list[Callable[[], object]]] = []  # the signal that waits, or none yet; the innermost last
RETRY = 0.01  # s until a signal that came in the middle of an import is handled again


class Terminated(BaseException):
    """Raised on SIGTERM (end_in_order), to close what is open."""


@dataclass(frozen=True)
class Program:
    """A program by the name that its messages begin with."""

    name: str

    def version_option(self) -> Any:
        """Returns the option --version for typer: prints the version and ends."""

        def show(asked: bool) -> None:
            if asked:
                from protocol.process.version import version

                print(f"{self.name} {version()}")
                raise typer.Exit

        return typer.Option("--version", callback=show, is_eager=True, help="Say which version this is, and end")

    def bad_input(self, text: str) -> NoReturn:
        """Ends a command with code 2 and `text` on standard error."""
        print(f"{self.name}: {text}", file=sys.stderr)
        raise typer.Exit(2)

    def run(self, command: Callable[..., Any]) -> None:
        """Runs the command line; ends with code 130 after Ctrl-C, with a line and code 1 when a resource ran out
        or a package of an extra is missing."""
        try:
            command(prog_name=self.name)
        except SystemExit as ended:
            if ended.code == 130:
                leave()
            raise
        except BaseException as error:
            if not (text := exhausted(error) or missing_extra(error)):
                raise
            print(f"{self.name}: {text}", file=sys.stderr)
            sys.exit(1)


def end_in_order() -> None:
    """From now on Ctrl-C raises KeyboardInterrupt and SIGTERM raises Terminated, so that what is open is closed."""
    handle(signal.SIGINT, signal.default_int_handler)
    handle(signal.SIGTERM, _terminate)


def _terminate(*_: object) -> None:
    raise Terminated


def handle(number: signal.Signals, act: Callable[[int, FrameType | None], object]) -> None:
    """Handles a signal by `act`, which raises, though never in the middle of an import, nor where it is to wait
    (held_signals).

    There an exception may be swallowed or wrapped. A signal that a parent has its children ignore stays ignored.
    """

    def handler(number: int, frame: FrameType | None) -> None:
        if _importing(frame) and hasattr(signal, "setitimer"):  # Windows has none
            signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
            signal.setitimer(signal.ITIMER_REAL, RETRY)
        elif _held and not _held[-1]:
            _held[-1].append(partial(act, number, frame))
        else:
            act(number, frame)

    if signal.getsignal(number) is not signal.SIG_IGN:
        signal.signal(number, handler)


@contextlib.contextmanager
def held_signals() -> Iterator[Callable[[], bool]]:
    """Within it the first signal waits until the end: raised at whatever line is under way, it would leave half done
    what that does. What is returned says whether one waits. A second one acts at once, and an error comes first.

    In the main thread, which alone gets signals; elsewhere none waits.
    """
    waiting: list[Callable[[], object]] = []
    main = threading.current_thread() is threading.main_thread()
    if main:
        _held.append(waiting)
    try:
        yield lambda: bool(waiting)
    finally:
        if main:
            _held.pop()
    for act in waiting:
        act()


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def leave(code: int = 130) -> NoReturn:
    """Ends the process with this exit code, once everything is closed.

    After sys.exit, Python would end by SIGINT again if the first one came while it evaluated a string, as dataclasses
    and named tuples have it do at import.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
