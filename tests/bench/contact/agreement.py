# SPDX-License-Identifier: MIT
"""The same again: on a GPU as on a CPU, and from a log."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import Row
from tests.bench.contact.ladder import line
from tests.bench.contact.pairs import stack
from tests.bench.harness.schemes import SCENES
from tests.contact.scenes import D, over
from tests.system.server_process import Stage
from tests.system.test_replay_of_a_server import replayed

STARTS: dict[str, dict[str, Any]] = {
    "slides": {"velocity": (2, 0, 0), "friction": 0.1},
    "tumbles": {"at": (0, 0.05, 0), "rotate": (20, 0, 35), "velocity": (1, -2, 0)},
    "is thrown down": {"at": (0, 0.02, 0), "velocity": (0, -10, 0)},
}
TIGHT = {"thickness": D, "tolerance": 1e-8, "passes": 200}
EXACT = {"preconditioner": "block_jacobi", "tolerance": 1e-10, "max_iterations": 2000}


def devices() -> list[Row]:
    """A GPU beside the CPU: as by default, and where both solve exactly."""
    found = []
    for start, table in STARTS.items():
        name = f"block that {start}: GPU against CPU, "
        found.append(line(name + "40 steps, positions [m]", 0, _apart(40, table), 2e-5))
        exact = _apart(15, table | {"contact": TIGHT, "solver": EXACT})
        found.append(line(name + "tight tolerances, 15 steps, positions [m]", 0, exact, 1e-8))
    return found


def stacks() -> list[Row]:
    """The same for bodies that touch each other."""
    exact = {"contact": TIGHT, "solver": EXACT}
    return [
        line(f"stack of {n}: GPU against CPU, tight tolerances, 15 steps, positions [m]", 0,
             _apart(15, exact, partial(stack, n)), 1e-7)
        for n in (2, 4)
    ]  # fmt: skip


def _apart(steps: int, table: dict[str, Any], make: Callable[..., Simulation] = over) -> float:
    """Largest difference of positions in any step."""
    sims = [make(device=device, **table) for device in ("gpu", "cpu")]
    drivers, apart = [Driver(sim) for sim in sims], 0.0
    for _ in range(steps):
        for driver in drivers:
            driver.advance(1)
        apart = max(apart, float(np.abs(sims[0].fetch().x - sims[1].world.x).max()))
    return apart


def replays(device: str = "cpu", steps: int = 300) -> list[Row]:
    """Servers and workers in processes of their own, one of which is killed; their logs are simulated again."""
    names = ("stairs", "gripper") + (("two_organs",) if device == "cpu" else ())
    found = [_replay(name, device, steps, killed=False) for name in names]
    return [*found, _replay("stairs", device, steps, killed=True)]


def _replay(name: str, device: str, steps: int, killed: bool) -> Row:
    """As fast as it goes, or in real time with a worker that is killed after a third of the steps."""
    with TemporaryDirectory() as folder:
        stage, log = Stage(Path(folder)), Path(folder) / "run.mcap"
        options = ("--steps", str(steps), "--record", str(log), "--device", device)
        try:
            scene = SCENES / f"{name}.toml"
            server = stage.server(scene, *options, *(() if killed else ("--workers", "1", "--free-run")))
            if killed:
                worker = stage.worker()
                with stage.client() as client:
                    while client.status().step < steps / 3:
                        time.sleep(0.01)
                worker.kill()
            if server.wait() != 0:
                raise RuntimeError(server.output()[-500:])
        finally:
            stage.close()
        told = replayed(log, 0, timeout=600)
    how = "a worker killed on the way" if killed else "a worker process"
    case = f"{name}.toml with {how}, {device}: steps of {steps} repeated from the log to the bit"
    return line(case, steps, float(told["steps"] if told["same"] else 0), 0.0)
