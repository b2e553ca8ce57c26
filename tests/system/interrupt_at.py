# SPDX-License-Identifier: MIT
"""Runs one of our programs, which gets a signal while it imports a module: interrupt_at.py SIGNAL MODULE PACKAGE …"""

import os
import runpy
import signal
import sys


class Trap:
    """Looks for a module before anybody else does, and sends the signal from there."""

    def __init__(self, module: str, number: signal.Signals):
        self.module, self.number = module, number

    def find_spec(self, name: str, *_: object) -> None:
        if name == self.module:
            sys.meta_path.remove(self)  # type: ignore[arg-type]
            os.kill(os.getpid(), self.number)


if __name__ == "__main__":
    sys.meta_path.insert(0, Trap(sys.argv[2], signal.Signals[sys.argv[1]]))  # type: ignore[arg-type]
    sys.argv = sys.argv[3:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
