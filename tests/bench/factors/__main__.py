# SPDX-License-Identifier: MIT
"""What a complete factor of a beam costs a worker, by library: the symbolic phase, and L from the matrix of a step.

The libraries take turns, so that drift hits all alike. On a machine with a GPU: --library gpu-float64 gpu-float32.
"""

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.errors import DeviceUnusable
from precond_worker.factorization.factorize import LIBRARIES, Analysis
from protocol.factor import FactorPattern
from sim_server.simulation import Simulation
from tests.bench.factors.superlu import SuperLU, lower_of
from tests.bench.gpu.problem import BARS
from tests.bench.harness.report import ROOT, Report, plots

SCENE = ROOT / "deploy" / "scenes" / "beam.toml"
PEER = "SciPy's SuperLU"
USUAL = ("cholmod", PEER, "supernodal")
TIMES = {540: 60, 3000: 30, 7350: 20, 24000: 9}  # runs of each library; larger ones: 3
EXPLAINED = """\
The beam of deploy/scenes after a step of 30 ms, {cells}; one thread. *symbolic*: once per topology, order of METIS and
pattern of L in Python, the same for all libraries of the CPU. *ms*: from the values of A to those of L in the order in
which they are sent, median wall time of {runs}; *CPU ms*: median of the thread's own clock; *of CHOLMOD*: that time
over CHOLMOD's with L in float64. *error*: largest entry of (L Lᵀ - A) x over those of |A| |x|, x random. *L in*: type
of the values of L. CHOLMOD computes in float64 and rounds; supernodal computes in the type of L. {peer}, with a fifth
as many runs, computes L and U; its row holds the factorization and the scaling to L alone, not its way into the order
of sending."""


def matrix_of(tets: int) -> tuple[tuple[NDArray[Any], NDArray[Any]], NDArray[Any]]:
    """Block pattern and values of the matrix after the first step."""
    bar = f"object.beam.mesh.bar={list(BARS[tets])}"
    sim = Simulation.load(SCENE, [bar, "dt=0.03", "solver.preconditioner=none"])
    sim.engine.run(1)
    values = np.array(sim.system.body_values(0, sim.world.nodes), np.float64)
    return sim.system.body_pattern(0, sim.world.nodes), values


class Run:
    """Times of one library on one matrix."""

    def __init__(self, library: str, dtype: type, make: Callable[[], Any]):
        self.library, self.dtype, self.make = library, np.dtype(dtype).name, make
        self.wall: list[float] = []
        self.cpu: list[float] = []
        self.made: Any = make()  # takes the memory that it needs

    def again(self) -> None:
        """Makes the factor once more."""
        wall, cpu = time.perf_counter(), time.thread_time()
        self.made = self.make()
        self.cpu.append(1e3 * (time.thread_time() - cpu))
        self.wall.append(1e3 * (time.perf_counter() - wall))


def runs_of(
    libraries: list[str], pattern: tuple[NDArray[Any], NDArray[Any]], values: NDArray[Any]
) -> tuple[list[Run], FactorPattern, float]:
    """A run for each library and type of L, the pattern of L, and the seconds of the symbolic phase."""
    runs: list[Run] = []
    seconds, found = [], None
    for library in (name for name in libraries if name != PEER):
        start = time.perf_counter()
        analysis = Analysis(*pattern, library)
        seconds.append(time.perf_counter() - start)
        found = analysis.pattern
        for dtype in (np.float64, np.float32):
            runs.append(Run(library, dtype, lambda a=analysis, t=dtype: (a.pattern, a.factorize(values, t))))
    assert found is not None
    if PEER in libraries:
        peer = SuperLU(*pattern, found.permutation)
        runs.insert(2, Run(PEER, np.float64, lambda: (None, peer.factorize(values))))
    return runs, found, min(seconds)


def rows_of(tets: int, libraries: list[str], times: int) -> list[dict[str, Any]]:
    """The rows of one size."""
    pattern, values = matrix_of(tets)
    runs, found, symbolic = runs_of(libraries, pattern, values)
    for k in range(times):
        for run in runs:
            if run.library != PEER or k < max(1, times // 5):
                run.again()
    reference = next((median(r.cpu) for r in runs if r.library == "cholmod" and r.dtype == "float64"), None)
    rows = [
        {
            "tets": tets, "library": run.library, "L in": run.dtype, "symbolic s": symbolic,
            "values of L": found.nonzeros, "ms": median(run.wall), "CPU ms": median(run.cpu), "least": min(run.cpu),
            "of CHOLMOD": median(run.cpu) / reference if reference else None,
            "error": error(run, pattern, values, found),
        }
        for run in runs
    ]  # fmt: skip
    for row in rows:
        print({k: round(v, 3) if isinstance(v, float) and k != "error" else v for k, v in row.items()}, flush=True)
    return rows


def error(run: Run, graph: tuple[NDArray[Any], NDArray[Any]], values: NDArray[Any], found: FactorPattern) -> float:
    """Largest entry of (L L^T - A) x over those of |A| |x|."""
    from scipy.sparse import bsr_matrix

    own, made = run.made
    lower = made if own is None else lower_of(own, made.astype(np.float64))
    order = (own or found).permutation
    matrix = bsr_matrix((values, graph[1], graph[0]))
    x = np.random.default_rng(0).normal(size=len(order))
    moved = np.empty_like(x)
    moved[order] = lower @ (lower.T @ x[order])
    return float(np.abs(moved - matrix @ x).max() / (abs(matrix) @ abs(x)).max())


def draw(report: Report, rows: list[dict[str, Any]]) -> None:
    """Time against size."""
    plt = plots()
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for library, kind in dict.fromkeys((r["library"], r["L in"]) for r in rows):
        mine = [r for r in rows if (r["library"], r["L in"]) == (library, kind)]
        axes.loglog([r["tets"] for r in mine], [r["CPU ms"] for r in mine], "o-", label=f"{library}, L in {kind}")
    axes.set(xlabel="tetrahedra", ylabel="CPU ms of a factor")
    axes.legend()
    report.figure(figure, "factors.png", "Median CPU time of a complete factor, one thread")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument(
        "--tets", type=int, nargs="+", choices=BARS, default=[540, 3000, 7350, 24000, 98304], metavar="N"
    )
    parser.add_argument("--library", nargs="+", choices=(*LIBRARIES, PEER), default=list(USUAL))
    parser.add_argument("--quick", action="store_true", help="smallest size, few runs")
    parser.add_argument("--out", type=Path)
    o = parser.parse_args()
    if o.quick:
        o.tets = o.tets[:1]
    report = Report("factors", "Complete factors", {"tets": o.tets, "library": o.library}, o.out, o.quick)
    rows: list[dict[str, Any]] = []
    try:
        for tets in o.tets:
            rows += rows_of(tets, o.library, 2 if o.quick else TIMES.get(tets, 3))
    except (DeviceUnusable, ImportError) as problem:
        sys.exit(f"factors: {problem}")
    cells = ", ".join(f"{' x '.join(map(str, BARS[n]))} cells" for n in o.tets)
    times = ", ".join(str(TIMES.get(n, 3)) for n in o.tets)
    report.say(EXPLAINED.format(cells=cells, runs=f"{times} runs", peer=PEER))
    report.table(rows)
    report.data["rows"] = rows
    report.remember(rows, ("tets", "library", "L in"), ("CPU ms",))
    draw(report, rows)
    report.write()


if __name__ == "__main__":
    main()
