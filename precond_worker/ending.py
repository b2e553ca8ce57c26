# SPDX-License-Identifier: MIT
"""Ends the worker with one line and code 1 when a thread fails: without it the worker would look alive."""

import os
import sys
import threading
from typing import Any, NoReturn

from protocol.process.exhausted import exhausted


def end_with_any_thread() -> None:
    """From now on the process ends when a thread ends by an exception, or cannot start for lack of memory."""
    threading.excepthook = _thread_failed
    sys.unraisablehook = _unraisable


def _thread_failed(failure: threading.ExceptHookArgs) -> None:
    if failure.exc_value is None or issubclass(failure.exc_type, SystemExit):
        return
    name = failure.thread.name if failure.thread is not None else "of an unknown name"
    why = exhausted(failure.exc_value) or f"{failure.exc_type.__name__}: {failure.exc_value}"
    end_now(f"thread {name} failed: {why}")


def _unraisable(failure: Any) -> None:
    if failure.exc_value is not None and exhausted(failure.exc_value):
        end_now(exhausted(failure.exc_value))
    sys.__unraisablehook__(failure)


def end_now(why: str) -> NoReturn:
    """Ends without closing anything, which may need memory; the server sees that the link is gone."""
    os.write(2, f"precond-worker: {' '.join(why.split())[:500]}; the worker ends\n".encode(errors="replace"))
    os._exit(1)
