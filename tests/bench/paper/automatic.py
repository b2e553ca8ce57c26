# SPDX-License-Identifier: MIT
"""preconditioner = "auto" beside what it chooses from, on beams of all sizes, of one stiffness and of three.

One worker in virtual time: the exact factor takes so many steps as on a common machine, an incomplete one fewer by its
operations. So iterations repeat to the digit, and a factor that is sooner made is fresher.
"""

import numpy as np

from tests.bench.paper.beam import COROTATIONAL, LOADS, Beam, Load, calibrated
from tests.bench.paper.figures import HETEROGENEOUS
from tests.bench.paper.run import Run, Way, run
from tests.bench.paper.tables import Row, Setting

LATENCY = {540: 6, 3000: 8, 7350: 12, 24000: 18}  # steps that an exact factor takes (table 1, own latency)
STEPS = {24000: 100}  # at most
CHOICES = ("block_jacobi", "cholesky", "incomplete_cholesky", "auto")


def automatic(setting: Setting, tets: int, heterogeneous: bool) -> list[Row]:
    """A row for each load with rotations."""
    condition = HETEROGENEOUS if heterogeneous else setting.condition
    stiffness = calibrated(setting.cells, COROTATIONAL, condition, heterogeneous=heterogeneous)[0].stiffness
    beam = Beam(setting.sizes[tets], COROTATIONAL, stiffness, heterogeneous)
    return [_row(setting, beam, load, tets) for load in LOADS[1:]]


def _row(setting: Setting, beam: Beam, load: Load, tets: int) -> Row:
    steps, latency = min(setting.steps, STEPS.get(tets, setting.steps)), LATENCY[tets]
    ways = {name: Way(name, "async", True, latency) for name in CHOICES[1:]}
    found: dict[str, list[Run]] = {name: [] for name in CHOICES}
    for _ in range(setting.rounds):
        for name, way in {"block_jacobi": Way("block_jacobi"), **ways}.items():
            found[name].append(run(beam, load, way, steps, **setting.solver()))
    ms = {name: float(np.min([r.cpu for r in runs], axis=0).mean()) for name, runs in found.items()}
    row: Row = {"device": "cpu", "tets": tets, "E": "1000:50:10" if beam.heterogeneous else "one", "load": load.name,
                "latency": latency, "steps": steps}  # fmt: skip
    row |= {f"{name}, iterations": float(runs[0].iterations.mean()) for name, runs in found.items()}
    row |= {f"{name}, ms": value for name, value in ms.items()}
    row["auto / best"] = ms["auto"] / min(ms[name] for name in CHOICES[:-1])
    row["IC / best of the others"] = ms["incomplete_cholesky"] / min(ms["cholesky"], ms["block_jacobi"])
    row["unconverged"] = sum(r.unconverged for runs in found.values() for r in runs)
    row["repeats"] = all(np.array_equal(r.iterations, runs[0].iterations) for runs in found.values() for r in runs)
    return row
