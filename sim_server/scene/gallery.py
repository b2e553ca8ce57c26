# SPDX-License-Identifier: MIT
"""Scenes that come with the package: gallery/NAME. Each begins with a comment that says in a sentence what it is."""

from os.path import isfile
from pathlib import Path

PREFIX = "gallery"
FOLDER = Path(__file__).resolve().parent.parent / PREFIX


def names() -> list[str]:
    """Returns the names of all scenes, in alphabetical order; NAME.plan.toml, an overlay, is none."""
    return sorted(path.stem for path in FOLDER.glob("*.toml") if "." not in path.stem)


def found(path: Path) -> Path:
    """Returns the file of the scene that `path` names: gallery/NAME and gallery/NAME.toml are of the package, unless
    there is such a file in the working folder. Any other path is returned as it is.
    """
    if isfile(path) or len(path.parts) != 2 or path.parts[0] != PREFIX or path.suffix not in ("", ".toml"):
        return path
    if isfile(own := path.with_suffix(".toml")):
        return own
    return FOLDER / f"{path.stem}.toml" if path.stem in names() else path


def name_of(file: Path) -> Path:
    """Returns by which path a scene is asked for: gallery/NAME for one of the package, else its file."""
    return Path(PREFIX, file.stem) if file.parent == FOLDER and file.stem in names() else file


def sentence(name: str) -> str:
    """Returns what a scene is, from the first line of its file."""
    with (FOLDER / f"{name}.toml").open(encoding="utf-8") as file:
        return file.readline().lstrip("#").strip()


def known() -> str:
    """Returns the end of a message about a scene that is not there."""
    return f"scenes that come along: {', '.join(f'{PREFIX}/{name}' for name in names())} (sim-server --list)"
