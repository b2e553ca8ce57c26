# SPDX-License-Identifier: MIT
"""Beams at work: rounds of 16 steps with a factor 1 to 16 steps old, between them the same beams without one.

A round: 16 steps (these are timed), a few with plain CG and with block Jacobi, one whose matrix is copied out. Of that
matrix the factor of the next round is made, while no step waits. The first round warms up and is not counted.
"""

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from precond_worker.factorization.factorize import Analysis
from protocol.factor import FactorPattern
from sim_server.backends.kinds import Kind
from sim_server.backends.ring_buffers import RECORDS
from sim_server.simulation import Simulation
from tests.bench.gpu import traffic as moved
from tests.bench.gpu.problem import Problem

STEPS = 16  # of a round, and the age of the factor at its end
WITHOUT = {Kind.NONE: "CG", Kind.BLOCK_JACOBI: "block Jacobi"}

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Search:
    """Linearizations of a step. most: that the scene allows; needed: of these; tolerance: of each linear solve."""

    most: int
    needed: int
    tolerance: float

    @property
    def overrides(self) -> tuple[str, ...]:
        """Of the scene: a goal that is never reached, or at once."""
        goal = 1e-14 if self.needed == self.most else 0.9
        integrator = {"linearizations": self.most, "tolerance": goal}
        return (*(f"integrator.{k}={v:g}" for k, v in integrator.items()), f"solver.tolerance={self.tolerance:g}")


SEARCHES = tuple(Search(*n, tolerance) for tolerance in (1e-6, 1e-1) for n in ((1, 1), (4, 1), (2, 2), (4, 4)))
SEARCHED = (3000, 24_000)  # tets


@dataclass(frozen=True)
class Sample:
    """System and factor of one body at one step, all on the host. solution: ours."""

    row_start: NDArray[np.int32]
    columns: NDArray[np.int32]
    values: Reals  # (blocks, 3, 3)
    b: Reals  # (nodes, 3)
    solution: Reals
    pattern: FactorPattern | None
    factor: NDArray[Any] | None  # values of L of this very matrix

    def matrix(self) -> bsr_array:
        """A, (3 nodes, 3 nodes)."""
        n = 3 * (len(self.row_start) - 1)
        return bsr_array((self.values, self.columns, self.row_start), shape=(n, n))

    def residual(self, y: Reals) -> float:
        """|b - A y| / |b| in float64."""
        b = self.b.ravel()
        return float(np.linalg.norm(b - self.matrix() @ y.ravel().astype(np.float64)) / np.linalg.norm(b))


@dataclass
class Found:
    """Of the counted rounds. made, taken: ms to make and to hand over each factor."""

    records: list[NDArray[Any]] = field(default_factory=list)
    between: float = 0.0  # s from the end of a step to the beginning of the next, in a long run
    cpu: float = 0.0  # s per step of the host's thread
    without: dict[str, list[NDArray[Any]]] = field(default_factory=lambda: {name: [] for name in WITHOUT.values()})
    residuals: list[float] = field(default_factory=list)
    made: list[float] = field(default_factory=list)
    taken: list[float] = field(default_factory=list)
    sample: Sample | None = None


def library_for(tets: int, wanted: str) -> str:
    """Name for Analysis; "" where only a GPU could factorize in reasonable time, and cannot.

    wanted: as given to --library; auto takes the GPU from 24000 tets on, if this installation can.
    """
    if wanted != "auto":
        return wanted
    if tets < 24_000:
        return "auto"
    try:
        start = np.arange(3, dtype=np.int32)
        Analysis(start, start[:2], library="gpu").factorize(np.tile(np.eye(3), (2, 1, 1)))
    except Exception as error:
        print(f"no factorization on the GPU ({error})", flush=True)
        return "auto" if tets <= 24_000 else ""
    return "gpu"


