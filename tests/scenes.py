# SPDX-License-Identifier: MIT
"""Scenes made in a test: short tables instead of files."""

from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from protocol.factor import FactorPattern
from sim_server.effects.corotational import Corotational
from sim_server.mesh import bar as bar_mesh
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.reference.corotational import Solid


def bar(cells: tuple[int, int, int] = (4, 2, 2), size: tuple[float, float, float] = (2, 1, 1), **table: Any) -> dict:
    """An [[object]]: a bar along x. young, poisson, rotation, tangent, fixed (an expression), damping (mass,
    stiffness), touch; other keys go into the table as they are."""
    table = {"name": "bar", "elements": "linear", **table}
    effects: dict[str, Any] = {}
    if table.setdefault("young", 1e5) is not None:
        effects["corotational"] = {"young": table["young"], "poisson": table.pop("poisson", 0.3)}
        effects["corotational"] |= {key: table.pop(key) for key in ("rotation", "tangent") if key in table}
    if fixed := table.pop("fixed", None):
        effects["fixed"] = {"where": fixed}
    if damping := table.pop("damping", None):
        effects["rayleigh"] = {"mass": damping[0], "stiffness": damping[1]}
    if touch := table.pop("touch", None):
        effects["touch"] = touch
    del table["young"]
    table.setdefault("mesh", {"bar": list(cells), "size": list(size), "split": "kuhn"})
    return {"effects": effects, **table}


def scene(
    *objects: dict, dt: float = 0.02, gravity: tuple[float, float, float] | None = None, record: dict | None = None,
    integrator: dict | None = None, **solver: Any,
) -> Scene:  # fmt: skip
    """Checked, as if read from a file. Keyword arguments left over are the [solver] table."""
    effects = {"gravity": {"g": list(gravity)}} if gravity else {}
    table = {"name": "test", "dt": dt, "effects": effects, "solver": solver, "object": list(objects)}
    table |= {"integrator": integrator} if integrator else {}
    return Scene.model_validate(table | ({"record": record} if record else {}), context={"folder": "."})


def simulation(*objects: dict, **table: Any) -> Simulation:
    """Of `scene(...)`, on the CPU."""
    return Simulation(scene(*objects, **table))


def mesh_file(folder: Path, rest: NDArray, tets: NDArray, name: str = "mesh") -> dict[str, str]:
    """The `mesh` table of an object with this very mesh."""
    path = folder / f"{name}.vtu"
    meshio.Mesh(np.asarray(rest, float), [("tetra", np.asarray(tets))]).write(path)
    return {"file": str(path)}


def jittered_bar(cells: tuple[int, int, int], size: tuple[float, float, float], seed: int = 0) -> tuple:
    """(rest, tets) of a bar whose nodes inside are moved at random, so that no two elements are alike."""
    mesh = bar_mesh(cells, size, "kuhn")
    rest, cell = mesh.rest.copy(), np.array(size) / cells
    inside = interior(rest, size)
    random = np.random.default_rng(seed)
    rest[inside] += random.uniform(-0.2, 0.2, (np.count_nonzero(inside), 3)) * cell
    return rest, mesh.tets


def interior(rest: NDArray, size: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Nodes off the surface of a bar, (n,)."""
    return np.asarray(((rest > 1e-9) & (rest < np.array(size) - 1e-9)).all(axis=1))


def factor_of(sim: Simulation, body: int = 0, dtype: Any = np.float64) -> tuple[FactorPattern, NDArray]:
    """Cholesky factor of the matrix of a body as last assembled: pattern and values."""
    b = sim.world.bodies[body]
    analysis = Analysis(*sim.system.body_pattern(b.first, b.last))
    return analysis.pattern, analysis.factorize(sim.system.body_values(b.first, b.last), dtype)


def rotation(axis: Any, angle: float) -> NDArray[np.float64]:
    """Rotation (3, 3) about `axis` by `angle` [radians] (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def random_rotations(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Uniformly distributed, (count, 3, 3)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None, :]
    return q * np.linalg.det(q)[:, None, None]


def elastic(sim: Simulation) -> Corotational:
    """The elements of a scene."""
    return next(e for e in sim.effects.values() if isinstance(e, Corotational))


def solid(sim: Simulation, body: int = 0) -> Solid:
    """A body as the plain reference sees it, in its present state (copied)."""
    b, w = sim.world.bodies[body], sim.world
    young, poisson = elastic(sim).elastic[body]
    rayleigh, gravity = b.effects.get("rayleigh"), sim.scene.effects.get("gravity")
    return Solid(
        b.mesh.rest, b.mesh.tets, young, poisson, w.mass[b.nodes].copy(), w.free[b.nodes].copy(), w.x[b.nodes].copy(),
        w.v[b.nodes].copy(), w.dt, getattr(rayleigh, "mass", 0.0), getattr(rayleigh, "stiffness", 0.0),
        getattr(gravity, "g", (0.0, 0.0, 0.0)), b.effects["corotational"].rotation,
        b.effects["corotational"].tangent == "exact",
    )  # fmt: skip
