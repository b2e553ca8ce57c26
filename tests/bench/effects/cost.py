# SPDX-License-Identifier: MIT
"""What an effect adds to a step: a scene with it and the same without, side by side in one process."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.explain.explanation import Asked, explain
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.support.effect_samples import Cells, write_scene

FACTOR = 'preconditioner = "cholesky"\nupdate = "every-1"'
BATCH = 10  # steps, after one that makes a factor: what it costs is not counted

Row = dict[str, Any]


@dataclass
class Runner:
    """A scene that makes batches of steps. seconds, iterations: of a step, of each batch."""

    simulation: Simulation
    driver: Driver
    seconds: list[float]
    iterations: list[float]

    @classmethod
    def of(cls, path: Path) -> "Runner":
        simulation = Simulation.load(path)
        driver = Driver(simulation)
        driver.advance(3)
        return cls(simulation, driver, [], [])

    def batch(self) -> None:
        """Makes a factor, then steps with it on the processor's clock."""
        self.driver.advance(1)
        begin = time.thread_time()
        self.simulation.engine.run(BATCH)
        self.seconds.append((time.thread_time() - begin) / BATCH)
        self.iterations.append(float(self.simulation.engine.records()["iterations"].mean()))


def cost(name: str, cells: Cells, rounds: int, folder: Path) -> Row:
    """Returns what an effect costs."""
    paths = []
    for listed in (False, True):
        paths.append(folder / f"{name}_{'with' if listed else 'without'}.toml")
        write_scene(paths[-1], name, cells, listed, FACTOR)
    asked: Asked = next(each for each in explain(paths[1]).asked if each.name == name)
    base, full = map(Runner.of, paths)
    for k in range(rounds):
        for each in (base, full) if k % 2 else (full, base):
            each.batch()
    ratios = np.array(full.seconds) / np.array(base.seconds)
    low, high = np.percentile(1e3 * np.array(full.seconds), [10, 90])
    return {
        "effect": name, "ms": 1e3 * float(np.median(full.seconds)), "10 … 90 %": f"{low:.3g} … {high:.3g}",
        "without, ms": 1e3 * float(np.median(base.seconds)), "ratio": float(np.median(ratios)),
        "iterations": float(np.mean(full.iterations)), "iterations without": float(np.mean(base.iterations)),
        "launches": asked.launches, "kernels": sum(map(len, asked.kernels.values())), "bytes": asked.bytes,
        "keys and channels": len(asked.network) + len(asked.log),
    }  # fmt: skip
