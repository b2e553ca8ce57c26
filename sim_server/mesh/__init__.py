# SPDX-License-Identifier: MIT
"""Tetrahedral meshes: bars made here, files read through meshio, checks, and the pose."""

import contextlib
import io
import itertools
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.process.extras import missing_extra
from sim_server.arrays import Float64, Int32
from sim_server.errors import InputError
from sim_server.mesh.cells import tetrahedra
from sim_server.mesh.check import complaints, crowded_faces, indices
from sim_server.mesh.check_quadratic import quadratic_complaints, wound
from sim_server.mesh.gmsh_files import gmsh_files
from sim_server.mesh.groups import Group, listed, read_groups, unknown
from sim_server.mesh.quadratic import quadratic_cells_of, sub_tetrahedra, with_mid_nodes
from sim_server.mesh.surface import volumes

log = logging.getLogger(__name__)

MOST_TETS = 10_000_000  # of a bar: what a typing error may ask for


@dataclass(frozen=True)
class Mesh:
    """Nodes at rest, before the pose, and tetrahedra.

    rest: float64 (n, 3) [m]; tets: int32 (m, 4), positive volume once checked; name: for messages; dropped: number of
    nodes of the file that are left out, so that the others have other numbers than there.
    quadratic: int32 (e, 10), elements with a node on each edge (order: quadratic.py), None for linear ones; the tets
    are then eight of each element, one element's after another's.
    groups: named elements and nodes.
    """

    rest: Float64
    tets: Int32
    name: str = "mesh"
    dropped: int = 0
    quadratic: Int32 | None = None
    groups: Mapping[str, Group] = field(default_factory=dict)

    @property
    def centroids(self) -> Float64:
        """Centroid of each tet [m], (m, 3); in a quadratic mesh that of the corners of its element."""
        if self.quadratic is None:
            linear: Float64 = self.rest[self.tets].mean(axis=1)
            return linear
        return np.repeat(self.rest[self.quadratic[:, :4]].mean(axis=1), 8, axis=0)

    @cached_property
    def volumes(self) -> Float64:
        """Volume of each tet [m3], (m,); kept."""
        return volumes(self.rest, self.tets)

    def with_mid_nodes(self) -> "Mesh":
        """Returns the mesh with quadratic elements: a linear one gets a node in the middle of each edge, behind its
        own nodes."""
        if self.quadratic is not None:
            return self
        rest, quadratic = with_mid_nodes(self.rest, self.tets)
        groups = {name: group.with_mid_nodes(quadratic) for name, group in self.groups.items()}
        return replace(self, rest=rest, tets=sub_tetrahedra(rest, quadratic), quadratic=quadratic, groups=groups)

    def nodes_of(self, group: str) -> NDArray[np.bool_]:
        """Returns which nodes a group has, (n,). Raises InputError, which lists the groups that there are."""
        if group not in self.groups:
            raise unknown(group, self.groups, self.name)
        return self.groups[group].holds(self.tets, len(self.rest))

    def elements_of(self, group: str) -> NDArray[np.bool_]:
        """Returns which tetrahedra a group has, (m,). Raises InputError for an unknown one, and for one of nodes."""
        if group not in self.groups:
            raise unknown(group, self.groups, self.name)
        if not len(self.groups[group].elements):
            raise InputError(f"group {group!r} of {self.name} has no elements; groups of it: {listed(self.groups)}")
        held = np.zeros(len(self.tets), bool)
        held[self.groups[group].elements] = True
        return held


