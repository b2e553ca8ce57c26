# SPDX-License-Identifier: MIT
"""Surfaces in files: Wavefront OBJ read here, the others by meshio."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.errors import InputError
from sim_server.mesh import check, meshio_read, read
from sim_server.mesh.surface import surface_triangles


def read_surface(path: str | Path, what: str = "surface") -> tuple[Float64, Int64]:
    """Returns points (n, 3) and triangles (t, 3) of a file: of its volume cells if it has some, else of its faces.

    what: names it in messages. Raises InputError for a file that cannot be read or has no surface.
    """
    if Path(path).suffix.lower() == ".obj":
        points, triangles, kinds = *_read_obj(Path(path), what), "none"
    else:
        data = meshio_read(Path(path), what)
        points = np.asarray(data.points, dtype=np.float64)
        if any(block.dim == 3 and len(block.data) for block in data.cells):
            mesh = check(read(path))
            return mesh.rest, surface_triangles(mesh.tets).astype(np.int64)
        faces = [np.zeros((0, 3), np.int64)]
        for block in data.cells:
            cells = np.asarray(block.data)
            if block.type.startswith("triangle"):
                faces.append(cells[:, :3])
            elif block.type.startswith("quad"):
                faces += [cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]]
        triangles = np.concatenate(faces).astype(np.int64)
        kinds = ", ".join(sorted({b.type for b in data.cells})) or "none"
    if points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise InputError(f"{what} {path}: points of shape {points.shape}: must be finite, (n, 3)")
    if not len(triangles):
        raise InputError(f"{what} {path}: no triangles; cells in it: {kinds}; allowed: triangles, quads, volume cells")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise InputError(f"{what} {path}: numbers of points must be 0 to {len(points) - 1}")
    return points, triangles


def _read_obj(path: Path, what: str) -> tuple[Float64, Int64]:
    """Returns points (n, 3) and triangles (t, 3) of a Wavefront OBJ file; polygons are split from their first corner.

    meshio refuses files whose corners have texture coordinates or normals of their own, as most have.
    """
    points: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    read, line = 0, ""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                read += 1
                words = line.split("#")[0].split()
                if words[:1] == ["v"]:
                    x, y, z = words[1:4]
                    points.append([float(x), float(y), float(z)])
                elif words[:1] == ["f"]:
                    given = [int(word.split("/")[0]) for word in words[1:]]
                    if len(given) < 3 or not all(given):
                        raise ValueError
                    corners = [k - 1 if k > 0 else len(points) + k for k in given]
                    triangles += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    except OSError as error:
        raise InputError(f"{what} {path}: cannot be read ({error.strerror or error})") from error
    except ValueError:
        raise InputError(
            f"{what} {path}, line {read}: {line.strip()[:80]!r}: must be v X Y Z, or f and at least three numbers of "
            "points"
        ) from None
    return np.array(points, np.float64).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)
