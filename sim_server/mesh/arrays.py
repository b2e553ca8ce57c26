# SPDX-License-Identifier: MIT
"""Meshes that are in no file: made of arrays, and as text that a scene holds.

Where a scene goes its text goes, too: into logs, replays, checkpoints and to workers, none of which need a file.
"""

import base64
import binascii
import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_server.arrays import Int32
from sim_server.errors import InputError
from sim_server.mesh import Mesh, check
from sim_server.mesh.check import complaints, indices
from sim_server.mesh.groups import Group
from sim_server.mesh.quadratic import sub_tetrahedra

PARTS = {"elements": 1, "faces": 4, "nodes": 1}  # of a group, and numbers in a row of each
LONGEST = 512 << 20  # characters of a text


def mesh_of(points: Any, tets: Any, groups: Mapping[str, Any] | None = None, name: str = "arrays") -> Mesh:
    """Returns a checked mesh of arrays, which are copied.

    points: (n, 3) at rest, before the pose [m]. tets: node numbers from 0, (m, 4), or (e, 10) for quadratic elements,
    their nodes on edges in the order of VTK.
    groups: by name what each has: numbers of elements (k,), or whether each has it, (m,) or (e,) of booleans; or a
    table of `elements`, `faces` (f, 3) or (f, 4), and `nodes` (p,), numbers or booleans.

    Raises InputError that names the first nodes, elements or groups that cannot be used.
    """
    rest = _numbers(points, np.float64, name, "points")
    cells = _numbers(tets, np.int32, name, "tets")
    if cells.ndim != 2 or cells.shape[1] not in (4, 10):
        raise InputError(f"mesh {name}: tets have shape {cells.shape}: must be whole numbers (m, 4) or (e, 10)")
    quadratic = cells if cells.shape[1] == 10 else None
    if quadratic is None:
        made = Mesh(rest, cells, name)
    else:
        wrong = [] if rest.ndim == 2 and rest.shape[1:] == (3,) else list(complaints(rest, cells[:, :4]))
        if wrong or (found := indices(rest, cells)):
            raise InputError(f"mesh {name}: {wrong[0] if wrong else found}")
        made = Mesh(rest, sub_tetrahedra(rest, cells), name, 0, cells)
    if not isinstance(groups, Mapping | None) or not all(isinstance(key, str) for key in groups or ()):
        raise InputError(f"mesh {name}: groups must be a table of their names")
    made = check(made)
    known = {key: _group(made, key, given) for key, given in (groups or {}).items()}
    return Mesh(made.rest, made.tets, name, 0, made.quadratic, known)


def packed(mesh: Mesh) -> str:
    """Returns a mesh as text: base64 of NumPy's .npz, the same for the same mesh."""
    arrays: dict[str, Any] = {"points": mesh.rest, "tets": mesh.tets if mesh.quadratic is None else mesh.quadratic}
    for number, group in enumerate(mesh.groups.values()):
        arrays |= {f"{number}.{part}": getattr(group, part) for part in PARTS}
    heading = json.dumps({"name": mesh.name, "groups": list(mesh.groups)}).encode()
    file = io.BytesIO()
    np.savez_compressed(file, heading=np.frombuffer(heading, np.uint8), **arrays)
    return base64.b64encode(file.getvalue()).decode()


def unpacked(text: str) -> Mesh:
    """Returns the checked mesh of a text of `packed`. Raises InputError for another text."""
    try:
        if len(text) > LONGEST:
            raise ValueError(f"{len(text)} characters, at most {LONGEST}")
        with np.load(io.BytesIO(base64.b64decode(text, validate=True)), allow_pickle=False) as file:
            heading = json.loads(file["heading"].tobytes())
            groups = {name: {part: file[f"{k}.{part}"] for part in PARTS} for k, name in enumerate(heading["groups"])}
            points, tets, name = file["points"], file["tets"], str(heading["name"])
    except (ValueError, KeyError, TypeError, EOFError, OSError, binascii.Error, zipfile.BadZipFile) as error:
        raise InputError(f"mesh: data that holds no mesh ({error})") from None
    made = mesh_of(points, tets, name=name)
    counts = {"elements": len(made.tets), "faces": len(made.rest), "nodes": len(made.rest)}
    known = {
        key: Group(**{part: _indices(value, part, counts[part], key, name) for part, value in given.items()})
        for key, given in groups.items()
    }
    return Mesh(made.rest, made.tets, name, 0, made.quadratic, known)


def _numbers(given: Any, kind: Any, name: str, what: str) -> Any:
    """Returns a copy of an array as `kind`, of the same values. Raises InputError."""
    try:
        array = np.asarray(given)
        whole = kind is np.float64 or array.dtype.kind in "iu"
        if array.dtype.kind in "iuf" and whole:
            made = np.array(array, kind, order="C")
            if kind is np.float64 or (made == array).all():
                return made
    except (ValueError, TypeError, OverflowError):
        raise InputError(f"mesh {name}: {what} are no array of numbers") from None
    wanted = "numbers (n, 3)" if kind is np.float64 else "whole numbers of nodes (m, 4) or (e, 10)"
    raise InputError(f"mesh {name}: {what} of shape {array.shape} and type {array.dtype}: must be {wanted}")


def _group(mesh: Mesh, key: str, given: Any) -> Group:
    table = given if isinstance(given, Mapping) else {"elements": given}
    if other := sorted(map(str, table.keys() - PARTS.keys())):
        raise InputError(f"mesh {mesh.name}: group {key!r} has {other[0]!r}; allowed: {', '.join(PARTS)}")
    cells = mesh.tets if mesh.quadratic is None else mesh.quadratic
    count = {"elements": len(cells), "faces": len(mesh.rest), "nodes": len(mesh.rest)}
    parts = {part: _indices(value, part, count[part], key, mesh.name) for part, value in table.items()}
    if mesh.quadratic is not None and "elements" in parts:
        parts["elements"] = (8 * parts["elements"][:, None] + np.arange(8)).ravel().astype(np.int32)
    return Group(**parts)


def _indices(value: Any, part: str, count: int, key: str, name: str) -> Int32:
    """Returns one part of a group as numbers, (k,) or of faces (f, 4). Raises InputError."""
    array = np.asarray(value)
    said = f"mesh {name}: {part} of group {key!r} of shape {array.shape} and type {array.dtype}"
    if part != "faces" and array.dtype == bool and array.shape == (count,):
        return np.flatnonzero(array).astype(np.int32)
    columns = PARTS[part]
    if not array.size:
        return np.zeros((0, columns) if columns > 1 else 0, np.int32)
    if array.dtype.kind not in "iu" or array.ndim != min(columns, 2) or (columns == 4 and array.shape[1] not in (3, 4)):
        wanted = "numbers of nodes (f, 3) or (f, 4)" if columns == 4 else f"numbers (k,), or {count} booleans"
        raise InputError(f"{said}: must be {wanted}")
    if array.min() < 0 or array.max() >= count:
        raise InputError(f"{said}: runs from {array.min()} to {array.max()}; allowed: 0 to {count - 1}")
    if columns == 4 and array.shape[1] == 3:
        array = array[:, [0, 1, 2, 2]]
    return array.astype(np.int32)
