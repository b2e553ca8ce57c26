# SPDX-License-Identifier: MIT
"""Exports frames of a log as VTK unstructured grids for ParaView, by meshio."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from clients.errors import BadInput
from clients.log.atomic_file import atomic_file
from clients.log.frames import Frame, Mesh
from clients.log.reader import Log
from clients.log.von_mises import StressField


def write_vtu(
    log: Log, name: str, to: Path, frame: str = "last", progress: Callable[[int], None] = lambda _: None
) -> list[Path]:
    """Writes one frame to `to`, or with frame = "all" a file per frame and a .pvd collection with their times.

    Point data: displacement [m], velocity [m/s], von_mises [Pa] (elastic bodies); cell data: young, poisson.
    """
    count = len(log.object_log(name).frames)
    if count == 0:
        raise BadInput(f"{log.path}: no frames of object {name!r} were recorded")
    if frame != "all":
        found = log.frame(name, _number(frame))
        _write(to, found, log.mesh(name, found.epoch))
        return [to]
    written: list[Path] = []
    times: list[float] = []
    for index, found in enumerate(log.frames(name)):
        written.append(to.with_name(f"{to.stem}_{index:0{len(str(count - 1))}d}.vtu"))
        times.append(found.time)
        _write(written[-1], found, log.mesh(name, found.epoch))
        progress(index)
    collection = to.with_suffix(".pvd")
    _write_pvd(collection, written, times)
    return [*written, collection]


def _number(frame: str) -> int:
    if frame == "last":
        return -1
    try:
        return int(frame)
    except ValueError:
        raise BadInput(f"--frame {frame}: allowed are last, all, or a frame number") from None


def _write(path: Path, frame: Frame, mesh: Mesh) -> None:
    import meshio

    point_data: dict[str, Any] = {"displacement": frame.x - mesh.rest, "velocity": frame.v}
    cell_data: dict[str, Any] = {}
    if len(mesh.young):
        point_data["von_mises"] = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson).nodes(frame.x)
        cell_data = {"young": [mesh.young], "poisson": [mesh.poisson]}
    with atomic_file(path) as part:
        meshio.Mesh(frame.x, [("tetra", mesh.tets)], point_data, cell_data).write(part, file_format="vtu")


def _write_pvd(path: Path, files: list[Path], times: list[float]) -> None:
    sets = "\n".join(
        f'    <DataSet timestep="{time!r}" part="0" file="{file.name}"/>'
        for file, time in zip(files, times, strict=True)
    )
    text = f"""<?xml version="1.0"?>
<VTKFile type="Collection" version="0.1">
  <Collection>
{sets}
  </Collection>
</VTKFile>
"""
    with atomic_file(path) as part:
        part.write_text(text)
