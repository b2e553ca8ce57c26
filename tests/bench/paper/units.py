# SPDX-License-Identifier: MIT
"""What bench paper can measure by itself: a few rows of one table each, in any order, on any machine."""

from collections.abc import Sequence
from functools import partial

from tests.bench.figure4 import figure as figure4
from tests.bench.harness.schemes import SCENES, run
from tests.bench.harness.units import Unit
from tests.bench.paper import tables
from tests.bench.paper.automatic import automatic
from tests.bench.paper.beam import LOADS, MODELS
from tests.bench.paper.publishing import publishing
from tests.bench.paper.tables import Row, Setting

KEYS = {  # what tells the rows of a table apart
    "table1": ("device", "tets"),
    "publishing": ("device", "tets"),
    "automatic": ("device", "tets", "E", "load"),
    "table2": ("device", "load", "model", "scheme"),
    "table5": ("device", "updated", "preconditioner"),
    "policies": ("device", "update"),
    "extrapolations": ("device", "beam", "latency"),
    "figure4": ("scheme",),
}


def units(setting: Setting, devices: Sequence[str], processes: bool = True) -> list[Unit]:
    """All of them. processes: also those with workers in processes of their own."""
    beside = [Unit("publishing", f"{tets}, cpu", 40 + tets / 400, partial(publishing, setting, tets))
              for tets in setting.sizes if processes and "cpu" in devices]  # fmt: skip
    return [*(unit for device in devices for unit in _of_device(setting, device)), *beside, _figure4(setting)]


def _of_device(setting: Setting, device: str) -> list[Unit]:
    found = [
        Unit("table1", f"{tets}, {device}", tets / 100, partial(tables.table1, setting, device, tets))
        for tets in setting.sizes
    ]
    found += [
        Unit("table2", f"{load.name}, {model.name}, {device}", 30, partial(tables.table2, setting, device, load, model))
        for load in LOADS
        for model in MODELS
    ]
    found.append(Unit("table5", device, 60, partial(tables.table5, setting, device)))
    found.append(Unit("policies", device, 20, partial(tables.policies, setting, device)))
    if device == "gpu":  # positions of a GPU go out as they are
        return found
    found += [
        Unit("extrapolations", f"{beam}, {device}", 25, partial(tables.extrapolations, setting, device, beam))
        for beam in tables.extrapolated_beams()
    ]
    found += [
        Unit("automatic", f"{tets}, {'heterogeneous' if bands else 'homogeneous'}, {device}", 30 + tets / 120,
             partial(automatic, setting, tets, bands))
        for tets in setting.sizes
        for bands in (False, True)
    ]  # fmt: skip
    return found


def _figure4(setting: Setting) -> Unit:
    latency, steps = (4, 12) if setting.quick else (30, 150)
    more = ("solver.factor_precision=float32", *(("object.beam.mesh.bar=[2, 2, 6]",) if setting.quick else ()))

    def rows() -> list[Row]:
        """Without processes: the page of figure4 has those too."""
        found = []
        for kind in figure4.schemes(latency, processes=False):
            one = run(SCENES / "beam.toml", kind, steps, more)
            row = figure4.row(kind.name, [one], latency)
            steps_of_it = {"iterations": one.iterations, "seconds": one.seconds, "age": one.age}
            found.append({**row, "latency": latency, "steps": steps_of_it})
        return found

    return Unit("figure4", "cpu", 20, rows)
