# SPDX-License-Identifier: MIT
"""Fills a surface with tetrahedra by fTetWild (pytetwild), and keeps the mesh in a cache.

fTetWild meshes an envelope around the surface: nodes are up to `envelope` away from it, and gaps, overlaps and open
borders are closed somehow. So the volume of the mesh is compared with the volume that the surface encloses. It gives
another mesh each time that it is asked, so meshes are kept, and a log holds its own. It runs in a process and a folder
of its own (fill_process.py), as it leaves files where it runs.

Source: Hu, Schneider, Wang, Zorin, Panozzo, Fast Tetrahedral Meshing in the Wild, 2020.
"""

import contextlib
import hashlib
import logging
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from protocol.process.cache_folder import cache_folder, remove_stale, unfinished
from protocol.process.extras import to_install
from sim_server.arrays import Float64, Int32, Int64
from sim_server.errors import InputError
from sim_server.mesh import Mesh
from sim_server.mesh.arrays import mesh_of
from sim_server.mesh.openings import openings
from sim_server.mesh.surface import volumes
from sim_server.mesh.surface_file import read_surface

log = logging.getLogger(__name__)

FORM = "1"  # of what the cache holds; another one finds nothing of this one
ENVELOPE = 1e-3  # of the diagonal of the surface's box, where a scene says nothing
EVERY = 10.0  # s between lines that say that a surface is still being filled
TOLD, ALLOWED = 0.02, 0.25  # differences of the volumes, relative, that are told, and above which a mesh is refused


def filled(path: str | Path, edge: float, envelope: float | None = None, scale: float = 1.0) -> Mesh:
    """Returns the tetrahedra inside a surface in a file (STL, OBJ, PLY, or any other that meshio reads).

    edge: wanted length of edges [m]; envelope: farthest that nodes may be from the surface [m]; scale: turns the unit
    of the file into m.
    Raises InputError: no surface in the file, pytetwild missing, or another volume than the surface encloses.
    """
    path = Path(path)
    points, triangles = read_surface(path, "mesh")
    points = points * scale
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    envelope = ENVELOPE * diagonal if envelope is None else envelope
    if not 0 < envelope <= edge < diagonal:
        raise InputError(
            f"mesh {path}: edge = {edge:g} m with envelope = {envelope:.4g} m: must be above the envelope and below "
            f"the diagonal of the surface, {diagonal:.4g} m"
        )
    given = [points.tobytes(), triangles.tobytes(), repr((FORM, edge, envelope)).encode()]
    kept = cache_folder() / "meshes" / f"{path.stem}-{hashlib.sha256(b''.join(given)).hexdigest()[:24]}.npz"
    begun, found = time.perf_counter(), _from_cache(kept)
    made = found is None
    rest, tets = tetrahedra_inside(path, points, triangles, edge, envelope / diagonal) if found is None else found
    mesh = mesh_of(rest, tets, name=path.name)
    said = f"{len(tets)} tetrahedra in {_parts(mesh)}, {mesh.volumes.sum():.4g} m3"
    told = _compared(points, triangles, float(mesh.volumes.sum()))
    if made:
        log.warning(
            "mesh %s: filled with %s, in %.1f s; kept as %s", path.name, said, time.perf_counter() - begun, kept
        )
        mesh = mesh_of(*_keep(kept, rest, tets), name=path.name)
    if told:
        log.warning("mesh %s: %s", path.name, told)
    return mesh


def tetrahedra_inside(
    path: Path, points: Float64, triangles: Int64, edge: float, envelope: float
) -> tuple[Float64, Int32]:
    """Returns nodes and tetrahedra of positive volume. envelope: over the diagonal [-]. Raises InputError."""
    if find_spec("pytetwild") is None:
        raise InputError(f"mesh {path}: filling a surface with tetrahedra needs pytetwild: {to_install('mesh')}")
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "surface.npz", points=points, triangles=triangles, edge=edge, envelope=envelope)
        run_in(path, Path(folder))
        with np.load(Path(folder) / "mesh.npz", allow_pickle=False) as made:
            rest, tets = made["rest"], made["tets"]
    if not len(tets):
        raise InputError(f"mesh {path}: there is nothing inside it: is it a closed surface?")
    used, numbered = np.unique(tets, return_inverse=True)
    rest, tets = np.asarray(rest, np.float64)[used], numbered.reshape(-1, 4).astype(np.int32)
    inverted = volumes(rest, tets) < 0
    tets[inverted] = tets[inverted][:, [0, 1, 3, 2]]
    return rest, tets