class Beams:
    """A scene of the benchmark, loaded."""

    def __init__(self, problem: Problem, library: str = "auto", device: str = "gpu", overrides: tuple[str, ...] = ()):
        self.problem = problem
        with tempfile.TemporaryDirectory() as folder:
            self.sim = Simulation.load(problem.write(Path(folder)), list(overrides), device=device)
        self.engine, self.bodies = self.sim.engine, self.sim.world.bodies
        body = self.bodies[0]
        self.row_start, self.columns = self.sim.system.body_pattern(body.first, body.last)
        name = library_for(problem.tets, library)
        self.analysis = Analysis(self.row_start, self.columns, library=name) if name else None

    def size(self) -> moved.Size:
        """For the count of bytes."""
        system, factor = self.sim.system, sum(self.engine.factor_bytes(b.index) for b in self.bodies)
        tets = sum(len(b.mesh.tets) for b in self.bodies)
        real = getattr(getattr(self.engine, "solver", None), "real", np.dtype(np.float64)).itemsize  # of a GPU's solver
        return moved.Size(self.sim.world.nodes, tets, len(system.columns), len(system.row), factor, real)

    def use(self, kind: Kind) -> None:
        """The preconditioner of all beams from now on."""
        for body in self.bodies:
            self.engine.settings(body.index).kind = int(kind)

    def run(self, steps: int) -> NDArray[Any]:
        """Records of so many steps, in pieces whose records find room in the loop's ring."""
        self.engine.records()
        piece, found = max(1, 4096 // len(self.bodies)), []
        for done in range(0, steps, piece):
            self.engine.run(min(piece, steps - done))
            found.append(self.engine.records())
        return np.concatenate(found)

    def copied(self) -> tuple[int, list[Reals]]:
        """One step, and its matrices of one beam of each variant."""
        targets = [np.empty((len(self.columns), 3, 3)) for _ in range(self.problem.variants)]
        for index, target in enumerate(targets):
            self.engine.request_matrix(index, target)
        self.run(1)
        end = time.monotonic() + 10
        while any(self.engine.matrix_step(i) < 0 for i in range(len(targets))):
            if time.monotonic() > end:
                raise RuntimeError(f"{self.problem.name}: a matrix asked for has not come within 10 s")
            time.sleep(1e-4)
        return self.engine.matrix_step(0), targets

    def hand_over(self, step: int, factors: list[NDArray[Any]]) -> None:
        """To every beam the factor of its variant."""
        assert self.analysis is not None
        for body in self.bodies:
            self.engine.post_factor(body.index, self.analysis.pattern, factors[body.index % len(factors)], step)
        self.engine.settle_factors()

    def sample(self, values: Reals, factor: NDArray[Any] | None) -> Sample:
        """Of the first beam and the step made last."""
        fetch, rows = self.sim.world.backend.fetch, self.bodies[0].nodes
        b, y = (fetch(array)[rows].copy() for array in (self.sim.system.b_material, self.sim.system.y))
        pattern = self.analysis.pattern if self.analysis else None
        return Sample(self.row_start, self.columns, values, b, y, pattern, factor)


def renewed(beams: Beams, found: Found) -> None:
    """The last step of a round, and the factors made of its matrices."""
    step, matrices = beams.copied()
    if beams.analysis is None:
        found.sample = beams.sample(matrices[0], None)
    else:
        begin = time.perf_counter()
        factors = [beams.analysis.factorize(values) for values in matrices]
        middle = time.perf_counter()
        beams.hand_over(step, factors)
        found.made.append(1e3 * (middle - begin) / len(factors))
        found.taken.append(1e3 * (time.perf_counter() - middle) / beams.problem.beams)
        found.sample = beams.sample(matrices[0], factors[0])
    integrator = beams.sim.scene.integrator
    several = integrator.scheme == "ros2" or integrator.linearizations > 1  # b and y are not those of one solve
    found.residuals.append(np.nan if several else found.sample.residual(found.sample.solution))


def rounds(beams: Beams, count: int, without: int) -> Found:
    """One to warm up and `count` that count; without: steps of each round with every other preconditioner."""
    found = Found()
    for k in range(count + 1):
        if k == 0:
            renewed(beams, found)
        records = beams.run(STEPS)
        if k:
            found.records.append(records)
        for kind, name in WITHOUT.items():
            beams.use(kind)
            others = beams.run(without) if without else records[:0]
            if k or count < 3:
                found.without[name].append(others)
        beams.use(Kind.CHOLESKY)
        renewed(beams, found)
    _long_run(beams, found)
    return found


def _long_run(beams: Beams, found: Found) -> None:
    """A tenth of a second without a pause, as far as the ring has room: what a step takes beside its own time."""
    step = float(np.median(found.records[-1]["whole"]))
    count = max(STEPS, min(int(0.1 / step), RECORDS // len(beams.bodies)))
    beams.engine.records()
    beams.engine.run(count)
    records = beams.engine.records()
    first = records[records["body"] == 0]
    lasted = first["begin"][-1] + first["whole"][-1] - first["begin"][0]
    found.between = (float(lasted) - float(first["whole"].sum())) / (count - 1)
    found.cpu = float(first["cpu"].mean())
