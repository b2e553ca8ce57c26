# SPDX-License-Identifier: MIT
"""Exports a log to a file of another program, which the suffix names (docs/exports.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from clients.errors import BadInput, ClientError
from clients.export.arrays import write_csv, write_npz
from clients.export.vtu import write_vtu
from clients.log.reader import Log

FORMATS = (".npz", ".csv", ".vtu", ".vtkhdf", ".usdc", ".mp4", ".mcap")
OF_ONE = (".npz", ".csv", ".vtu")
"""Formats whose files hold one object each; those of the others hold all."""

Progress = Callable[[float], None]


def export(
    log: Log,
    name: str | None,
    to: Path,
    frame: str = "last",
    epoch: int | None = None,
    progress: Progress = lambda _: None,
) -> list[Path]:
    """Writes the records of object `name`, None: of all, in the format that the suffix of `to` says. Returns the files.

    Of several objects a format of OF_ONE has a file each, with the name of the object behind that of `to`.
    frame: "last", "all" or a frame number (negative from the end), for .vtu. epoch: for .npz, which has one mesh.
    progress: gets the number of frames written, of all objects.
    Raises BadInput for a bad name, suffix or frame, ClientError if the file cannot be written.
    """
    names = sorted(log.objects) if name is None else [log.object_log(name).name]
    if to.suffix not in FORMATS:
        raise BadInput(f"--to {to}: the suffix {to.suffix!r} is not one of {', '.join(FORMATS)}")
    if to.exists() and log.path.exists() and to.samefile(log.path):
        raise BadInput(f"--to {to}: this is the log itself; allowed: another file")
    if not names:
        raise BadInput(f"{log.path}: no object was recorded")
    try:
        if to.suffix in OF_ONE:
            return _one_by_one(log, names, to, frame, epoch, progress)
        return _together(log, names, to, progress)
    except OSError as error:
        raise ClientError(f"{to}: cannot be written: {error.strerror or error}") from None


def _one_by_one(
    log: Log, names: Sequence[str], to: Path, frame: str, epoch: int | None, progress: Progress
) -> list[Path]:
    written, before = [], 0
    for name in names:
        file = to if len(names) == 1 else to.with_name(f"{to.stem}_{name}{to.suffix}")

        def further(done: float, before: int = before) -> None:
            progress(before + done)

        if to.suffix == ".npz":
            write_npz(log, name, file, epoch, further)
            written.append(file)
        elif to.suffix == ".csv":
            write_csv(log, name, file)
            written.append(file)
        else:
            written += write_vtu(log, name, file, frame, further)
        before += len(log.object_log(name).frames)
    return written


def _together(log: Log, names: Sequence[str], to: Path, progress: Progress) -> list[Path]:
    if not any(log.object_log(name).frames for name in names):
        raise BadInput(f"{log.path}: no frames of {', '.join(names)} were recorded")
    if to.suffix == ".vtkhdf":
        from clients.export.vtkhdf import write_vtkhdf

        write_vtkhdf(log, names, to, progress)
    elif to.suffix == ".usdc":
        from clients.export.usd import write_usd

        write_usd(log, names, to, progress)
    elif to.suffix == ".mp4":
        from clients.export.mp4 import write_mp4

        write_mp4(log, names, to, progress)
    else:
        from clients.export.foxglove_file import write_foxglove

        return write_foxglove(log, names, to, progress)
    return [to]
