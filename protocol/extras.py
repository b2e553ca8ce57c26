# SPDX-License-Identifier: MIT
"""How the optional parts of this package are installed, in a command that works here: it is on no index."""

import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

CHECKOUT = Path(__file__).parent.parent


def to_install(extra: str) -> str:
    """The command that installs an extra of pyproject.toml ("cholmod", "gpu", "view") for the Python that runs."""
    checkout = (CHECKOUT / "pyproject.toml").is_file()
    wanted = ["-e", f"{CHECKOUT}[{extra}]"] if checkout else _requirements(extra)
    return shlex.join([sys.executable, "-m", "pip", "install", *wanted])


def _requirements(extra: str) -> list[str]:
    """The packages of the extra, as the installed package has them."""
    try:
        listed = requires("warpfactor") or []
    except PackageNotFoundError:
        return []
    found = (line.split(";") for line in listed)
    return [name.strip() for name, *condition in found if f'extra == "{extra}"' in "".join(condition).replace("'", '"')]
