# SPDX-License-Identifier: MIT
"""Signals before a program has anything to close. Imports the standard library alone, so that it can come first."""

import os
import signal


def end_at_once(terminated: int) -> None:
    """Ends the process on Ctrl-C with code 130 and on SIGTERM with code `terminated`, without a traceback.

    Also in the middle of an import, until the program sets handlers of its own (command_line.handle). A Ctrl-C that a
    parent has its children ignore stays ignored.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    signal.signal(signal.SIGTERM, lambda *_: os._exit(terminated))
