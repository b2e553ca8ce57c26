# SPDX-License-Identifier: MIT
"""The measurements behind the tables of bench paper: rows of numbers, the paper's own beside ours."""

from dataclasses import dataclass
from math import ceil
from typing import Any

from sim_server.scene import solver_options
from tests.bench.paper.beam import CELLS, COROTATIONAL, DT, LOADS, MODELS, QUICK, Beam, Load, Model, calibrated
from tests.bench.paper.figures import CONDITION, HETEROGENEOUS, TABLE1, TABLE2, TABLE5
from tests.bench.paper.run import Mean, Way, mean, run

PRECONDITIONERS = ("none", "jacobi", "block_jacobi", "ssor", "ssor_factor", "cholesky", "incomplete_cholesky")


Row = dict[str, Any]
EXTRAPOLATED = "async + warp, extrapolated"
AHEAD = 2  # steps that positions sent to a worker go ahead, at most (table 2)
LATENCIES = (1, 3, 10)  # of the table of extrapolations


@dataclass(frozen=True)
class Setting:
    """What all runs have in common. latency: steps from a matrix to its factor in tables 2 and 5."""

    steps: int
    rounds: int
    latency: int
    tolerance: float
    quick: bool

    @property
    def cells(self) -> tuple[int, int, int]:
        """Of the beams of tables 2 and 5."""
        return QUICK if self.quick else CELLS[3000]

    @property
    def condition(self) -> float:
        return CONDITION

    @property
    def sizes(self) -> dict[int, tuple[int, int, int]]:
        """Elements along each axis of the beams of table 1, by the paper's number of tetrahedra."""
        return {540: QUICK} if self.quick else CELLS

    def solver(self) -> dict[str, Any]:
        return {"tolerance": self.tolerance, "max_iterations": 20_000, "factor_precision": "float32"}

    def ways(self, device: str) -> dict[str, Way]:
        """Columns of table 2: the paper's, then ours. A GPU does not extrapolate."""
        lockstep = f"lockstep-{self.latency}"
        found = {
            "none": Way("none"),
            "precomputed": Way("cholesky"),
            "precomputed + warp": Way("cholesky", warp=True),
            "async": Way("cholesky", lockstep),
            "async + warp": Way("cholesky", lockstep, True),
            EXTRAPOLATED: Way("cholesky", lockstep, True, extrapolate=AHEAD * DT),
            "block Jacobi": Way("block_jacobi"),
            "auto": Way("auto", lockstep, True),
        }
        return {name: way for name, way in found.items() if device == "cpu" or not way.extrapolate}


def measured(cases: dict[str, tuple[Beam, Load, Way]], setting: Setting, device: str) -> dict[str, Mean]:
    """Means of all cases (beam, load, way), which take turns within every round."""
    found: dict[str, list[Any]] = {name: [] for name in cases}
    for _ in range(setting.rounds):
        for name, (beam, load, way) in cases.items():
            found[name].append(run(beam, load, way, setting.steps, device, **setting.solver()))
    return {name: mean(runs) for name, runs in found.items()}


def table1(setting: Setting, device: str, tets: int) -> list[Row]:
    """A size: with the latency of the paper's table, then with our own."""
    stiffness = calibrated(setting.cells, COROTATIONAL, setting.condition)[0].stiffness
    cells = setting.sizes[tets]
    beam, paper = Beam(cells, COROTATIONAL, stiffness), TABLE1[tets]
    theirs = _at_latency(beam, ceil(paper.steps - 0.1), setting, device)
    own = max(1, ceil(theirs.factorize / theirs.step))
    ours = _at_latency(beam, own, setting, device)
    return [
        {"device": device, "tets": 6 * cells[0] * cells[1] * cells[2], "condition": beam.condition(),
         "factorize ms": theirs.factorize, "paper factorize ms": paper.factorize,
         "latency": ceil(paper.steps - 0.1), "iterations": theirs.iterations, "paper iterations": paper.iterations,
         "step ms": theirs.step, "paper step ms": paper.step,
         "steps to factorize": theirs.factorize / theirs.step, "paper steps to factorize": paper.steps,
         "own latency": own, "iterations at it": ours.iterations, "step ms at it": ours.step,
         "unconverged": theirs.unconverged + ours.unconverged, "repeats": theirs.repeats and ours.repeats}
    ]  # fmt: skip


def _at_latency(beam: Beam, latency: int, setting: Setting, device: str) -> Mean:
    case = {"": (beam, LOADS[1], Way("cholesky", f"lockstep-{latency}", True))}
    return measured(case, setting, device)[""]