def bar(cells: Sequence[int], size: Sequence[float], split: str = "mirrored") -> Mesh:
    """A box of `size` [m] with a corner at the origin, each of its nx ny nz hexahedra split into 6 tetrahedra.

    "kuhn": one tetrahedron per order of the axes along which a path leads from the lowest corner of the cell to the
    opposite one, so neighbouring cells match. All its diagonals point one way: a coarse bar under bending also twists,
    and is too stiff, the more so the nearer Poisson's ratio is to 0.5. "mirrored" turns the split over from cell to
    cell along each axis: the same count, without that bias.
    Nodes are numbered x fastest, then y, then z; so are the cells.
    Raises InputError unless there are three counts >= 1 and three finite sizes > 0.
    """
    if len(cells) != 3 or min(cells) < 1 or 6 * math.prod(cells) > MOST_TETS:
        raise InputError(f"bar = {list(cells)}: must be three counts of cells >= 1, at most {MOST_TETS} tets in all")
    if len(size) != 3 or not all(np.isfinite(s) and s > 0 for s in size):
        raise InputError(f"size = {list(size)}: must be three lengths > 0 [m]")
    nx, ny, nz = cells
    k, j, i = (axis.ravel() for axis in np.mgrid[: nz + 1, : ny + 1, : nx + 1])
    rest = np.stack([i * size[0] / nx, j * size[1] / ny, k * size[2] / nz], axis=1)

    stride = np.array([1, nx + 1, (nx + 1) * (ny + 1)])
    k, j, i = (axis.ravel() for axis in np.mgrid[:nz, :ny, :nx])
    cell = np.stack([i, j, k], axis=1)
    if split == "mirrored":
        flipped = cell % 2
        far = (cell + flipped) @ stride  # the corner that the paths of this cell start from
        paths = np.stack([_kuhn_paths(stride * (1 - 2 * np.array(p))) for p in np.ndindex(2, 2, 2)])
        tets = far[:, None, None] + paths[flipped @ [4, 2, 1]]
        turned = flipped.sum(axis=1) % 2 == 1  # a mirror image has its winding the other way round
        tets[turned] = tets[turned][:, :, [0, 1, 3, 2]]
    else:
        tets = (cell @ stride)[:, None, None] + _kuhn_paths(stride)
    name = "bar " + "x".join(str(c) for c in cells)
    return Mesh(rest, tets.reshape(-1, 4).astype(np.int32), name)


def _kuhn_paths(stride: NDArray[np.integer]) -> NDArray[np.integer]:
    """Node offsets of the six tetrahedra of a cell, (6, 4); odd orders of the axes have their last nodes swapped."""
    paths = []
    for order in itertools.permutations(range(3)):
        path = np.concatenate([[0], np.cumsum(stride[list(order)])])
        odd = np.linalg.det(np.eye(3)[list(order)]) < 0
        paths.append(path[[0, 1, 3, 2]] if odd else path)
    return np.array(paths)


def read(path: str | Path, quadratic: bool = False) -> Mesh:
    """Reads the volume cells of a file in any format of meshio, as tetrahedra; unchecked, see `check`.

    quadratic: keeps quadratic tetrahedra where all volume cells are such.
    Other quadratic cells are reduced to their corners; hexahedra, wedges and pyramids are split (cells.py). Triangles,
    lines and points of the file are left out but for the nodes of named groups, and so are nodes without a cell; what
    was changed is logged in one line.
    Raises InputError naming the file: missing, unreadable, unknown format, or cells that cannot be used.
    """
    path = Path(path)
    if not isfile(path):
        raise InputError(f"mesh {path}: no such file")
    data = meshio_read(path)
    rest = np.asarray(data.points, dtype=np.float64)
    if rest.shape[1:] != (3,):
        raise InputError(f"mesh {path}: node coordinates have shape {rest.shape}: must be (n, 3)")
    kept = quadratic_cells_of(rest, data.cells) if quadratic else None
    try:
        cells, changed = kept or tetrahedra(rest, data.cells)
    except InputError as error:
        raise InputError(f"mesh {path}: {error}") from None
    if wrong := indices(rest, cells):
        raise InputError(f"mesh {path}: {wrong}")
    used = np.zeros(len(rest), dtype=bool)
    used[cells] = True
    dropped = int((~used).sum())
    if dropped:
        where = "which belong to no cell" if kept else "which are no corner of a cell"
        changed.append(f"{dropped} of {len(rest)} nodes dropped, {where}")
    if changed:
        log.warning("mesh %s: %s", path, "; ".join(changed))
    numbers = np.where(used, np.cumsum(used) - 1, -1)
    try:
        groups = read_groups(data, numbers, bool(kept))
    except (IndexError, ValueError, TypeError) as error:
        raise InputError(f"mesh {path}: its groups cannot be read ({error})") from error
    rest, numbered = rest[used], numbers[cells].astype(np.int32)
    if kept:
        return Mesh(rest, sub_tetrahedra(rest, numbered), path.name, dropped, numbered, groups)
    return Mesh(rest, numbered, path.name, dropped, None, groups)


