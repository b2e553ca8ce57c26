# SPDX-License-Identifier: MIT
"""The files of a log that is written in pieces: run.mcap, run.0002.mcap, run.0003.mcap and so on.

Each begins with the scene and the meshes as they are then, so that it can be read alone; the first one's name stands
for all of them. A piece knows its run, its number, how many messages at its start repeat earlier ones, and whether
messages between the piece before and itself are missing.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path


def piece_path(path: Path, number: int) -> Path:
    """Path of a piece of the log `path`; the first one is `path` itself."""
    return path if number == 1 else path.with_name(f"{path.stem}.{number:04d}{path.suffix}")


def later_pieces(path: Path) -> list[tuple[int, Path]]:
    """Numbers and paths of the pieces after the first that are there, in order."""
    form = re.compile(rf"{re.escape(path.stem)}\.(\d{{4,9}}){re.escape(path.suffix)}")
    try:
        names = os.listdir(path.parent)
    except OSError:
        return []
    found = ((int(match[1]), path.with_name(name)) for name in names if (match := form.fullmatch(name)))
    return sorted((number, piece) for number, piece in found if piece == piece_path(path, number) and number > 1)


def size_of_log(path: Path) -> int:
    """Bytes of all pieces of a log [bytes]; 0 if there is none."""
    return sum(size_of_file(piece) for piece in [path, *(piece for _, piece in later_pieces(path))])


def size_of_file(piece: Path) -> int:
    """Bytes of a piece [bytes]; 0 if it is no file, or was removed meanwhile to keep a budget."""
    try:
        found = piece.stat()
    except OSError:
        return 0
    return found.st_size if stat.S_ISREG(found.st_mode) else 0
