# SPDX-License-Identifier: MIT
"""Command lines of further processes of ours."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]  # of all packages of ours


def own_module(module: str, *arguments: str) -> list[str]:
    """Returns the command that runs a module of ours in this Python.

    `python -m` looks for modules in the current folder first: a folder of the user's that is called protocol or clients
    would hide ours. It does not look there, unless that folder is the one that holds our packages.
    """
    safe = [] if Path.cwd() == ROOT else ["-P"]
    return [sys.executable, *safe, "-m", module, *arguments]