def meshio_read(path: Path, what: str = "mesh") -> Any:
    """Returns what meshio reads in a file. what: names it in messages. Raises InputError if it cannot be read."""
    try:
        import meshio
        from meshio._helpers import extension_to_filetypes
    except ModuleNotFoundError as error:
        raise InputError(f"{what} {path}: {missing_extra(error) or error}") from error
    formats = f"formats by extension: {' '.join(sorted(extension_to_filetypes))}"
    said = io.StringIO()  # meshio prints its reasons, and ends the process where it cannot read a file
    try:
        quiet = contextlib.redirect_stdout(said), contextlib.redirect_stderr(said)
        with quiet[0], quiet[1], np.errstate(all="ignore"), gmsh_files():
            return meshio.read(path)
    except ImportError as error:
        raise InputError(f"{what} {path}: reading it needs the Python package {error.name!r}") from error
    except (Exception, SystemExit) as error:
        text = said.getvalue().strip() or str(error)
        reason = " ".join(text.split())[:200] or type(error).__name__
        raise InputError(f"{what} {path}: cannot be read ({reason}); {formats}") from error


def check(mesh: Mesh) -> Mesh:
    """Returns `mesh` with every tetrahedron wound to positive volume; logs how many were inverted.

    Raises InputError that names the first nodes or tetrahedra concerned (of a quadratic mesh: elements): not finite,
    out of range, flat, duplicate, coincident, unused or curved too much.
    """
    if mesh.quadratic is not None:
        return _checked_quadratic(mesh, mesh.quadratic)
    if wrong := list(complaints(mesh.rest, mesh.tets)):
        raise InputError("\n".join(f"mesh {mesh.name}: {text}" for text in wrong))
    if odd := crowded_faces(mesh.rest, mesh.tets):
        log.warning("mesh %s: %s", mesh.name, odd)
    inverted = volumes(mesh.rest, mesh.tets) < 0
    if not inverted.any():
        return mesh
    tets = mesh.tets.copy()
    tets[inverted] = tets[inverted][:, [0, 1, 3, 2]]
    log.warning("mesh %s: winding of %d of %d tets repaired", mesh.name, int(inverted.sum()), len(tets))
    return replace(mesh, tets=tets)


def _checked_quadratic(mesh: Mesh, given: Int32) -> Mesh:
    if wrong := list(quadratic_complaints(mesh.rest, given)):
        raise InputError("\n".join(f"mesh {mesh.name}: {text}" for text in wrong))
    if odd := crowded_faces(mesh.rest, given[:, :4]):
        log.warning("mesh %s: %s", mesh.name, odd)
    quadratic = wound(mesh.rest, given)
    if inverted := int((quadratic != given).any(axis=1).sum()):
        log.warning("mesh %s: winding of %d of %d elements repaired", mesh.name, inverted, len(given))
    return replace(mesh, quadratic=quadratic, tets=sub_tetrahedra(mesh.rest, quadratic))


def pose_matrix(rotate: ArrayLike) -> Float64:
    """Rotation (3, 3) by `rotate` = three angles [degrees] about the fixed axes x, then y, then z: Rz Ry Rx."""
    (cx, cy, cz), (sx, sy, sz) = (f(np.radians(np.asarray(rotate, dtype=float))) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def posed(points: Float64, rotate: ArrayLike, translate: ArrayLike) -> Float64:
    """Returns `points` (n, 3) [m] rotated by `pose_matrix`, then moved by `translate` [m]."""
    return points @ pose_matrix(rotate).T + np.asarray(translate, dtype=float)
