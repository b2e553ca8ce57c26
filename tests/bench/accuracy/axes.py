# SPDX-License-Identifier: MIT
"""Axes of work against precision: which settings are points of each, and how a series and a point of it are called."""

from collections.abc import Iterator
from dataclasses import dataclass

from tests.bench.accuracy.cases import EXPLICIT, Case, Settings, accepts, damped_by, usual

STEPS, SCHEME, MESH = "tolerance, linearizations", "time step, scheme", "mesh"  # axes
SOLVES, DROP = "tolerance, preconditioner", "drop tolerance"
ERROR_OF = {STEPS: "step error", SOLVES: "solve error", DROP: "solve error"}  # what tells points apart; else "error"
TIME_STEPS = (2.0, 1.0, 0.5, 0.25, 0.125)  # over that of the scene
EXPLICIT_STEPS = (1.0, 0.125)
EXPLICIT_NAME = "explicit substeps"
FINE = 0.0625  # where order 2 is seen
TOLERANCES = ("1e-1", "1e-2", "1e-3", "1e-6")
LINEARIZATIONS = (1, 2, 4)
FIXED = "1e-12"  # integrator.tolerance that no step meets before its last linearization


def _several(number: int, tolerance: str = FIXED) -> Settings:
    if number == 1:
        return {}
    return {"integrator.linearizations": str(number), "integrator.tolerance": tolerance}


SCHEMES: dict[str, Settings] = {
    "backward Euler": {},
    "backward Euler, 4 linearizations": _several(4),
    "Newmark": {"integrator.scheme": "newmark"},
    "Newmark, 3 linearizations": {"integrator.scheme": "newmark", **_several(3)},
    "BDF2": {"integrator.scheme": "bdf2"},
    "BDF2, 3 linearizations": {"integrator.scheme": "bdf2", **_several(3)},
    "generalized alpha": {"integrator.scheme": "generalized_alpha"},
    "generalized alpha, 3 linearizations": {"integrator.scheme": "generalized_alpha", **_several(3)},
    "ros2, iterations": {"integrator.scheme": "ros2", "integrator.solve": "iterate"},
    "ros2, factor": {"integrator.scheme": "ros2"},
    EXPLICIT_NAME: EXPLICIT,
}
ORDERS = {"backward Euler": 1, "Newmark": 2, "BDF2": 2, "generalized alpha": 2, "ros2": 2}
TWO: dict[str, Settings] = {name: SCHEMES[name] for name in ("backward Euler", "ros2, factor")}


@dataclass(frozen=True)
class Point:
    """What a page calls it. truth: mesh and law of the reference it is compared with."""

    axis: str
    series: str
    value: str
    settings: Settings
    truth: Settings | None = None


def order_of(series: str) -> int:
    """That a scheme should have."""
    return next(order for name, order in ORDERS.items() if series.startswith(name))


def steps(case: Case) -> Iterator[Point]:
    """Tolerance and linearizations, fixed; then those that are made as far as they are needed."""
    for number in LINEARIZATIONS:
        for tolerance in TOLERANCES:
            yield Point(STEPS, f"{number}", tolerance,
                        usual(_several(number), {"solver.tolerance": tolerance}))  # fmt: skip
    for tolerance in ("1e-1", "1e-2", "1e-4"):
        value = f"1e-2, nonlinear {tolerance}"
        settings = usual(_several(8, tolerance), {"solver.tolerance": "1e-2"})
        yield Point(STEPS, "up to 8", value, settings)
    for bound in case.positions:
        settings = usual({"accuracy.position": bound})
        if accepts(case, settings):
            yield Point(STEPS, "position", f"{bound} m", settings)


def time_steps(case: Case, device: str) -> Iterator[Point]:
    """Time step and scheme."""
    for name, scheme in SCHEMES.items():
        if case.contact and (not name.startswith("backward Euler") or (device == "gpu" and name != "backward Euler")):
            continue  # other schemes take backward Euler in contact; a GPU has one linearization there
        for share in _shares(case, name):
            settings = usual(scheme, case.stepped(share * case.dt))
            if accepts(case, settings):
                yield Point(SCHEME, name, f"{1e3 * share * case.dt:g} ms", settings, damped_by(case, settings))


