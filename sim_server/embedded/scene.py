# SPDX-License-Identifier: MIT
"""Scenes that a program builds: tables of Python with NumPy values and meshes of arrays, written as scene files."""

import copy
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_server import scene as scenes
from sim_server.arrays import Float64
from sim_server.errors import InputError
from sim_server.mesh.arrays import mesh_of
from sim_server.parameters import toml
from sim_server.scene import overrides

FROM = "from Python"  # where a table is from, in messages


class Mesh:
    """Nodes and tetrahedra: points (n, 3) [m]; tets, numbers of points, (m, 4), or (e, 10) of quadratic elements.

    groups: elements and nodes by name, for `group` in a scene; numbers of elements, or a table of elements, faces and
    nodes. Tetrahedra are wound to positive volume. Raises InputError for arrays that are no mesh.
    """

    def __init__(
        self, points: ArrayLike, tets: ArrayLike, groups: Mapping[str, Any] | None = None, name: str = "arrays"
    ):
        self.checked = mesh_of(points, tets, groups, name)

    @property
    def points(self) -> Float64:
        """Nodes at rest (n, 3) [m]."""
        return self.checked.rest

    @property
    def tets(self) -> NDArray[np.int32]:
        """Tetrahedra (m, 4)."""
        return self.checked.tets


class Scene:
    """A scene as a table of Python, keywords, or both: the keys of a scene file.

    Values may be those of NumPy, and `mesh` of an object a Mesh. folder: where files that it names are. Raises
    InputError with one line for each error.

    >>> Scene(dt=0.02, object=[{"name": "bar", "mesh": {"bar": [2, 2, 8], "size": [0.1, 0.1, 0.4]},
    ...       "effects": {"corotational": {"young": 1e5, "poisson": 0.4}, "fixed": {"where": "Z < 0.01"}}}])
    """

    def __init__(self, table: Mapping[str, Any] | None = None, folder: str | Path = ".", **keys: Any):
        if twice := sorted((table or {}).keys() & keys.keys()):
            raise InputError(f"scene: {twice[0]} is given twice, in the table and as a keyword")
        self._source: dict[str, Any] | tuple[Path, Sequence[str]] = plain({**(table or {}), **keys})
        self._folder = Path(folder)
        self.checked = scenes.validated(copy.deepcopy(self._source), FROM, self._folder)

    @classmethod
    def load(cls, path: str | Path, overrides: Sequence[str] = ()) -> Self:
        """Reads a scene file, or gallery/NAME. overrides: KEY=VALUE, or @FILE, an overlay. Raises InputError."""
        scene = cls.__new__(cls)
        scene._source, scene._folder = (Path(path), tuple(overrides)), Path(path).parent
        scene.checked = scenes.load(path, overrides)
        return scene

    def with_values(self, values: Mapping[str, Any]) -> "Scene":
        """Returns the scene with other values, by key as after --set: "solver.tolerance",
        "object.beam.effects.corotational.young". A text is a value as on the command line. Raises InputError.
        """
        given = [f"{key}={value if isinstance(value, str) else toml(plain(value))}" for key, value in values.items()]
        if isinstance(self._source, tuple):
            path, before = self._source
            return type(self).load(path, [*before, *given])
        table = copy.deepcopy(self._source)
        for override in given:
            overrides.apply(override, table)
        return type(self)(table, self._folder)

    def table(self) -> dict[str, Any]:
        """Returns the scene with all defaults, as a table."""
        return self.checked.resolved()

    def save(self, path: str | Path) -> Path:
        """Writes the scene with all defaults as a scene file, from which an equal one is read; returns its path.

        Meshes of arrays are in the file; other files keep their places, as absolute paths. Raises OSError.
        """
        path = Path(path)
        path.write_text(_file_text(without_none(self.table())), encoding="utf-8")
        return path

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scene) and self.table() == other.table()

    __hash__ = None  # type: ignore[assignment]  # as of other tables

    def __reduce__(self) -> tuple[Any, ...]:
        """Scenes are pickled as what they were made from."""
        if isinstance(self._source, tuple):
            path, before = self._source
            return type(self).load, (path if not path.is_file() else path.resolve(), before)
        return type(self), (self._source, self._folder.resolve())


def plain(value: Any) -> Any:
    """Returns a value in which numbers, arrays, paths and meshes are such as scenes take."""
    if isinstance(value, Mapping):
        return {key: plain(each) if key not in ("points", "tets", "groups") else each for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    return value.checked if isinstance(value, Mesh) else value


def without_none(value: Any) -> Any:
    """Returns a table without keys that have no value, for which TOML has no word."""
    if isinstance(value, dict):
        return {key: without_none(each) for key, each in value.items() if each is not None}
    return [without_none(each) for each in value] if isinstance(value, list) else value


def _file_text(table: Mapping[str, Any]) -> str:
    """Returns a table as a scene file: tables of tables with headings, all within them in one line each."""
    parts = [_lines({k: v for k, v in table.items() if not _has_heading(v)})]
    for key, value in table.items():
        if not _has_heading(value):
            continue
        for each in value if isinstance(value, list) else [value]:
            inner = each.get("effects") if isinstance(value, list) else None
            heading = f"[[{key}]]" if isinstance(value, list) else f"[{key}]"
            parts.append(f"{heading}\n{_lines({k: v for k, v in each.items() if k != 'effects' or inner is None})}")
            if inner is not None:
                parts.append(f"[{key}.effects]\n{_lines(inner)}")
    return "\n".join(parts)


def _has_heading(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(f"{_key(key)} = {toml(value)}\n" for key, value in table.items())


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)