def run_in(path: Path, folder: Path) -> None:
    """Runs fill_process.py in a folder, and says now and then that it does. Raises InputError with what it said."""
    begun, script = time.perf_counter(), Path(__file__).with_name("fill_process.py")
    said = folder / "said.txt"
    with said.open("wb") as sink:
        command = [sys.executable, "-P", str(script)]  # -P: without the folder of the script in front of libraries
        with subprocess.Popen(command, cwd=folder, stdout=sink, stderr=sink) as process:
            try:
                while True:
                    try:
                        code = process.wait(EVERY)
                        break
                    except subprocess.TimeoutExpired:
                        log.warning("mesh %s: still being filled, %.0f s", path.name, time.perf_counter() - begun)
            except BaseException:
                process.kill()
                raise
    if code:
        lines = said.read_text(errors="replace").strip().splitlines()
        reason = lines[-1] if lines else f"it ended with code {code}"
        raise InputError(f"mesh {path}: pytetwild cannot fill it ({reason})")


def _parts(mesh: Mesh) -> str:
    """Returns how many parts a mesh has that share no node, in words."""
    ends = np.concatenate([mesh.tets[:, [0, k]] for k in (1, 2, 3)])
    graph = coo_array((np.ones(len(ends)), ends.T), shape=(len(mesh.rest),) * 2)
    count = connected_components(graph, directed=False)[0]
    return f"{count} parts, which move on their own" if count > 1 else "1 part"


def _compared(points: Float64, triangles: Int64, volume: float) -> str:
    """Returns what is to be told of a surface and the volume of its mesh [m3]; raises InputError if they differ."""
    try:
        loops = openings(triangles)
    except InputError as error:
        return f"the surface is open, and {error}: look at what is inside"
    lids = [np.array([[b, a, loop[0]] for a, b in pairwise(loop[1:])]) for loop in loops]
    closed = np.concatenate([triangles, *(lid for lid in lids if len(lid))])
    enclosed = abs(float(np.linalg.det((points - points.mean(axis=0))[closed]).sum())) / 6
    off = volume / enclosed - 1 if enclosed else np.inf
    what = (
        f"the surface {f'has {len(loops)} openings and, with flat lids, ' if loops else ''}encloses {enclosed:.4g} m3"
    )
    why = "it passes through itself, is wound both ways, has gaps, or edge or envelope are too long"
    if abs(off) > ALLOWED:
        raise InputError(f"mesh: {what}, its tetrahedra {volume:.4g} m3, {off:+.0%}; allowed: {ALLOWED:.0%}. {why}")
    if loops or abs(off) > TOLD:
        return f"{what}, its tetrahedra {off:+.1%}" + (f": {why}" if abs(off) > TOLD else "")
    return ""


def _from_cache(path: Path) -> tuple[Float64, Int32] | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            return file["rest"], file["tets"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _keep(path: Path, rest: Float64, tets: Int32) -> tuple[Float64, Int32]:
    """Writes a mesh as a whole or not at all; without a folder to write to it is made each time.

    Returns what is kept: where several processes fill a surface at a time, the mesh of the first one for all.
    """
    part = unfinished(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_stale(path.parent)
        with part.open("wb") as file:
            np.savez_compressed(file, rest=rest, tets=tets)
        try:
            os.link(part, path)
        except OSError:  # it is there, or the file system knows no links
            if (found := _from_cache(path)) is not None:
                return found
            part.replace(path)
    except OSError as error:
        log.warning("mesh %s: cannot be kept in %s (%s)", path.stem, path.parent, error.strerror or error)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return rest, tets
