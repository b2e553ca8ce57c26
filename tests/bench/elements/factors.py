# SPDX-License-Identifier: MIT
"""`bench elements`: iterations with factors that are so many steps old, by kind of elements."""

from typing import Any

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.harness.schemes import SCENES

AGES = (3, 10, 30)  # steps
TETS = {"linear": 1429, "patch": 1429, "smoothed": 1429, "quadratic": 218}  # with about as many nodes
HOW = """\
The same bar in backward Euler of 10 ms, on an unstructured mesh of 1429 tetrahedra, or 218 quadratic ones, which have
about as many nodes. Mean number of iterations of conjugate gradients under lockstep-3, -10 and -30, which take up a
factor so many steps after its matrix, from the first one on: the bar falls and swings; – where a solve did not
converge."""


def iterations(kind: str, mesh: str, poisson: float, age: int, steps: int) -> float | None:
    """Mean over the steps with a factor of that age; None where a solve did not converge."""
    sim = Simulation.load(SCENES / "beam.toml", [
        f"object.beam.mesh={mesh}", f"object.beam.elements={kind}", "dt=0.01",
        f"object.beam.effects.corotational={{ young = 1e6, poisson = {poisson} }}",
        "solver.preconditioner=cholesky", f"solver.update=lockstep-{age}",
    ])  # fmt: skip
    records = Driver(sim).advance(steps)
    return None if records["status"].any() else float(records["iterations"][age:].mean())


def table(meshes: dict[str, str], ratios: tuple[float, ...], steps: int) -> list[dict[str, Any]]:
    """A line for each Poisson's ratio and kind. meshes: `mesh` table of an object by kind."""
    return [
        {"ν": poisson, "elements": kind}
        | {f"lockstep-{age}": iterations(kind, mesh, poisson, age, steps) for age in AGES if age < steps}
        for poisson in ratios
        for kind, mesh in meshes.items()
    ]
