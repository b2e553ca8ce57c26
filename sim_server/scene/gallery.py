# SPDX-License-Identifier: MIT
"""Scenes that come with the package: gallery/NAME. Each begins with a comment that says in a sentence what it is."""

from os.path import exists
from pathlib import Path

PREFIX = "gallery"
FOLDER = Path(__file__).resolve().parent.parent / PREFIX


def names() -> list[str]:
    """Returns the names of all scenes, in alphabetical order."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def found(path: Path) -> Path:
    """Returns the scene that `path` names: a file, or else gallery/NAME or gallery/NAME.toml of the package.

    What names neither is returned as it is.
    """
    if exists(path) or len(path.parts) != 2 or path.parts[0] != PREFIX or path.suffix not in ("", ".toml"):
        return path
    return FOLDER / f"{path.stem}.toml" if path.stem in names() else path


def sentence(name: str) -> str:
    """Returns what a scene is, from the first line of its file."""
    with (FOLDER / f"{name}.toml").open(encoding="utf-8") as file:
        return file.readline().lstrip("#").strip()


def known() -> str:
    """Returns the end of a message about a scene that is not there."""
    return f"scenes that come along: {', '.join(f'{PREFIX}/{name}' for name in names())} (sim-server --list)"
