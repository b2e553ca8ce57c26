# SPDX-License-Identifier: MIT
"""Exports all frames of a log as one VTKHDF file for ParaView, by h5py.

An object is a transient unstructured grid: its elements are written once for each mesh that it had, whatever the
number of frames. Several grids (of objects and of their skins) are the blocks of a partitioned data set collection,
on the same times. Layout: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/index.html
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clients.log.atomic_file import atomic_file
from clients.log.frames import Frame, Mesh
from clients.log.reader import Log
from clients.log.von_mises import StressField

if TYPE_CHECKING:
    import h5py

# Versions of the format: the first with times, and the first with collections. Readers warn of newer ones than theirs.
GRID, COLLECTION = (2, 0), (2, 1)
TETRA, TRIANGLE = 10, 5  # VTK's numbers of cells


class _Part(NamedTuple):
    """The cells of one epoch: cells (m, 4) or (t, 3) of `points` points."""

    points: int
    cells: NDArray
    young: NDArray
    poisson: NDArray


def write_vtkhdf(log: Log, names: Sequence[str], to: Path, progress: Callable[[float], None] = lambda _: None) -> None:
    """Writes objects: points [m], displacement [m], velocity [m/s], von_mises [Pa] (elastic bodies); cells: young [Pa],
    poisson.

    A frame that an object lacks at a time of another one is the one before it. Raises OSError.
    """
    import h5py

    names = [name for name in names if log.object_log(name).frames]
    grids = [(name, skin) for name in names for skin in (False, *([True] if _has_skin(log, name) else []))]
    steps = sorted({frame[0] for name in names for frame in log.object_log(name).frames})
    times = np.full(len(steps), np.nan)
    with atomic_file(to) as part, h5py.File(part, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        if len(grids) == 1:
            _write_grid(root, log, *grids[0], steps, times, progress)
            return
        _describe(root, "PartitionedDataSetCollection", COLLECTION)
        assembly, done = root.create_group("Assembly", track_order=True), 0
        for index, (name, skin) in enumerate(grids):
            label = f"{name}_skin" if skin else name
            block = root.create_group(label)
            block.attrs["Index"] = index

            def further(count: float, before: int = done) -> None:
                progress(before + count)

            _write_grid(block, log, name, skin, steps, times, progress if skin else further)
            assembly.create_group(label, track_order=True)[label] = h5py.SoftLink(f"/VTKHDF/{label}")
            done += 0 if skin else len(log.object_log(name).frames)


def _has_skin(log: Log, name: str) -> bool:
    return log.mesh(name, log.object_log(name).epochs[0]).skin is not None


def _describe(group: h5py.Group, kind: str, version: tuple[int, int]) -> None:
    """Notes type and version. VTK reads the type as a string of fixed length."""
    group.attrs["Version"] = version
    group.attrs.create("Type", kind.encode("ascii"), dtype=f"S{len(kind)}")


def _part(mesh: Mesh, skin: bool) -> _Part:
    if skin and mesh.skin is not None:
        return _Part(len(mesh.skin.nodes), mesh.skin.triangles, mesh.young[:0], mesh.poisson[:0])
    return _Part(len(mesh.rest), mesh.tets, mesh.young, mesh.poisson)


def _write_grid(
    group: h5py.Group,
    log: Log,
    name: str,
    skin: bool,
    steps: Sequence[int],
    times: NDArray,
    progress: Callable[[float], None],
) -> None:
    """Writes an object, or its skin, at all steps; fills in the times of those that it has."""
    epochs = log.object_log(name).epochs
    number = {epoch: k for k, epoch in enumerate(dict.fromkeys(epochs))}
    parts = [_part(log.mesh(name, epoch), skin) for epoch in number]
    _describe(group, "UnstructuredGrid", GRID)
    _write_cells(group, parts, TRIANGLE if skin else TETRA)
    first = np.cumsum([0, *(parts[number[epoch]].points for epoch in epochs)])
    _write_points(group, log, name, skin, first, steps, times, progress)
    at = _frame_at(log, name, steps)
    part = np.array([number[epochs[k]] for k in at])
    cells = np.cumsum([0, *(len(each.cells) for each in parts)])[part]
    corners = np.cumsum([0, *(each.cells.size for each in parts)])[part]
    index = group.create_group("Steps")
    index.attrs["NSteps"] = len(steps)
    index["Values"] = times
    index["PartOffsets"], index["NumberOfParts"] = part, np.ones(len(steps), np.int64)
    index["PointOffsets"] = first[at]
    index["CellOffsets"], index["ConnectivityIdOffsets"] = cells[:, None], corners[:, None]
    for data, offsets in (("PointData", first[at]), ("CellData", cells)):
        for array in group.get(data, ()):
            index[f"{data}Offsets/{array}"] = offsets


def _write_cells(group: h5py.Group, parts: Sequence[_Part], kind: int) -> None:
    group["NumberOfPoints"] = np.array([each.points for each in parts], np.int64)
    group["NumberOfCells"] = np.array([len(each.cells) for each in parts], np.int64)
    group["NumberOfConnectivityIds"] = np.array([each.cells.size for each in parts], np.int64)
    group["Connectivity"] = np.concatenate([each.cells.ravel() for each in parts]).astype(np.int64)
    corners = parts[0].cells.shape[1]
    group["Offsets"] = np.concatenate([np.arange(len(each.cells) + 1, dtype=np.int64) * corners for each in parts])
    group["Types"] = np.full(sum(len(each.cells) for each in parts), kind, np.uint8)
    if all(len(each.young) == len(each.cells) for each in parts) and len(parts[0].young):
        group["CellData/young"] = np.concatenate([each.young for each in parts])
        group["CellData/poisson"] = np.concatenate([each.poisson for each in parts])


def _write_points(
    group: h5py.Group,
    log: Log,
    name: str,
    skin: bool,
    first: NDArray,
    steps: Sequence[int],
    times: NDArray,
    progress: Callable[[float], None],
) -> None:
    """Writes what points have, frame by frame, so that a log may be larger than memory."""
    count, elastic = int(first[-1]), len(log.mesh(name, log.object_log(name).epochs[0]).young) > 0
    points = group.create_dataset("Points", (count, 3), np.float64)
    data = group.create_group("PointData")
    arrays = {array: data.create_dataset(array, (count, 3), np.float32) for array in ("displacement", "velocity")}
    if elastic:
        arrays["von_mises"] = data.create_dataset("von_mises", (count,), np.float32)
    place = {step: k for k, step in enumerate(steps)}
    mesh: Mesh | None = None
    for k, frame in enumerate(log.frames(name)):
        if mesh is None or mesh.epoch != frame.epoch:
            mesh = log.mesh(name, frame.epoch)
            stress = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson) if elastic else None
        rows = slice(first[k], first[k + 1])
        points[rows] = _at_points(mesh, skin, frame.x)
        for array, values in _nodal(mesh, frame, stress).items():
            at_points = _at_points(mesh, skin, values)
            arrays[array][rows] = np.maximum(at_points, 0) if array == "von_mises" else at_points
        times[place[frame.step]] = frame.time
        progress(k + 1)


def _nodal(mesh: Mesh, frame: Frame, stress: StressField | None) -> dict[str, NDArray]:
    found = {"displacement": frame.x - mesh.rest, "velocity": frame.v}
    if stress is not None:  # a singular value decomposition does not converge where a position is not finite
        finite = bool(np.isfinite(frame.x).all())
        found["von_mises"] = stress.nodes(frame.x) if finite else np.full(len(frame.x), np.nan)
    return found


def _at_points(mesh: Mesh, skin: bool, nodal: NDArray) -> NDArray:
    return mesh.skin.values(nodal) if skin and mesh.skin is not None else nodal


def _frame_at(log: Log, name: str, steps: Sequence[int]) -> NDArray[np.int64]:
    """Returns the number of the newest frame at each step; before the first one that one."""
    found = np.array([frame[0] for frame in log.object_log(name).frames])
    at: NDArray[np.int64] = np.maximum(np.searchsorted(found, steps, side="right") - 1, 0)
    return at
