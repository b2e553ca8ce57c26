# SPDX-License-Identifier: MIT
"""Estimated errors of linear solves on a CPU against the true ones, and solves that end by them.

Bounds of the effectivity (estimated / true) are what was found, with room for another processor.
`python -m tests.accuracy.test_effectivity` prints a table.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from protocol.method import Method
from sim_server import simulation as simulations
from sim_server.backends.kinds import FACTOR_TRUST
from sim_server.effects.touch import Touch
from sim_server.simulation import Simulation
from tests.accuracy.effectivity import GRAVITY, Factors, Solve, beam, nodal, solves
from tests.contact.scenes import D, block, over
from tests.scenes import bar, factor_of, simulation

INCOMPLETE = Method("incomplete_cholesky", drop_tolerance=0.003, fill=10.0)
SSOR = Method("ssor", omega=1.0)
HETEROGENEOUS = [
    {"young": 2.5e4, "where": "X > 3.3 and X < 6.6"},
    {"young": 5e3, "where": "X > 6.6"},
    {"young": 5e5},
]
POSITIONS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)


@pytest.fixture(autouse=True)
def starts_of_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    """What these tests set in settings is set by [accuracy], with which solves start from the last solution."""
    monkeypatch.setattr(simulations, "make_guess", lambda *given: None)


class Case(NamedTuple):
    """A scene in motion. factors: arguments of Factors; None: without.

    median: bounds of the effectivity's; worst: bounds of all
    """

    table: dict[str, Any]
    factors: tuple[Any, ...] | None = None
    solver: dict[str, Any] | None = None
    integrator: dict[str, Any] | None = None
    median: tuple[float, float] = (0.5, 2.5)
    worst: tuple[float, float] = (0.25, 20)


def law(name: str, young: float = 5e5, poisson: float = 0.45) -> dict[str, Any]:
    return beam(law={name: {"young": young, "poisson": poisson}})


def by(kind: str) -> dict[str, Any]:
    return {"preconditioner": kind}


LOOSE: dict[str, Any] = {"median": (0.5, 8), "worst": (0.3, 30)}
STIFF: dict[str, Any] = {"median": (0.5, 25), "worst": (0.2, 100)}  # what is foretold at a stop is too careful
CASES = {
    "fresh factor": Case(beam(), (1, 0), worst=(0.3, 4)),
    "lockstep 3": Case(beam(), (3, 3)),
    "lockstep 30": Case(beam(), (30, 30)),
    "one factor for all": Case(beam(), (1000, 0), worst=(0.25, 4)),
    "one factor for all, not warped": Case(beam(), (1000, 0), {"warp": False}, worst=(0.15, 6)),
    "lockstep 10, not warped": Case(beam(), (10, 10), {"warp": False}, worst=(0.15, 20)),
    "heterogeneous, lockstep 10": Case(beam(HETEROGENEOUS), (10, 10)),
    "incomplete Cholesky, lockstep 10": Case(beam(HETEROGENEOUS), (10, 10, INCOMPLETE)),
    "factor of SSOR, lockstep 10": Case(beam(), (10, 10, SSOR)),
    "block Jacobi": Case(beam(), None, by("block_jacobi"), **LOOSE),
    "Jacobi, heterogeneous": Case(beam(HETEROGENEOUS), None, by("jacobi"), **LOOSE),
    "SSOR": Case(beam(), None, by("ssor"), **LOOSE),
    "stable neo-Hookean, lockstep 10": Case(law("stable_neo_hookean"), (10, 10), worst=(0.2, 20)),
    "stable neo-Hookean, nu 0.49": Case(law("stable_neo_hookean", poisson=0.49), None, by("block_jacobi")),
    "St. Venant-Kirchhoff, lockstep 10": Case(law("st_venant_kirchhoff", poisson=0.3), (10, 10)),
    "Newmark, lockstep 10": Case(beam(), (10, 10), integrator={"scheme": "newmark"}),
    "BDF2, lockstep 10": Case(beam(), (10, 10), integrator={"scheme": "bdf2"}),
    "free body, block Jacobi": Case(bar((10, 2, 2), (10, 2, 2), young=5e5), None, by("block_jacobi"), **LOOSE),
    "stiff, lockstep 3": Case(beam(1e8), (3, 3), **STIFF),
    "stiff, not warped": Case(beam(1e8), (1000, 0), {"warp": False}, median=(0.4, 25), worst=(0.08, 200)),
    "stiff, block Jacobi": Case(beam(1e8), None, by("block_jacobi"), median=(0.5, 8), worst=(0.2, 200)),
    "stiff, factor of SSOR": Case(beam(1e8), (10, 10, SSOR), median=(0.5, 8), worst=(0.3, 80)),
}  # fmt: skip


def made(case: Case, **settings: Any) -> tuple[Simulation, Callable[[int], None]]:
    solver = {"preconditioner": "cholesky", "update": "never", "max_iterations": 3000} | (case.solver or {}) | settings
    sim = simulation(case.table, gravity=GRAVITY, integrator=case.integrator, **solver)
    return sim, Factors(sim, *case.factors) if case.factors else lambda step: None


def effectivities(case: Case, steps: int = 40) -> np.ndarray:
    """Of solves to one tolerance after another."""
    sim, prepare = made(case)
    return np.array([solve.estimate / solve.true for solve in solves(sim, steps, prepare)])


def bounded(case: Case, steps: int = 40) -> list[Solve]:
    """Solves that end by one position after another."""
    sim, prepare = made(case)
    return solves(sim, steps, prepare, positions=POSITIONS, tolerances=(1e-12,))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_estimates_are_near_the_true_errors(case):
    found = effectivities(case)
    assert len(found) > 20
    assert case.median[0] < np.median(found) < case.median[1]
    assert case.worst[0] < found.min() and found.max() < case.worst[1]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_solves_that_end_by_the_estimate_are_as_exact_as_asked(case):
    found = bounded(case)
    over = np.array([s.true / s.position for s in found])
    assert all(s.record["status"] == 0 for s in found)
    assert (over <= 1).mean() >= 0.97 and over.max() <= 2
    assert all(s.record["residual"] < 0.1001 for s in found), "an estimate ends no solve with much of b left"


def test_a_coarser_position_takes_fewer_iterations_and_none_more_than_the_tolerance():
    """Of a stale factor; and the smaller the position, the nearer to the exact solution."""
    spent = []
    for position in (1e-2, 1e-4, 1e-6, 0.0):
        sim, prepare = made(CASES["lockstep 30"])
        found = solves(sim, 70, prepare, after=40, positions=(position,), tolerances=(1e-12 if position else 1e-9,))
        spent.append((sum(int(s.record["iterations"]) for s in found), max(s.true for s in found)))
    iterations, errors = zip(*spent, strict=True)
    assert list(iterations) == sorted(iterations) and iterations[0] < iterations[-1] / 3
    assert list(errors) == sorted(errors, reverse=True)


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_a_factor_of_a_wrong_scale_gives_no_false_estimate(scale):
    """P is a million times A, which alpha tells, or a millionth of it, with which solves go on to rounding."""
    case = Case(beam(), (3, 3, Method(), scale))
    assert max(s.true / s.position for s in bounded(case, 20)) <= 1
    median = np.median(effectivities(case, 26))
    assert median > 0.5 and (scale < 1 or median < 2)


def test_a_factor_too_stiff_in_half_of_the_body_is_off_by_some_times_the_position():
    """What no estimate sees (kernels/error_estimate.cuh); a factor of softer parts is only slower."""
    wrong = simulation(beam([{"young": 5e8, "where": "X > 5"}, {"young": 5e5}]), preconditioner="cholesky")
    wrong.engine.assemble()
    pattern, values = factor_of(wrong, dtype=np.float32)
    sim = simulation(beam(), gravity=GRAVITY, preconditioner="cholesky", update="never", max_iterations=3000)

    def prepare(step: int) -> None:
        if step == 0:
            sim.engine.post_factor(0, pattern, values, 0)

    found = [s.true / s.position for s in solves(sim, 30, prepare, positions=POSITIONS, tolerances=(1e-12,))]
    assert np.median(found) <= 1 and max(found) < 10


@pytest.mark.parametrize("woodbury", [32, 0], ids=["corrected", "not corrected"])
def test_in_the_step_in_which_a_grab_begins(woodbury):
    table = bar((4, 2, 2), young=1e6, fixed="X < 0.01", touch={"max_force": 1e30})
    sim = simulation(table, gravity=GRAVITY, preconditioner="cholesky", update="never", woodbury=woodbury)
    touch = sim.effects["touch"]
    assert isinstance(touch, Touch)

    def prepare(step: int) -> None:
        if step == 0:
            pattern, values = factor_of(sim, dtype=np.float32)
            sim.engine.post_factor(0, pattern, values, 0)
        if step == 5:  # from the next step on
            at = (2.0, 1.0, 0.5)
            touch.grab("anna", "bar", at, 0.6, (2.0, 1.05, 0.5), 1e8, 0.0, np.inf)

    found = solves(sim, 16, prepare, after=6, positions=(1e-4, 1e-5, 1e-6), tolerances=(1e-12,))
    assert max(s.true / s.position for s in found) <= 1
    effectivity = np.array([s.estimate / s.true for s in found])
    assert effectivity.min() > 1 / FACTOR_TRUST / 2


@pytest.mark.parametrize("objects", [1, 2])
@pytest.mark.parametrize("steps", [2, 25], ids=["impact", "rest"])
def test_in_contact_positions_are_as_exact_as_asked(objects, steps):
    """Against the same step solved to rounding; two blocks are an island."""
    solver = {"preconditioner": "block_jacobi", "update": "never", "tolerance": 1e-12, "max_iterations": 2000}
    tables = [block(name="low"), block(name="high", at=(0.01, 0.06 + 2 * D, 0.01))][:objects]

    def end(position: float) -> tuple[np.ndarray, np.void]:
        sim = over(objects=tables, velocity=(0, -0.5, 0), solver=solver)
        sim.engine.run(steps)
        sim.engine.records()
        for body in range(objects):
            sim.engine.settings(body).position = position
        sim.engine.run(1)
        return sim.world.x.copy(), sim.engine.records()[0]

    exact, tight = end(0.0)
    for position in (1e-5, 1e-8):
        x, record = end(position)
        true = nodal(x - exact)
        assert record["status"] == 0 and record["contacts"] == tight["contacts"] > 0
        assert true <= position and record["iterations"] <= tight["iterations"]
        assert record["solve_error"] > 0.1 * true


@pytest.mark.parametrize("scheme", ["ros2", "newmark", "bdf2", "quasi_static"])
@pytest.mark.parametrize("young", [5e5, 1e8], ids=["soft", "stiff"])
def test_positions_after_a_step_of_any_scheme_are_as_exact_as_asked(scheme, young):
    """Against the same step solved to rounding; ros2 solves twice a step. Without masses, and with block Jacobi alone,
    conjugate gradients may stand still before they have seen the softest modes: there it is some times as much."""
    static = scheme == "quasi_static"
    young *= 20 if static and young == 5e5 else 1  # a softer one turns over
    case = Case(beam(young), None, by("block_jacobi"), {"scheme": scheme})

    def end(position: float) -> tuple[np.ndarray, np.void]:
        sim, _ = made(case, tolerance=1e-12)
        sim.engine.run(3)
        sim.engine.records()
        sim.engine.settings(0).position = position
        sim.engine.run(1)
        return sim.world.x.copy(), sim.engine.records()[0]

    exact, tight = end(0.0)
    for position in (1e-3, 1e-5):
        x, record = end(position)
        assert nodal(x - exact) <= (10 * position if static else position) and record["status"] == 0
        assert record["solve_error"] <= position and record["iterations"] < tight["iterations"]


def test_a_body_at_rest_has_no_error_and_takes_no_iterations():
    sim = simulation(bar((4, 1, 1), fixed="X < 0.01"), preconditioner="block_jacobi")
    sim.engine.settings(0).position = 1e-4
    sim.engine.run(3)
    records = sim.engine.records()
    assert not records["iterations"].any() and not records["solve_error"].any()
    assert np.isnan(records["step_error"]).all()


def table() -> str:
    """Rows of a Markdown table: median, least and largest effectivity, and error over position."""
    rows = ["| case | median | least | largest | error / position | iterations |", "|---|---|---|---|---|---|"]
    for name, case in CASES.items():
        e, found = effectivities(case, 62), bounded(case, 62)
        worst, mean = max(s.true / s.position for s in found), np.mean([s.record["iterations"] for s in found])
        rows.append(f"| {name} | {np.median(e):.2g} | {e.min():.2g} | {e.max():.2g} | {worst:.2g} | {mean:.1f} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(table())
