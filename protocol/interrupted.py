# SPDX-License-Identifier: MIT
"""How a program ends in good order, when it is interrupted or has run out of something."""

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

from protocol.exhausted import exhausted

AGAIN = 0.01  # s until a signal that came in the middle of an import is looked at again


def handle(number: signal.Signals, act: Callable[[int, FrameType | None], object]) -> None:
    """Lets `act`, which raises, handle a signal, though never in the middle of an import: there an exception may be
    swallowed or wrapped. A signal that a parent has its children ignore stays ignored."""

    def handler(number: int, frame: FrameType | None) -> None:
        if _importing(frame):
            signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        else:
            act(number, frame)

    if signal.getsignal(number) is not signal.SIG_IGN:
        signal.signal(number, handler)


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


def run_command(command: Callable[..., Any], name: str) -> None:
    """Run the command line `name`; end with code 130 after Ctrl-C, with a line and code 1 when something ran out."""
    try:
        command(prog_name=name)
    except SystemExit as ended:
        if ended.code == 130:
            leave()
        raise
    except BaseException as error:
        if not (text := exhausted(error)):
            raise
        print(f"{name}: {text}", file=sys.stderr)
        sys.exit(1)