def _shares(case: Case, scheme: str) -> tuple[float, ...]:
    """Time steps over that of the scene. Explicit substeps are as long as is stable in all of them."""
    if scheme == EXPLICIT_NAME:
        return EXPLICIT_STEPS
    return (*TIME_STEPS, FINE) if case.explicit and scheme.endswith("3 linearizations") else TIME_STEPS


def ages(case: Case) -> Iterator[Point]:
    """Age of the factor: D to 2 D - 1 steps."""
    for name, scheme in TWO.items():
        for update in ("every-1", "lockstep-1", "lockstep-4", "lockstep-10", "lockstep-30", "never"):
            settings = usual(scheme, {"solver.update": update})
            yield Point("age of the factor", name, update, settings, damped_by(case, settings))


def precisions(case: Case, device: str) -> Iterator[Point]:
    """Of the values of the factor as it is applied; on a GPU of the kernels, too."""
    for name, scheme in TWO.items():
        for kind in ("float64", "float32") if device == "cpu" else ("float32", "float16"):
            settings = usual(scheme, {"solver.factor_precision": kind})
            yield Point("factor precision", name, kind, settings, damped_by(case, settings))
        for kind in ("mixed", "float32") if device == "gpu" else ():
            settings = usual(scheme, {"solver.precision": kind})
            yield Point("arithmetic", name, kind, settings, damped_by(case, settings))


def drop_tolerances(case: Case) -> Iterator[Point]:
    """Of the incomplete factor."""
    for drop in ("0.1", "0.03", "0.01", "0.003", "0.001", "0.0001"):
        settings = {"solver.preconditioner": "incomplete_cholesky", "solver.drop_tolerance": drop}
        yield Point(DROP, "incomplete Cholesky", drop, usual(settings))


PRECONDITIONERS = {
    "none": "none", "Jacobi": "jacobi", "block Jacobi": "block_jacobi", "SSOR": "ssor",
    "incomplete Cholesky": "incomplete_cholesky", "Cholesky": "cholesky",
}  # fmt: skip
FINE_TOLERANCES = ("1e-2", "1e-4", "1e-6", "1e-8", "1e-10")


def preconditioners(case: Case, device: str) -> Iterator[Point]:
    """Tolerance by preconditioner, factors 4 to 7 steps old."""
    for name, key in PRECONDITIONERS.items():
        if device == "gpu" and key in ("ssor", "incomplete_cholesky"):
            continue
        for tolerance in FINE_TOLERANCES:
            settings = usual({"solver.preconditioner": key, "solver.tolerance": tolerance})
            yield Point(SOLVES, name, tolerance, settings)


def laws(case: Case) -> Iterator[Point]:
    """Each beside the motion that it makes itself in small steps."""
    for law in (case.law, *case.laws):
        changed = case.with_law(law)
        yield Point("model", law, "backward Euler", usual(changed), changed)
        second = SCHEMES["Newmark, 3 linearizations"]
        if not case.contact:
            yield Point("model", law, "Newmark, 3 linearizations", usual(changed, second), changed)


def points(case: Case, device: str, quick: bool) -> dict[str, list[Point]]:
    """By axis."""
    found = {
        STEPS: list(steps(case)), SCHEME: list(time_steps(case, device)),
        SOLVES: list(preconditioners(case, device)), "model": list(laws(case)),
    }  # fmt: skip
    if not case.contact:
        found |= {"age of the factor": list(ages(case)), "factor precision": list(precisions(case, device))}
        if device == "cpu":
            found[DROP] = list(drop_tolerances(case))
    if device == "gpu" and case.contact:  # one linearization there
        found[STEPS] = [p for p in found[STEPS] if p.series in ("1", "position")]
    return {axis: found[axis][:3] for axis in (STEPS, SCHEME)} if quick else found
