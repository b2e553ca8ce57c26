# SPDX-License-Identifier: MIT
"""Materials by name: one TOML file each with law, constants, density, range, source and published curve.

Servers and clients read the same files. `low` and `high` are in a file where a source says them; `typical` is in each.
"""

import tomllib
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
PLACES = ("low", "typical", "high")


def names() -> list[str]:
    """Returns the names of all materials, in alphabetical order."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(name: str) -> dict[str, Any]:
    """Returns the file of a material as tables of TOML; the name is one of `names`."""
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
