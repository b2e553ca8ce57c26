# SPDX-License-Identifier: MIT
"""Steps on a GPU with an old factor where the body moves fast: a heterogeneous beam that is let go, with and without
the exact solve that is put around the factor where the matrix has changed most (backends/gpu/refresh_state.cuh).

Both make the same steps in turns, in rounds of EVERY from the factor of the matrix of the first, which does not count.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.gpu.refresh import LocalRefresh
from sim_server.simulation import Simulation
from tests.bench.gpu.problem import MATERIALS, Problem
from tests.bench.gpu.steps import library_for

EVERY = 16  # steps from one factor
Row = dict[str, Any]


def measure(tets: int, material: str, steps: int) -> list[Row]:
    """A row with, and one without."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Problem(tets, material).write(Path(folder))
        sides = {"refreshed": Simulation.load(scene, device="gpu")}
        with patch.object(LocalRefresh, "wanted", return_value=None):
            sides["as it is"] = Simulation.load(scene, device="gpu")
    first = sides["refreshed"]
    analysis = Analysis(first.system.row_start, first.system.columns, library=library_for(tets, "auto") or "auto")
    found: dict[str, list[NDArray[Any]]] = {name: [] for name in sides}
    nodes = []
    for _ in range(steps // EVERY):
        for name, side in sides.items():
            engine = side.engine
            engine.assemble()
            values = analysis.factorize(engine.factor_matrix(0), np.dtype(np.float32))
            engine.post_factor(0, analysis.pattern, values, step=engine.step)
            engine.solve()
            engine.records()
            engine.run(EVERY - 1)
            found[name].append(engine.records())
        nodes.append(first.engine.refreshed(0))  # type: ignore[attr-defined]
    away = float(np.abs(first.fetch().x - sides["as it is"].fetch().x).max())
    return [_row(tets, material, name, np.concatenate(each), max(nodes), away) for name, each in found.items()]


def _row(tets: int, material: str, name: str, records: NDArray[Any], nodes: int, away: float) -> Row:
    whole, iterations = 1e6 * records["whole"], records["iterations"]
    return {
        "tets": tets, "material": material, "factor": name, "iterations": float(iterations.mean()),
        "p99": float(np.percentile(iterations, 99)), "most": int(iterations.max()),
        "us p50": float(np.median(whole)), "us p99": float(np.percentile(whole, 99)), "us max": float(whole.max()),
        "not converged": int((records["status"] != 0).sum()), "residual, most": float(records["residual"].max()),
        "nodes, most": nodes if name == "refreshed" else 0, "apart m": away, "steps": len(records),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tets", type=int, nargs="*", default=[24000])
    parser.add_argument("--materials", nargs="*", default=list(MATERIALS))
    parser.add_argument("--steps", type=int, default=320)
    options = parser.parse_args()
    for tets in options.tets:
        for material in options.materials:
            for row in measure(tets, material, options.steps):
                print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
