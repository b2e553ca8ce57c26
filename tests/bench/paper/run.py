# SPDX-License-Identifier: MIT
"""One run of a beam of the paper's tables under one scheme, step by step."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.stats import flops
from tests.bench.paper.beam import Beam, Load
from tests.bench.paper.building import BuildingInline
from tests.support.virtual_workers import VirtualWorkers

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Way:
    """A preconditioner and when it is renewed."""

    preconditioner: str
    update: str = "never"
    warp: bool = False
    latency: int = 0  # async and adaptive: steps that the one worker takes for a factor
    extrapolate: float = 0.0  # s

    @property
    def solver(self) -> dict[str, Any]:
        table: dict[str, Any] = {"preconditioner": self.preconditioner, "update": self.update, "warp": self.warp}
        return table | ({"build": "worker", "extrapolate": self.extrapolate} if self.extrapolate else {})


@dataclass
class Run:
    """Step by step (k,), times in ms. invert: making a preconditioner that the step waits for."""

    iterations: Reals
    solve: Reals
    step: Reals  # without invert
    invert: Reals
    unconverged: int
    cpu: Reals  # processor time of the step, all of it
    kinds: list[str]  # preconditioner of each step
    factorize: list[float] = field(default_factory=list)  # of each factor that was made, ms


def run(beam: Beam, load: Load, way: Way, steps: int, device: str = "cpu", **solver: Any) -> Run:
    """Asynchronous schemes begin with the factor of the first matrix, as those that wait for it do (it is not counted
    in `invert`)."""
    sim = beam.simulation(load, device, **way.solver, **solver)
    source = BuildingInline(sim) if way.extrapolate else _worker(sim, way.latency) if way.latency else None
    driver = Driver(sim, source, counted=True)
    made: list[float] = []  # ms
    driver.on_adopt.append(lambda factor: made.append(1e3 * factor.seconds))
    early = driver.wants_factors and driver.solver.update.kind in ("lockstep", "async", "adaptive")
    first = [driver.step_with_fresh_factors()] if early else []
    r = np.concatenate([*first, driver.advance(steps - len(first))])
    own = r["assemble"] + r["solve"] + r["integrate"]
    invert = 1e3 * np.maximum(r["whole"] - own, 0)
    invert[: len(first)] = 0
    return Run(
        r["iterations"].astype(float), 1e3 * r["solve"], 1e3 * own, invert,
        int((r["status"] != 0).sum()), 1e3 * r["cpu"], [Kind(kind).name.lower() for kind in r["kind"]], made,
    )  # fmt: skip


def _worker(sim: Simulation, latency: int) -> VirtualWorkers:
    """One that takes so many steps for a factor."""
    body = sim.world.bodies[0]
    pattern = Analysis(*sim.system.body_pattern(body.first, body.last)).pattern
    return VirtualWorkers(sim, 1, 1.001 * flops(pattern) / latency)


@dataclass
class Mean:
    """Over the steps of a run that was made several times: iterations repeat, times are medians of the rounds'."""

    iterations: float
    most: int  # iterations of a step
    solve: float  # ms
    step: float  # ms, without invert
    step_of_rounds: list[float]  # ms, of each round
    invert: float  # ms
    factorize: float  # ms, nan: no factor was made
    unconverged: int
    factor_share: float  # of the steps, made with a factor
    factors: int  # made in a round
    repeats: bool  # all rounds took the same iterations


def mean(runs: list[Run]) -> Mean:
    """Of the rounds of one case."""
    first = runs[0]

    def time(what: str) -> float:
        return float(np.median([getattr(r, what) for r in runs], axis=0).mean())

    made = [ms for r in runs for ms in r.factorize]
    return Mean(
        float(first.iterations.mean()), int(first.iterations.max()), time("solve"), time("step"),
        [float(r.step.mean()) for r in runs], time("invert"),
        float(np.median(made)) if made else float("nan"), sum(r.unconverged for r in runs),
        float(np.mean([kind == "cholesky" for kind in first.kinds])),
        len(first.factorize),
        all(np.array_equal(r.iterations, first.iterations) for r in runs),
    )  # fmt: skip
