# SPDX-License-Identifier: MIT
"""`bench verification`: how much of its sag a body keeps as Poisson's ratio nears 0.5, by mesh and kind of elements.

Alone: `python -m tests.bench.verification.locking`.
"""

import tempfile
from pathlib import Path
from typing import Any, get_args

import meshio
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.mesh import bar as bar_mesh
from sim_server.mesh import read
from sim_server.scene.elements import Kind
from sim_server.simulation import Simulation
from tests.bench.verification.loads import settle, static_scene
from tests.bench.verification.row import Row, relative
from tests.reference.quadratic_statics import SAG, SIZE, Mesh10, with_mid_nodes

Reals = NDArray[np.float64]
MESHES = Path(__file__).parent / "meshes"
CELLS = (5, 5, 20)
YOUNG, DENSITY, GRAVITY = 1e6, 1000.0, 1e-3  # small: nothing but Hooke's law
SOURCE = "quadratic tetrahedra, 24,000, apart (tests/reference/quadratic_statics.py)"
UNKNOWN = (InputError, ValidationError)  # what a version says of elements and effects that it does not have
MOST = {"linear": 0.95, "patch": 0.3, "smoothed": 0.1, "quadratic": 0.1}  # of the sag, lost or too much


def meshes(quick: bool) -> dict[str, tuple[Reals, NDArray[Any]]]:
    """By name: of two splits and unstructured (made with Gmsh), nodes (n, 3) [m] and tetrahedra (m, 4)."""
    cells = (2, 2, 8) if quick else CELLS
    name = "x".join(map(str, cells))
    found = {}
    for split in ("kuhn", "mirrored"):
        box = bar_mesh(cells, SIZE, split)
        found[f"{name} cells, {split}"] = box.rest, box.tets
    for tets in (434,) if quick else (434, 5025):
        box = read(MESHES / f"box_{tets}.vtu")
        found[f"unstructured, {tets} tets"] = box.rest, box.tets
    return found


def mesh_table(folder: Path, rest: Reals, tets: NDArray[Any], kind: str) -> dict[str, str]:
    """Writes a mesh, for quadratic elements with mid-nodes; returns the `mesh` table of an object."""
    path = folder / "mesh.vtu"
    mesh = nodes_of(rest, tets, kind)
    meshio.Mesh(mesh.rest, [("tetra10" if kind == "quadratic" else "tetra", mesh.tets)]).write(path)
    return {"file": str(path)}


def nodes_of(rest: Reals, tets: NDArray[Any], kind: str) -> Mesh10:
    """A mesh of linear tetrahedra, with mid-nodes for quadratic elements, else as it is."""
    return with_mid_nodes(rest, tets) if kind == "quadratic" else Mesh10(rest, tets)


def body(
    rest: Reals, tets: NDArray[Any], kind: str, law: dict[str, Any], fixed: Any, gravity: Any = None,
    density: float = DENSITY,
) -> Simulation:  # fmt: skip
    """A body of one kind of elements without inertia. law: parameters of corotational; fixed: its table.

    Its nodes are those of `nodes_of`. Raises InputError or ValidationError for what this version does not have.
    """
    with tempfile.TemporaryDirectory() as folder:
        table = {
            "name": "bar", "mesh": mesh_table(Path(folder), rest, tets, kind), "elements": kind, "density": density,
            "effects": {"corotational": law, "fixed": fixed, "touch": {"max_force": 1e30}},
        }  # fmt: skip
        return static_scene(table, gravity, exact=1e-5)  # rounding of the largest Poisson's ratio is below


def kinds() -> list[str]:
    """Kinds of elements that this version can build."""
    box = bar_mesh((1, 1, 1), (1.0, 1.0, 1.0))
    found = []
    for kind in get_args(Kind):
        try:
            body(box.rest, box.tets, kind, {"young": YOUNG, "poisson": 0.3}, {"where": "Z < 0.01"})
        except UNKNOWN:
            continue
        found.append(kind)
    return found


def kept(rest: Reals, tets: NDArray[Any], kind: str, poisson: float) -> float:
    """Sag of a cantilever over what it should be."""
    law = {"young": YOUNG, "poisson": poisson}
    sim = body(rest, tets, kind, law, {"where": "Z < 1e-6"}, (0.0, -GRAVITY, 0.0))
    u = settle(sim)
    tip = sim.world.rest[:, 2] > SIZE[2] - 1e-6
    return float(-u[tip, 1].mean() * YOUNG / (DENSITY * GRAVITY) / SAG[poisson])


def ratios(quick: bool) -> list[dict[str, Any]]:
    """A line for each mesh and kind: the sag over what it should be, by Poisson's ratio."""
    found = []
    for name, (rest, tets) in meshes(quick).items():
        for kind in kinds():
            line: dict[str, Any] = {"mesh": name, "elements": kind}
            found.append(line | {f"ν = {poisson:g}": kept(rest, tets, kind, poisson) for poisson in SAG})
    return found


def rows(lines: list[dict[str, Any]], quick: bool) -> list[Row]:
    """Those of the largest Poisson's ratio, and of 0.3. quick: of coarse meshes, which may be off by more."""
    found, times = [], 1.5 if quick else 1.0
    for line in lines:
        for poisson in (0.3, 0.4999):
            case = f"sag of a cantilever, ν = {poisson:g}, {line['mesh']}, {line['elements']} elements (locking)"
            found.append(relative(case, 1, line[f"ν = {poisson:g}"], times * MOST[line["elements"]], SOURCE))
    return found


if __name__ == "__main__":
    for found in ratios(quick=False):
        print(*(f"{value:.3f}" if isinstance(value, float) else value for value in found.values()), sep=" | ")
