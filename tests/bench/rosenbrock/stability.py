# SPDX-License-Identifier: MIT
"""Does a step by the factor alone hold? Ages, time steps, materials, models and violent starts about one base case."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim_server.mechanics.rosenbrock import BOUND
from tests.bench.rosenbrock.bars import (
    CELLS,
    EULER,
    LENGTH,
    NOT_FINITE,
    ROS2_FACTOR,
    RUNAWAY,
    SIZE,
    STARTS,
    Bar,
    Method,
    Row,
    Run,
    energy,
    inverted,
    run,
)

SECONDS = 8.0
STILL = 0.01  # of the largest kinetic energy of the run is left at the end of one that holds
AT_REST = 1e-6  # J: 20 um/s of the whole bar
MODELS = ("stable_neo_hookean", "mass_spring", "st_venant_kirchhoff")
VIOLENT = tuple(name for name in STARTS if name != "let go")
LATENCIES, TIME_STEPS = (1, 3, 10, 30, 100), (0.005, 0.01, 0.02, 0.04)


@dataclass(frozen=True)
class Case:
    """A run. latency: D of lockstep-D; bound: of the error of a step, of the shortest edge."""

    start: str = "let go"
    model: str = "corotational"
    young: float = 1e6
    poisson: float = 0.45
    dt: float = 0.02
    latency: int = 10
    tangent: str = "default"
    bound: float = BOUND

    def row(self) -> Row:
        """What tells it apart."""
        poisson = 0.25 if self.model == "mass_spring" else self.poisson
        named = {"start": self.start, "model": self.model, "E MPa": self.young / 1e6, "Poisson": poisson}
        return {
            **named, "dt ms": 1e3 * self.dt, "latency": self.latency, "tangent": self.tangent,
            "bound / edge": self.bound,
        }  # fmt: skip


BASE = Case()


def groups() -> dict[str, list[Case]]:
    """Cases by what is varied."""
    return {
        "age and dt, let go": _varied(latency=LATENCIES, dt=TIME_STEPS),
        "stiffness and dt, let go": _varied(young=(1e5, 1e7), dt=TIME_STEPS),
        "Poisson's ratio and dt, let go": _varied(poisson=(0.3, 0.499), dt=TIME_STEPS),
        "model and dt, let go": _varied(model=MODELS, dt=TIME_STEPS),
        "start and age": _varied(start=VIOLENT, latency=(1, 10, 100)),
        "start and dt": _varied(start=VIOLENT, dt=(0.005, 0.01, 0.04)),
        "start and model": _varied(start=VIOLENT, model=MODELS),
        "start and stiffness": _varied(start=VIOLENT, young=(1e5, 1e7)),
        "start, Poisson's ratio 0.499": _varied(start=VIOLENT, poisson=(0.499,)),
        "spun, nearly incompressible: tangent and bound": _varied(
            start=("spun",), poisson=(0.48, 0.49, 0.499), tangent=("usual", "exact"), bound=(BOUND, 0.3 * BOUND)
        ),
    }


def _varied(**values: Sequence[Any]) -> list[Case]:
    """Every combination of the given values, the rest as in BASE."""
    cases = [BASE]
    for name, several in values.items():
        cases = [replace(case, **{name: value}) for case in cases for value in several]
    return cases


def rows(group: str, cases: Sequence[Case], device: str, tets: int, seconds: float = SECONDS) -> list[Row]:
    """Each case by the factor alone, beside backward Euler with factors 10 to 19 steps old."""
    beside: dict[Case, tuple[Row, Run]] = {}
    found: list[Row] = []
    for case in cases:
        alike = replace(case, latency=BASE.latency, bound=BASE.bound)
        if alike not in beside:
            beside[alike] = _outcome(alike, EULER, device, tets, seconds)
        euler, other = beside[alike]
        own, one = _outcome(case, _method(case, tets), device, tets, seconds)
        away = float(np.sqrt(((one.sim.world.x - other.sim.world.x) ** 2).sum(axis=1).mean())) / LENGTH
        forms = {form.lower(): one.share(form) for form in ("FACTOR", "ITERATE", "EULER")}
        found.append(
            {"device": device, "varied": group, **case.row(), **own, **forms, "apart / L": away}
            | {f"Euler: {name}": value for name, value in euler.items()}
        )
    return found


def _method(case: Case, tets: int) -> Method:
    edge = min(size / cells for size, cells in zip(SIZE, CELLS[tets], strict=True))
    integrator = {**ROS2_FACTOR.integrator, "error_bound": case.bound * edge}
    return replace(ROS2_FACTOR, latency=case.latency, integrator=integrator)


def _outcome(case: Case, method: Method, device: str, tets: int, seconds: float) -> tuple[Row, Run]:
    gravity = case.start == "let go"
    bar = Bar(tets, case.young, case.poisson, model=case.model, damping=1.0, gravity=gravity, tangent=case.tangent)
    at_start: list[float] = []

    def start(sim: Any) -> None:
        if (change := STARTS[case.start][1]) is not None:
            change(sim)
        at_start.append(energy(sim))

    with np.errstate(all="ignore"):
        one = run(bar, method, case.dt, seconds, device, start, frames=False)
        left = energy(one.sim) / at_start[0] if not gravity and at_start[0] > 0 else float("nan")
        return {"holds": _verdict(one), "energy": left, "inverted": inverted(one.sim)}, one


def _verdict(one: Run) -> str:
    r = one.records
    for status, what in ((NOT_FINITE, "not finite"), (RUNAWAY, "ran away")):
        if (r["status"] == status).any():
            return f"{what} at {r['time'][r['status'] == status][0]:.2g} s"
    kinetic = r["kinetic"]
    left = kinetic[-max(1, len(kinetic) // 20) :].mean() / max(kinetic.max(), 1e-300)
    return "yes" if left < STILL or kinetic[-1] < AT_REST else f"still moves ({left:.0e})"
