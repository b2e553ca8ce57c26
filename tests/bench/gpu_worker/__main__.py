# SPDX-License-Identifier: MIT
"""How long a worker takes for a factor of a beam on a GPU: symbolic phase, and L from matrix to host memory.

deploy/run bench gpu_worker --tets 540 3000 24000
"""

import argparse
import sys
import time
from pathlib import Path
from statistics import median

from precond_worker.errors import DeviceUnusable
from precond_worker.factorization.factorize import LIBRARIES, Analysis
from sim_server.simulation import Simulation
from tests.bench.gpu.problem import BARS

SCENE = Path(__file__).resolve().parents[3] / "deploy/scenes/beam.toml"


def measured(tets: int, library: str, times: int) -> str:
    """One line of the table."""
    bar = f"object.beam.mesh.bar={list(BARS[tets])}"
    sim = Simulation.load(SCENE, [bar, "dt=0.03", "solver.preconditioner=none"])
    sim.engine.run(1)
    pattern = sim.system.body_pattern(0, sim.world.nodes)
    matrix = sim.system.body_values(0, sim.world.nodes)
    start = time.perf_counter()
    analysis = Analysis(*pattern, library)
    symbolic = time.perf_counter() - start
    analysis.factorize(matrix)  # takes the device's memory
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        analysis.factorize(matrix)
        seconds.append(time.perf_counter() - start)
    return (
        f"| {tets} | {analysis.library} | {analysis.pattern.nonzeros / 1e6:.2f} | {symbolic:.2f} | "
        f"{1e3 * median(seconds):.2f} | {1e3 * min(seconds):.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--tets", type=int, nargs="+", choices=BARS, default=[540, 3000, 7350, 24000], metavar="N")
    parser.add_argument("--library", nargs="+", choices=LIBRARIES, default=["gpu-float64", "gpu-float32"])
    parser.add_argument("--times", type=int, default=20)
    options = parser.parse_args()
    print("| tets | with | values of L [millions] | symbolic [s] | factor, median [ms] | least |")
    print("|--:|---|--:|--:|--:|--:|")
    try:
        for tets in options.tets:
            for library in options.library:
                print(measured(tets, library, options.times), flush=True)
    except DeviceUnusable as error:
        sys.exit(f"gpu_worker: {error}")


if __name__ == "__main__":
    main()
