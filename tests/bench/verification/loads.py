# SPDX-License-Identifier: MIT
"""Static problems of `bench verification`: bodies in equilibrium under forces on their nodes."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.effects.touch import Interaction, Touch
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, mesh_file, simulation

Reals = NDArray[np.float64]
Group = tuple[NDArray[Any], Sequence[float]]
FOR_EVER = 1e30  # s
NEWTON = {"scheme": "quasi_static", "linearizations": 60, "tolerance": 1e-8, "trials": 0}


def statics(
    rest: Reals, tets: NDArray[Any], law: dict[str, Any], fixed: str, gravity: Any = None,
    slender: bool = True,
) -> Simulation:  # fmt: skip
    """A body without inertia, each step to 1e-8 of its first residual, with exact tangents. slender: one that bends far
    without much strain, with full steps; else with a line search."""
    with tempfile.TemporaryDirectory() as folder:
        mesh = mesh_file(Path(folder), rest, tets)
        o = bar(mesh=mesh, young=None, fixed=fixed, touch={"max_force": 1e30})
        o["effects"] |= law
        return static_scene(o, gravity, slender)


def static_scene(
    table: dict[str, Any], gravity: Any = None, slender: bool = True, exact: float = 1e-8
) -> Simulation:  # fmt: skip
    """The same of the table of an object, each step to `exact` of its first residual."""
    preconditioner, newton = ("cholesky", NEWTON) if slender else ("block_jacobi", NEWTON | {"trials": 8})
    return simulation(
        table, gravity=gravity, integrator=newton | {"tolerance": exact}, dt=1.0, update="every-1",
        preconditioner=preconditioner, factor_precision="float64", tolerance=0.1 * exact, max_iterations=3000,
        projection="none",
    )  # fmt: skip


def push(sim: Simulation, groups: Sequence[Group]) -> None:
    """Forces that stay, in place of those before: nodes (k,) and the force on all of them together (3,) [N]."""
    touch = cast(Touch, sim.effects["touch"])
    touch.restore(
        [
            Interaction(
                k + 1, "bench", "bar", (0.0, 0.0, 0.0), 0.0, nodes.astype(np.int32), np.zeros((len(nodes), 3)),
                FOR_EVER, force=(float(force[0]), float(force[1]), float(force[2])),
            )
            for k, (nodes, force) in enumerate(groups)
        ]
    )  # fmt: skip


def settle(sim: Simulation, driver: Driver | None = None, steps: int = 3) -> Reals:
    """Displacements (nodes, 3) [m] in equilibrium, after as many steps as it takes; raises ArithmeticError."""
    driver = driver or Driver(sim)
    for _ in range(steps):
        if driver.advance(1)[-1]["status"] == 0:
            return np.asarray(sim.world.x - sim.world.rest)
    raise ArithmeticError("no equilibrium was found")


def raised(sim: Simulation, groups: Sequence[Group], parts: int) -> Reals:
    """The same under loads raised in so many equal parts."""
    driver, u = Driver(sim), np.zeros(0)
    for part in range(1, parts + 1):
        push(sim, [(nodes, [part / parts * f for f in force]) for nodes, force in groups])
        u = settle(sim, driver)
    return u
