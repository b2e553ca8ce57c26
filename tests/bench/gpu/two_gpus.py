# SPDX-License-Identifier: MIT
"""One large body on one GPU and on two: steps with a factor 1 to 16 steps old, in turns, on the same machine.

python -m tests.bench.gpu.two_gpus 98304 405600

Prints a line of JSON for each size and number of GPUs: us of a step and of an iteration, iterations, and how far apart
the positions are at the end.
"""

import argparse
import json
import time
from typing import Any

import numpy as np

from sim_server.backends.gpu import solver
from tests.bench.gpu.problem import Problem
from tests.bench.gpu.steps import STEPS, Beams, Found, renewed


def row(scene: Beams, records: list[np.ndarray], gpus: int) -> dict[str, Any]:
    """What is printed."""
    found = np.concatenate(records)
    solve, its = 1e6 * found["solve"], found["iterations"]
    whole = 1e6 * found["whole"]
    return {
        "tets": scene.problem.tets, "material": scene.problem.material, "gpus": gpus,
        "factor MB": round(scene.engine.factor_bytes(0) / 1e6),
        "step us p50": round(float(np.median(whole)), 1), "p99": round(float(np.quantile(whole, 0.99)), 1),
        "max": round(float(whole.max()), 1), "iterations": round(float(its.mean()), 2),
        **{f"{part} us": round(1e6 * float(np.median(found[part])), 1) for part in ("assemble", "solve", "integrate")},
        "us an iteration": round(float(np.median(solve / its)), 1), "converged": bool((found["status"] == 0).all()),
    }  # fmt: skip


def main() -> None:
    """Measures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("tets", type=int, nargs="+")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--library", default="gpu")
    parser.add_argument("--material", default="homogeneous")
    parser.add_argument("--gpus", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--least", type=int, help="nodes of a body from which on the second GPU helps")
    given = parser.parse_args()
    if given.least is not None:
        solver.LEAST_NODES = given.least
    for tets in given.tets:
        scenes, problem = dict[int, Beams](), Problem(tets, given.material)
        for gpus in given.gpus:
            begin = time.perf_counter()
            scenes[gpus] = Beams(problem, given.library, overrides=(f"solver.gpus={gpus}",))
            print(f"# {tets} tets, {gpus} GPUs: loaded in {time.perf_counter() - begin:.1f} s", flush=True)
        found = {gpus: Found() for gpus in scenes}
        for k in range(given.rounds + 1):
            for gpus, scene in scenes.items():
                if k == 0:
                    renewed(scene, found[gpus])
                records = scene.run(STEPS)
                if k:
                    found[gpus].records.append(records)
                renewed(scene, found[gpus])
        for gpus, scene in scenes.items():
            print(json.dumps(row(scene, found[gpus].records, gpus)), flush=True)
        x = [scene.sim.fetch().x.copy() for scene in scenes.values()]
        print(f"# positions differ by at most {np.abs(x[0] - x[-1]).max():.3g} m", flush=True)


if __name__ == "__main__":
    main()
