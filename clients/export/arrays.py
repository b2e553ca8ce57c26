# SPDX-License-Identifier: MIT
"""Exports an object of a log as .npz (frames and scalars) or .csv (scalars per step)."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.errors import BadInput
from clients.log.atomic_file import atomic_file
from clients.log.frames import Mesh
from clients.log.reader import Log


def write_npz(
    log: Log, name: str, to: Path, epoch: int | None = None, progress: Callable[[int], None] = lambda _: None
) -> None:
    """Writes step (k,), time (k,) [s], x (k, n, 3) [m], v (k, n, 3) [m/s], tets (m, 4) and scalars/NAME.

    Frames are streamed into the archive, so that a log larger than memory can be exported.
    """
    chosen = _frames_of_epoch(log, name, epoch)
    mesh = _uncut(log.mesh(name, chosen[0][1])) if chosen else None
    k, n = len(chosen), len(mesh.rest) if mesh else 0
    with atomic_file(to) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        times = np.empty(k)

        def positions() -> Iterator[NDArray]:
            for row, (index, _) in enumerate(chosen):
                found = log.frame(name, index)
                times[row] = found.time
                progress(row)
                yield found.x

        _stream(archive, "x", (k, n, 3), positions())
        _stream(archive, "v", (k, n, 3), (log.frame(name, index).v for index, _ in chosen))
        _add(archive, "time", times)
        _add(archive, "step", np.array([log.object_log(name).frames[index][0] for index, _ in chosen], np.int64))
        _add(archive, "tets", mesh.tets if mesh else np.empty((0, 4), np.int32))
        if mesh and any(log.uncut(name, e) != e for e in {e for _, e in chosen}):
            _add(archive, "removed_step", _removed_steps(log, name, mesh, chosen))
        for scalar, values in log.scalars(name).items():
            _add(archive, f"scalars/{scalar}", values)


def write_csv(log: Log, name: str, to: Path) -> None:
    """Writes a row per step and a column per scalar; floats in the shortest form that reads back exactly."""
    scalars = log.scalars(name)
    with atomic_file(to) as part, part.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(scalars)
        writer.writerows(zip(*(values.tolist() for values in scalars.values()), strict=True))


def _frames_of_epoch(log: Log, name: str, epoch: int | None) -> list[tuple[int, int]]:
    """Returns (frame number, epoch) of the frames to export, all of one mesh, whatever was cut from it."""
    epochs = log.object_log(name).epochs
    found = sorted(set(epochs))
    if epoch is None and len({log.uncut(name, e) for e in found}) > 1:
        raise BadInput(
            f"{log.path}: {name!r} changed its mesh; choose one with --epoch, of {', '.join(map(str, found))}"
        )
    if epoch is not None and epoch not in found:
        raise BadInput(f"--epoch {epoch}: frames of {name!r} were recorded of {', '.join(map(str, found)) or 'none'}")
    return [(index, e) for index, e in enumerate(epochs) if epoch in (None, e)]


def _uncut(mesh: Mesh) -> Mesh:
    return mesh.uncut or mesh


def _removed_steps(log: Log, name: str, mesh: Mesh, chosen: list[tuple[int, int]]) -> NDArray[np.int64]:
    """Returns the step of the first frame without each element, (m,); -1: all frames have it."""
    steps, frames = np.full(len(mesh.tets), -1, np.int64), log.object_log(name).frames
    number = {corners: k for k, corners in enumerate(map(tuple, mesh.tets.tolist()))}
    for index, epoch in reversed([c for k, c in enumerate(chosen) if k == 0 or c[1] != chosen[k - 1][1]]):
        there = np.zeros(len(steps), bool)
        there[[number[corners] for corners in map(tuple, log.mesh(name, epoch).tets.tolist())]] = True
        steps[~there] = frames[index][0]
    return steps


def _stream(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], rows: Iterable[NDArray]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(stream, header)  # type: ignore[arg-type]
        for values in rows:
            stream.write(np.ascontiguousarray(values, "<f8").data)


def _add(archive: zipfile.ZipFile, name: str, values: NDArray) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, np.asanyarray(values), allow_pickle=False)
