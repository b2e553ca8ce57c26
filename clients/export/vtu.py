# SPDX-License-Identifier: MIT
"""Exports frames of a log as VTK unstructured grids for ParaView, by meshio."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from clients.errors import BadInput, ClientError
from clients.log.atomic_file import atomic_file
from clients.log.frames import Frame, Mesh
from clients.log.reader import Log
from clients.log.von_mises import StressField
from protocol.process.extras import to_install


def write_vtu(
    log: Log, name: str, to: Path, frame: str = "last", progress: Callable[[int], None] = lambda _: None
) -> list[Path]:
    """Writes one frame to `to`, or with frame = "all" a file per frame and a .pvd collection with their times.

    Point data: displacement [m], velocity [m/s], von_mises [Pa] (elastic bodies); cell data: young, poisson.
    The skin of an object that has one is a second file, NAME_skin.vtu with the point data: part 1 of the collection.
    """
    count = len(log.object_log(name).frames)
    if count == 0:
        raise BadInput(f"{log.path}: no frames of object {name!r} were recorded")
    if frame != "all":
        found = log.frame(name, _number(frame))
        return _write(to, found, log.mesh(name, found.epoch))[::-1]
    listed: list[tuple[float, list[Path]]] = []
    for index, found in enumerate(log.frames(name)):
        path = to.with_name(f"{to.stem}_{index:0{len(str(count - 1))}d}.vtu")
        listed.append((found.time, _write(path, found, log.mesh(name, found.epoch))))
        progress(index)
    collection = to.with_suffix(".pvd")
    _write_pvd(collection, listed)
    return [*(path for _, files in listed for path in files), collection]


def _number(frame: str) -> int:
    if frame == "last":
        return -1
    try:
        return int(frame)
    except ValueError:
        raise BadInput(f"--frame {frame}: allowed are last, all, or a frame number") from None


def _write(path: Path, frame: Frame, mesh: Mesh) -> list[Path]:
    """Writes a frame; returns the files: of the mesh, then of its skin if it has one."""
    point_data: dict[str, Any] = {"displacement": frame.x - mesh.rest, "velocity": frame.v}
    cell_data: dict[str, Any] = {}
    if len(mesh.young):
        point_data["von_mises"] = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson).nodes(frame.x)
        cell_data = {"young": [mesh.young], "poisson": [mesh.poisson]}
    _write_mesh(path, frame.x, [("tetra", mesh.tets)], point_data, cell_data)
    if mesh.skin is None:
        return [path]
    of_skin = path.with_name(f"{path.stem}_skin.vtu")
    at_vertices = {key: mesh.skin.values(values) for key, values in point_data.items()}
    if "von_mises" in at_vertices:
        at_vertices["von_mises"] = np.maximum(at_vertices["von_mises"], 0.0)  # weights beyond the mesh may be negative
    _write_mesh(of_skin, mesh.skin.positions(frame.x), [("triangle", mesh.skin.triangles)], at_vertices, {})
    return [path, of_skin]


def _write_mesh(path: Path, *parts: Any) -> None:
    """Writes points, cells, point data and cell data."""
    try:
        import meshio
    except ImportError:
        raise ClientError(f"meshio is not installed, of the extra mesh: {to_install('mesh')}") from None
    with atomic_file(path) as part:
        meshio.Mesh(*parts).write(part, file_format="vtu")


def _write_pvd(path: Path, listed: list[tuple[float, list[Path]]]) -> None:
    """Writes a collection of the files of each time [s]."""
    sets = "\n".join(
        f'    <DataSet timestep="{time!r}" part="{part}" file="{file.name}"/>'
        for time, files in listed
        for part, file in enumerate(files)
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
