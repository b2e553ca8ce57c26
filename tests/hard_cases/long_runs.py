# SPDX-License-Identifier: MIT
"""Long runs of small bodies: what drifts, what grows, and what a step costs at the end over that at the start."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar

Table = dict[str, Any]
PIECE = 1000  # steps between two looks


@dataclass(frozen=True)
class LongRun:
    """done, must: in words. steps: of the long form; period: of the load [steps], 0: none; spins: free, and measured by
    its momenta."""

    name: str
    done: str
    must: str
    scene: Table
    steps: int
    period: int = 0
    spins: bool = False
    most: float = 1e-6  # drift over the length, or change of momentum over what it was
    note: str = ""


@dataclass(frozen=True)
class LongOutcome:
    """drift: over the length, or of momenta; growth: of memory since the first tenth [MiB]; cost: processor time of a
    step in the last tenth over that in the second one; unsolved: steps that did not converge."""

    drift: float
    growth: float
    cost: float
    unsolved: int
    iterations: float

    def wrong(self, run: LongRun) -> list[str]:
        found = [f"drift {self.drift:.2g}"] if not self.drift <= run.most else []
        found += [f"{self.unsolved} steps not converged"] if self.unsolved else []
        return found + ([f"memory grew by {self.growth:.2g} MiB"] if self.growth > 2 else [])


def _scene(integrator: Table, held: bool, **solver: Any) -> Table:
    damping = {"damping": (1.0, 0.0)} if held else {}
    body = bar((4, 1, 1), (0.4, 0.1, 0.1), young=1e6, touch=True, **({"fixed": "X < 0.01"} if held else {}), **damping)
    solver = {"preconditioner": "cholesky", "update": "every-50", "tolerance": 1e-10} | solver
    gravity = {"gravity": {"g": [0, -9.81, 0]}} if held else {}
    return {
        "name": "long",
        "dt": 0.01,
        "object": [body],
        "effects": gravity,
        "integrator": integrator,
        "solver": solver,
    }


EULER, NEWTON = {"scheme": "backward_euler"}, {"linearizations": 10, "tolerance": 1e-9}
ALONE = {"preconditioner": "block_jacobi"}
AT_REST, LOADED = "drift, over the length, within", "drift from one period to the same place of a later one within"
KEPT = "linear and angular momentum, over what they were, change by at most"
ANGULAR = (
    "Newmark's scheme takes the forces of both ends of a step, so it keeps linear momentum to rounding, and angular "
    "momentum to within a bound that falls with the square of the step and does not grow; generalized_alpha takes "
    "those of its middle, which keep both (Simo, Tarnow 1992)."
)
LONG_RUNS = [
    LongRun("at rest", "a held bar that hangs under gravity", AT_REST, _scene(EULER, True, **ALONE), 1_000_000),
    LongRun("at rest, bdf2", "the same", AT_REST, _scene({"scheme": "bdf2"}, True, **ALONE), 100_000),
    LongRun("at rest, ros2", "the same", AT_REST, _scene({"scheme": "ros2"}, True), 100_000),
    LongRun("periodic load", "pushed for 25 of every 50 steps", LOADED, _scene(EULER, True), 100_000, period=50),
    *(
        LongRun(f"spin, {name}", "free, 5 rad/s", KEPT, _scene(table, False), 20_000, spins=True, most=most, note=note)
        for name, table, most, note in (
            ("newmark", NEWTON | {"scheme": "newmark"}, 2e-3, ANGULAR),
            ("generalized_alpha", NEWTON | {"scheme": "generalized_alpha", "spectral_radius": 1.0}, 1e-6, ""),
            ("ros2", {"scheme": "ros2"}, 1e-6, ""),
        )
    ),
]  # fmt: skip


def memory() -> float:
    """Memory of this process that is in use [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


def momenta(sim: Simulation) -> NDArray[np.float64]:
    """Linear [N s] and angular momentum about the centre of mass [N m s], (6,)."""
    w = sim.world
    arm = w.x - w.mass @ w.x / w.mass.sum()
    return np.concatenate([w.mass @ w.v, w.mass @ np.cross(arm, w.v)])


def _before(run: LongRun, sim: Simulation, driver: Driver) -> Callable[[int], None]:
    """Brings the body to where the run begins; returns what is done before a step."""
    w = sim.world
    if run.spins:
        w.v[:] = np.cross([0, 0, 5.0], w.x - w.mass @ w.x / w.mass.sum())
        w.v += [0.1, 0.2, 0.3]
        return lambda step: None
    for _ in range(0, 3000, PIECE):
        driver.advance(PIECE)
    if not run.period:
        return lambda step: None

    def push(step: int) -> None:
        assert sim.touch is not None
        if step % run.period == 0:
            sim.touch.push("test", "bar", (0.4, 0.1, 0.1), 0.0, (0, 20.0, 0), run.period / 2 * w.dt)

    return push


def run_long(run: LongRun, steps: int) -> LongOutcome:
    """So many steps, a multiple of 1000 and of the period."""
    sim = Simulation(Scene.model_validate(run.scene, context={"folder": "."}))
    driver = Driver(sim)
    before = _before(run, sim, driver)
    settled = 100 * run.period  # by then the motion has the period of the load
    for step in range(settled):
        before(step)
        driver.advance(1)
    length, start, first = float(np.ptp(sim.world.rest, axis=0).max()), sim.world.x.copy(), momenta(sim)
    drift, cost, used, unsolved, iterations = 0.0, [], [], 0, 0
    for done in range(0, steps, PIECE):
        if run.period:
            found = []
            for step in range(settled + done, settled + done + PIECE):
                before(step)
                found.append(driver.advance(1))
            records = np.concatenate(found)
        elif driver.wants_factors:
            records = driver.advance(PIECE)
        else:  # the loop on its own
            sim.engine.run(PIECE)
            records = driver.pump()
        off = np.abs(momenta(sim) - first) if run.spins else np.abs(sim.world.x - start)
        scales = np.repeat([np.linalg.norm(first[:3]), np.linalg.norm(first[3:])], 3) if run.spins else length
        drift = max(drift, float((off / scales).max()))
        unsolved += int((records["status"] != 0).sum())
        iterations += int(records["iterations"].sum())
        cost.append(float(np.median(records["cpu"])))
        used.append(memory())
    tenth = max(1, len(cost) // 10)
    ratio = float(np.median(cost[-tenth:]) / np.median(cost[tenth : 2 * tenth] or cost))
    return LongOutcome(drift, used[-1] - used[tenth - 1], ratio, unsolved, iterations / steps)
