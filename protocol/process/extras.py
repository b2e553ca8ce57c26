# SPDX-License-Identifier: MIT
"""The commands that install the optional parts of this package, which is on no index."""

import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

CHECKOUT = Path(__file__).parents[2]


def to_install(extra: str) -> str:
    """Returns the command that installs an extra of pyproject.toml ("cholmod", "gpu", "view") for this Python."""
    checkout = (CHECKOUT / "pyproject.toml").is_file()
    wanted = ["-e", f"{CHECKOUT}[{extra}]"] if checkout else _requirements(extra)
    return shlex.join([sys.executable, "-m", "pip", "install", *wanted])


def _requirements(extra: str) -> list[str]:
    """Returns the packages of an extra according to the installed package."""
    try:
        listed = requires("warpfactor") or []
    except PackageNotFoundError:
        return []
    found = (line.split(";") for line in listed)
    return [name.strip() for name, *condition in found if f'extra == "{extra}"' in "".join(condition).replace("'", '"')]
