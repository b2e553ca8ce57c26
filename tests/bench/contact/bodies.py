# SPDX-License-Identifier: MIT
"""The block of the benchmark, what happens to it, the solvers that are compared, and runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import block, floor, over

Row = dict[str, Any]
Reals = NDArray[np.float64]
G = 9.81
DT = 1 / 60  # s
CELLS = {540: (6, 3, 5), 3000: (10, 5, 10), 24_000: (20, 10, 20)}  # by number of tetrahedra; y is up
SIZE = (0.1, 0.06, 0.1)  # m
LATENCY = {540: 3, 3000: 3, 24_000: 20}  # steps from a matrix to its factor, about those of a worker process
LOCKSTEP: dict[str, Any] = {"preconditioner": "cholesky", "update": "lockstep-3", "max_iterations": 5000}
FACTOR, FIRST, JACOBI = "factor", "first factor", "block Jacobi"


def solvers(tets: int) -> dict[str, dict[str, Any]]:
    """[solver] tables by the names that the page has for them."""
    return {
        FACTOR: LOCKSTEP | {"update": f"lockstep-{LATENCY[tets]}"}, FIRST: LOCKSTEP | {"update": "never"},
        JACOBI: {"preconditioner": "block_jacobi", "max_iterations": 5000},
    }  # fmt: skip


def thickness(tets: int) -> float:
    """The default: a tenth of the shortest edge [m]."""
    return 0.1 * min(s / n for s, n in zip(SIZE, CELLS[tets], strict=True))


@dataclass(frozen=True)
class Situation:
    """A block of some size over a floor, or over another obstacle.

    skipped: steps before those that count. friction: of both
    """

    name: str
    steps: int
    skipped: int = 0
    friction: float = 0.5
    velocity: tuple[float, float, float] = (0, 0, 0)
    height: float = 0.0  # over the thickness [m]
    rotate: tuple[float, float, float] = (0, 0, 0)

    def simulation(
        self, tets: int, solver: dict[str, Any], kappa: float = 1.0, obstacle: Row | None = None, bodies: int = 1,
        device: str = "cpu",
    ) -> Simulation:  # fmt: skip
        """On a floor, if nothing else is given. Several bodies stand apart."""
        bottom = obstacle or floor(self.friction)
        blocks = [
            block(self.friction, CELLS[tets], SIZE, name=f"b{k}", rotate=self.rotate,
                  at=(0, thickness(tets) + self.height, 0.3 * k))
            for k in range(bodies)
        ]  # fmt: skip
        contact = {"stiffness": kappa} | ({"between": False} if device == "gpu" else {})
        return over(bottom, objects=blocks, velocity=self.velocity, dt=DT, contact=contact, solver=solver,
                    device=device)  # fmt: skip


REST = Situation("rest", 60, skipped=60)
SLIDING = Situation("sliding", 40, skipped=10, friction=0.3, velocity=(3, 0, 0))
IMPACT = Situation("impact without friction", 40, friction=0.0, velocity=(0, -3, 0), height=0.3)
TUMBLING = Situation("tumbling", 60, height=0.15, rotate=(30, 20, 40))
SITUATIONS = (REST, SLIDING, IMPACT, TUMBLING)


def run_with_forces(sim: Simulation, steps: int) -> tuple[NDArray[Any], Reals]:
    """Makes steps; returns their records, and force and torque on the first obstacle by the first body, (steps, 6)."""
    driver = Driver(sim)
    records = driver.advance(steps)
    return records, driver.reactions[:: len(sim.world.bodies), 0]


def times(records: NDArray[Any], device: str = "cpu") -> Reals:
    """Of steps [ms]: of the loop's thread by its own clock, on a GPU of the device."""
    return 1e3 * np.asarray(records["cpu" if device == "cpu" else "whole"], dtype=float)


def milliseconds(records: NDArray[Any], device: str = "cpu") -> Row:
    """What a step takes."""
    return of_times(times(records, device))


def of_times(ms: Reals) -> Row:
    """p50, p99 and the most."""
    return {"p50 ms": float(np.median(ms)), "p99 ms": float(np.percentile(ms, 99)), "most ms": float(ms.max())}


def several(records: NDArray[Any], bodies: int) -> NDArray[Any]:
    """Records of the first body of each step, with the most iterations, passes and all contacts of the bodies."""
    found = records[::bodies].copy()
    found["iterations"] = records["iterations"].reshape(-1, bodies).max(axis=1)
    found["passes"] = records["passes"].reshape(-1, bodies).max(axis=1)
    found["contacts"] = records["contacts"].reshape(-1, bodies).sum(axis=1)
    return found


def pillar(x: Sequence[float], z: Sequence[float], top: float = 0.0) -> Row:
    """A box whose upper face covers ranges of x and z."""
    size = [x[1] - x[0], 0.5, z[1] - z[0]]
    return {
        "name": "pillar", "shape": "box", "size": size,
        "pose": {"translate": [(x[0] + x[1]) / 2, top - 0.25, (z[0] + z[1]) / 2]},
    }  # fmt: skip