def table2(setting: Setting, device: str, load: Load, model: Model) -> list[Row]:
    """A row for each scheme."""
    rows = []
    beam, condition = calibrated(setting.cells, model, setting.condition)
    found = measured({name: (beam, load, way) for name, way in setting.ways(device).items()}, setting, device)
    for name, m in found.items():
        row = {"device": device, "load": load.name, "model": model.name, "scheme": name,
               "condition": condition, "stiffness": beam.stiffness, "iterations": m.iterations,
               "most iterations": m.most, "step ms": m.step, "step ms of rounds": m.step_of_rounds,
               "solve ms": m.solve, "with a factor": m.factor_share, "unconverged": m.unconverged,
               "repeats": m.repeats}  # fmt: skip
        if paper := TABLE2.get((LOADS.index(load), model.paper, name)):
            row |= {"paper iterations": paper.iterations, "paper ms": paper.ms}
        rows.append(row)
    return rows


def available(device: str = "cpu") -> list[str]:
    """Those of table 5 that this version has on a device."""
    there = set(solver_options.PRECONDITIONERS) - set(solver_options.CPU_ONLY if device == "gpu" else ())
    return [name for name in PRECONDITIONERS if name in there]


def extrapolated_beams() -> list[str]:
    """Of the table of extrapolations: homogeneous ones by their model, and the heterogeneous one."""
    return [*(model.name for model in MODELS), "heterogeneous"]


def _beam(setting: Setting, name: str) -> Beam:
    """By the name of its model, or the heterogeneous one."""
    if name == "heterogeneous":
        return calibrated(setting.cells, COROTATIONAL, HETEROGENEOUS, heterogeneous=True)[0]
    return calibrated(setting.cells, next(m for m in MODELS if m.name == name), setting.condition)[0]


def extrapolations(setting: Setting, device: str, name: str) -> list[Row]:
    """A row for each latency: iterations by how far the positions sent go ahead."""
    beam, rows = _beam(setting, name), []
    for latency in LATENCIES:
        row: Row = {"device": device, "beam": name, "latency": latency}
        for what, steps in (("as it is", 0), ("1 step", 1), ("2 steps", 2), ("all of it", latency)):
            way = Way("cholesky", f"lockstep-{latency}", True, extrapolate=min(steps, latency) * DT)
            row[what] = float(run(beam, LOADS[2], way, setting.steps, **setting.solver()).iterations.mean())
        rows.append(row)
    return rows


def policies(setting: Setting, device: str) -> list[Row]:
    """A row for each update policy, on the beam of table 2 under the load with most rotation; one virtual worker."""
    beam, d = calibrated(setting.cells, COROTATIONAL, setting.condition)[0], setting.latency
    ways = {name: Way("cholesky", name, True) for name in ("never", "every-1", "every-30", f"lockstep-{d}")}
    ways |= {name: Way("cholesky", name, True, d) for name in ("async", "adaptive")}
    found = measured({name: (beam, LOADS[2], way) for name, way in ways.items()}, setting, device)
    return [
        {"device": device, "update": name, "iterations": m.iterations, "most iterations": m.most,
         "factors": m.factors, "step ms": m.step, "wait ms": m.invert, "unconverged": m.unconverged,
         "repeats": m.repeats}
        for name, m in found.items()
    ]  # fmt: skip


def table5(setting: Setting, device: str) -> list[Row]:
    """A row for each preconditioner, renewed at each step and asynchronously with warp."""
    beam, condition = calibrated(setting.cells, COROTATIONAL, HETEROGENEOUS, heterogeneous=True)
    updates = {"standard": ("every-1", False), "async + warp": (f"lockstep-{setting.latency}", True)}
    cases = {
        (how, name): (beam, LOADS[1], Way(name, *update))
        for how, update in updates.items()
        for name in available(device)
        if how == "standard" or name in solver_options.FACTORS  # the others are not made by workers
    }
    found = measured({" ".join(key): case for key, case in cases.items()}, setting, device)
    rows = []
    for how, name in cases:
        m, paper = found[f"{how} {name}"], TABLE5.get((how, name.removesuffix("_factor")))
        row = {"device": device, "updated": how, "preconditioner": name, "condition": condition,
               "stiffness": beam.stiffness, "iterations": m.iterations, "most iterations": m.most,
               "invert ms": m.invert, "solve ms": m.solve, "total ms": m.invert + m.solve,
               "unconverged": m.unconverged, "repeats": m.repeats}  # fmt: skip
        if paper:
            row |= {"paper iterations": paper.iterations, "paper solve ms": paper.solve, "paper total ms": paper.total}
            row |= {"paper invert ms": paper.invert} if paper.invert is not None else {}
        rows.append(row)
    return rows
