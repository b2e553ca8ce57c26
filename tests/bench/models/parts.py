# SPDX-License-Identifier: MIT
"""The models of the benchmark: one beam each, bent or stretched, and the launches of a step up to the solve."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.cpu.device import Cpu
from sim_server.effects import effect, known_effects
from sim_server.effects._base import Effect
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.bench.gpu.problem import BARS

BULK = 3e6  # Pa
TABLES: dict[
    str, tuple[str, dict[str, Any]]
] = {  # of a row: its effect and the parameters; about as stiff as one another
    "corotational, polar": ("corotational", {"young": 1e6, "poisson": 0.45}),
    "corotational, qr": ("corotational", {"young": 1e6, "poisson": 0.45, "rotation": "qr"}),
    "corotational, exact tangent": ("corotational", {"young": 1e6, "poisson": 0.45, "tangent": "exact"}),
    "mass_spring": ("mass_spring", {"young": 1e6}),
    "st_venant_kirchhoff": ("st_venant_kirchhoff", {"young": 1e6, "poisson": 0.45}),
    "neo_hookean": ("neo_hookean", {"young": 1e6, "poisson": 0.45}),
    "stable_neo_hookean": ("stable_neo_hookean", {"young": 1e6, "poisson": 0.45}),
    "mooney_rivlin": ("mooney_rivlin", {"c1": 1.5e5, "c2": 2e4, "bulk": BULK}),
    "arruda_boyce": ("arruda_boyce", {"shear": 3e5, "segments": 8.0, "bulk": BULK}),
    "veronda_westmann": ("veronda_westmann", {"c1": 8e4, "c2": 2.0, "bulk": BULK}),
    "ogden": ("ogden", {"mu": [4e5, 1e4], "alpha": [1.3, 5.0], "bulk": BULK}),
    "costa": ("costa", {"a": 1e5, "bulk": BULK, "fibre": [0, 0, 1], "sheet": [1, 0, 0]}),
    "neo_hookean and fibres": ("fibres", {"stiffness": 1e5, "exponent": 1.0, "direction": [0, 0, 1]}),
}
BESIDE = {
    "fibres": {"neo_hookean": {"young": 1e6, "poisson": 0.45}}
}  # what an effect is listed beside, and measured with
PARTS = ("elements", "sums", "rest")
OTHERS = {
    "buoyancy",
    "cable",
    "cavity",
    "contact",
    "cutting",
    "damage",
    "fixed",
    "gravity",
    "growth",
    "membrane",
    "muscle",
    "plasticity",
    "poroelasticity",
    "prony",
    "rayleigh",
    "rod",
    "target",
    "touch",
    "traction",
    "wind",
}  # fmt: skip; effects that are no models, or stand beside one (bench effects)
STRETCH, CURVATURE, NOISE = 1.05, 0.15, 0.01  # -, 1/m, of an edge

Reals = NDArray[np.float64]


def missing() -> list[str]:
    """Effects of the registry that have elements and no row here."""
    return sorted(set(known_effects()) - OTHERS - {name for name, _ in TABLES.values()})


def present() -> list[str]:
    """Rows whose effects there are."""
    return [row for row, (name, _) in TABLES.items() if name in known_effects()]


class Model(NamedTuple):
    """A beam of one model. launches: of a step, up to the solve."""

    name: str
    tets: int
    simulation: Simulation
    effect: Effect
    launches: Sequence[Any]

    def put(self, x: Reals, v: Reals) -> None:
        """Positions and velocities, on the device too."""
        world = self.simulation.world
        world.x[:], world.v[:] = x, v
        if not isinstance(world.backend, Cpu):
            for array in (world.x, world.v):
                twin = world.backend.twin(array)
                twin.set(array.astype(twin.dtype))


def model(name: str, tets: int, device: str = "cpu", precision: str = "float64", **solver: Any) -> Model:
    """A row at one size: 4 m along z, 1 m wide, dt 30 ms."""
    key, table = TABLES[name]
    assert effect(key).SCOPE == "object"
    beam = {
        "name": "beam",
        "mesh": {"bar": list(BARS[tets]), "size": [1.0, 1.0, 4.0], "split": "kuhn"},
        "elements": "linear",
        "effects": {key: table, **BESIDE.get(key, {})},
    }
    solver = {"preconditioner": "none", "precision": precision, **solver}
    scene = Scene.model_validate(
        {"name": "models", "dt": 0.03, "solver": solver, "object": [beam]}, context={"folder": Path.cwd()}
    )
    sim = Simulation(scene, device)
    found = next(e for name, e in sim.effects.items() if e.elements is not None and name.startswith(key))
    return Model(name, tets, sim, found, sim.launches()[0])


def states(rest: Reals, cells: int) -> dict[str, tuple[Reals, Reals]]:
    """x and v of the two shapes: bent (curvature 0.15 / m: 7.5 % at the faces, half of it pressed) and stretched (5 %).

    cells: over the width; nodes are moved by a hundredth of an edge beside that.
    """
    random = np.random.default_rng(4)
    noise = NOISE / cells * random.normal(size=rest.shape)
    v = random.normal(size=rest.shape)
    angle, radius = CURVATURE * rest[:, 2], 1 / CURVATURE + rest[:, 1] - 0.5
    bent = np.stack([rest[:, 0], radius * np.cos(angle) - 1 / CURVATURE, radius * np.sin(angle)], axis=1)
    return {"bent": (bent + noise, v), "stretched": (STRETCH * rest + noise, v)}


def part(launch: Any) -> str:
    """Of a step: elements, sums over them, or the rest (what every step does node by node and block by block)."""
    kernel = launch.name.split(".")[1]
    if kernel in ("gather", "blocks"):
        return "sums"
    return "rest" if kernel in ("start", "rotate", "rotate_blocks", "match") else "elements"


def megabytes(kernel: Any) -> float:
    """Of the arrays of a kernel, each counted once: what has to move if nothing stays in caches."""
    launches = getattr(kernel, "_launches", [kernel])  # several, put together on a GPU
    return sum({id(array): array.nbytes for x in launches for array in x.arrays.values()}.values()) / 1e6
