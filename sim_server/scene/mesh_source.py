# SPDX-License-Identifier: MIT
"""The key `mesh` of an object: a bar, a file, a surface to be filled, shapes, or arrays."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from sim_server.errors import InputError
from sim_server.mesh import Mesh, bar, check, read
from sim_server.scene.parameters import Counts, File, Parameters, Positive, Sizes, complaint
from sim_server.scene.shapes import Sdf

log = logging.getLogger(__name__)

LARGE = 50.0  # m; a body of a file that is larger is asked about
SOURCES = ("bar", "file", "surface", "sdf", "data")
BESIDE = {  # keys that go with some sources alone: needed, allowed
    "bar": ("size",), "file": (), "surface": ("edge",), "sdf": ("edge",), "data": (),
}  # fmt: skip
OPTIONAL = {"split": ("bar",), "scale": ("file", "surface"), "envelope": ("surface",)}


class MeshSource(Parameters):
    """Source of a mesh: { bar, size }, { file }, { surface, edge }, { sdf, edge }, { points, tets } or { data }."""

    bar: Counts | None = Field(default=None, description="cells along x, y, z; each is split into 6 tetrahedra")
    size: Sizes | None = Field(default=None, description="size of the bar along x, y, z [m]")
    split: Literal["kuhn", "mirrored"] | None = Field(
        default=None,
        description="split of the cells of a bar: mirrored (default), or kuhn, which bends less, with a twist",
    )
    scale: Positive | None = Field(
        default=None, description="scale of the coordinates in a file: 0.001 for a mesh in mm"
    )
    file: File | None = Field(default=None, description="a file that meshio reads")
    surface: File | None = Field(default=None, description="a closed surface in a file, to be filled with tetrahedra")
    sdf: Sdf | None = Field(default=None, description="a sphere, box, capsule or union of such")
    edge: Positive | None = Field(default=None, description="length of edges inside a surface or an sdf [m]")
    envelope: Positive | None = Field(
        default=None, description="farthest that nodes may be from the surface [m]; a thousandth of its diagonal"
    )
    points: Any = Field(default=None, description="nodes at rest, (n, 3) [m], with tets")
    tets: Any = Field(default=None, description="their numbers from 0, (m, 4)")
    groups: Any = Field(default=None, description="names of elements and nodes, beside points and tets")
    data: str | None = Field(default=None, description="points, tets and groups as a scene keeps them, as text")

    @model_validator(mode="before")
    @classmethod
    def _of_arrays(cls, table: Any) -> Any:
        """Turns a mesh, or points and tets, into `data`, so that a log has all of it."""
        if isinstance(table, Mesh):
            from sim_server.mesh.arrays import packed

            return {"data": packed(table)}
        if not isinstance(table, Mapping) or not table.keys() & {"points", "tets", "groups"}:
            return table
        from sim_server.mesh.arrays import mesh_of, packed

        given = {key: table[key] for key in ("points", "tets", "groups") if table.get(key) is not None}
        others = {key: value for key, value in table.items() if key not in ("points", "tets", "groups")}
        if "points" not in given or "tets" not in given:
            raise complaint(f"needs points and tets, not {' and '.join(given) or 'none'}")
        if any(value is not None for value in others.values()):
            raise complaint(f"points and tets stand alone, without {' and '.join(sorted(others))}")
        try:
            return {"data": packed(mesh_of(**given))}
        except InputError as error:
            raise complaint(str(error).removeprefix("mesh arrays: ")) from None

    @model_validator(mode="before")
    @classmethod
    def _named_split(cls, table: Any) -> Any:
        """Names the split of a bar, so that a log or a checkpoint tells it whatever the default is when it is read."""
        if isinstance(table, dict) and table.get("bar") is not None and table.get("split") is None:
            return {**table, "split": "mirrored"}
        return table

    @model_validator(mode="after")
    def _one_source(self) -> "MeshSource":
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if "split" in given and "bar" not in given:
            raise complaint("split belongs to a bar")
        if "scale" in given and not {"file", "surface"} & {*given}:
            raise complaint("scale belongs to a file; a bar has its size in m")
        source = next((name for name in SOURCES if name in given), "bar")
        needed = {source, *BESIDE[source]}
        allowed = needed | {key for key, sources in OPTIONAL.items() if source in sources}
        if not needed <= {*given} <= allowed:
            raise complaint(
                "must be { bar = [nx, ny, nz], size = [sx, sy, sz] }, { file = ... }, { surface = ..., edge = m }, "
                f"{{ sdf = {{ ... }}, edge = m }} or {{ points = ..., tets = ... }}, not {given}"
            )
        return self

    def read(self, mid_nodes: bool) -> Mesh:
        """Returns the checked mesh at rest, before the pose. mid_nodes: keeps those of a file. Raises InputError."""
        if self.file is not None:
            mesh = read(self.file, mid_nodes)
            return self._asked_about(check(replace(mesh, rest=mesh.rest * (self.scale or 1.0))))
        if self.surface is not None:
            from sim_server.mesh.fill import filled

            assert self.edge is not None
            return self._asked_about(filled(self.surface, self.edge, self.envelope, self.scale or 1.0))
        if self.sdf is not None:
            from sim_server.mesh.stuffing import stuffed

            assert self.edge is not None
            low, high = self.sdf.bounds()
            return check(Mesh(*stuffed(self.sdf.distances, low, high, self.edge), "sdf"))
        if self.data is not None:
            from sim_server.mesh.arrays import unpacked

            return unpacked(self.data)
        assert self.bar is not None and self.size is not None and self.split is not None
        return bar(self.bar, self.size, self.split)

    def _asked_about(self, mesh: Mesh) -> Mesh:
        """Warns of a body of a size that is one in mm, where the scene does not say otherwise."""
        extent = np.ptp(mesh.rest, axis=0)
        if self.scale is None and extent.max() > LARGE:
            size = " x ".join(f"{length:.4g}" for length in extent)
            name = Path(self.file or self.surface or "").name
            log.warning(
                "mesh %s: its size is %s m. Is the file in mm? Then mesh.scale = 0.001, if in m mesh.scale = 1",
                name,
                size,
            )
        return mesh
