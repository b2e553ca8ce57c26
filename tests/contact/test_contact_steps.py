# SPDX-License-Identifier: MIT
"""Steps with contact solve the equations with the law, with any preconditioner; without it they are as ever."""

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.mesh import posed
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import D, block, floor, over
from tests.reference import contact as reference
from tests.scenes import simulation

STATUS = KINDS.enumeration("Status")
JACOBI = {"preconditioner": "block_jacobi"}
STARTS = {
    "rest": {}, "slide": {"velocity": (1, 0, 0)}, "impact": {"velocity": (1, -3, 0), "at": (0, 0.02, 0)},
    "tumble": {"at": (0, 0.01, 0), "rotate": (30, 20, 40)},
}  # fmt: skip


@pytest.mark.parametrize("start", STARTS)
def test_the_residual_with_the_law_is_as_told(start):
    sim = over(solver=JACOBI | {"max_iterations": 5000}, **STARTS[start])
    for _ in range(40):
        made, record = reference.step(sim)
        rows = sim.contact.contact_input()
        used = rows.obstacle >= 0
        assert record["status"] in (STATUS["CONVERGED"], STATUS["CONTACT"])
        if record["status"] == STATUS["CONVERGED"]:
            assert made.residual <= 1e-3
        if record["passes"]:
            assert made.residual == pytest.approx(record["contact_residual"], rel=0.2, abs=1e-6)
        assert np.allclose(rows.force[used], made.normal, rtol=1e-3, atol=1e-3 * max(made.normal.max(initial=0), 1e-6))


@pytest.mark.parametrize("start", STARTS)
def test_it_is_as_exact_as_the_scene_asks(start):
    contact = {"thickness": D, "tolerance": 1e-10, "passes": 500}
    sim = over(contact=contact, solver=JACOBI | {"max_iterations": 5000, "tolerance": 1e-11}, **STARTS[start])
    for _ in range(25):
        made, record = reference.step(sim)
        assert record["status"] == STATUS["CONVERGED"]
        assert made.residual <= 2e-10


SOLVERS = [
    {"preconditioner": "none"}, JACOBI, {"preconditioner": "ssor"},
    *({"preconditioner": "cholesky", "update": update} for update in ("lockstep-1", "lockstep-10", "never")),
]  # fmt: skip


@pytest.mark.parametrize("start", ["slide", "impact"])
def test_every_preconditioner_gives_the_same_trajectory(start):
    def end(solver: dict) -> np.ndarray:
        contact = {"thickness": D, "tolerance": 1e-8, "passes": 200}
        sim = over(contact=contact, solver=solver | {"tolerance": 1e-9, "max_iterations": 5000}, **STARTS[start])
        assert not Driver(sim).advance(40)["status"].any()
        return sim.world.x.copy()

    ends = [end(solver) for solver in SOLVERS]
    for other in ends[1:]:
        assert abs(other - ends[0]).max() <= 1e-6


def test_a_turned_scene_takes_the_same_iterations_and_moves_alike():
    """The floor, the block, its velocity and gravity, all turned."""
    turn = (20.0, -35.0, 50.0)

    def turned(v: tuple) -> list[float]:
        return [float(c) for c in posed(np.array([v], float), turn, (0, 0, 0))[0]]

    straight = over(velocity=(1, -1, 0.3), at=(0, 0.01, 0))
    other = over(
        floor(pose={"rotate": list(turn)}), objects=[block(rotate=turn, at=turned((0, 0.01, 0)))],
        velocity=turned((1, -1, 0.3)), gravity=turned((0, -9.81, 0)),
    )  # fmt: skip
    a, b = (Driver(sim).advance(60) for sim in (straight, other))
    assert b["iterations"].sum() == pytest.approx(a["iterations"].sum(), rel=0.2)
    assert abs(other.world.x - posed(straight.world.x, turn, (0, 0, 0))).max() <= 2e-5


def test_a_body_that_touches_nothing_moves_as_without_the_effect_to_the_bit():
    def fall(sim: Simulation) -> np.ndarray:
        records = Driver(sim).advance(20)
        return np.concatenate([sim.world.x.ravel(), records["residual"], records["iterations"]])

    far = {"at": (0, 5, 0), "rotate": (10, 20, 30)}
    bare = simulation(_without_friction(block(**far)), dt=1 / 60, gravity=(0, -9.81, 0), **JACOBI)
    assert np.array_equal(fall(over(solver=JACOBI, **far)), fall(bare))


def _without_friction(table: dict) -> dict:
    return {key: value for key, value in table.items() if key != "friction"}


def test_a_step_repeats_to_the_bit():
    runs = [over(**STARTS["tumble"]) for _ in range(2)]
    records = [Driver(sim).advance(60) for sim in runs]
    assert np.array_equal(runs[0].world.x, runs[1].world.x)
    assert np.array_equal(records[0]["iterations"], records[1]["iterations"])


def test_passes_that_run_out_are_told():
    contact = {"thickness": D, "passes": 1, "tolerance": 1e-6}
    sim = over(contact=contact, velocity=(3, -10, 0), at=(0, 0.02, 0))
    records = Driver(sim).advance(10)
    told = records["status"] == STATUS["CONTACT"]
    assert told.any()
    assert (records["contact_residual"][told] > 1e-6).all()
    assert (records["passes"] <= 1 + 3).all()


def test_records_without_contact_have_none():
    sim = over(at=(0, 5, 0))
    records = Driver(sim).advance(5)
    assert not records["contacts"].any() and not records["passes"].any()
    assert np.isnan(records["contact_residual"]).all()


def test_one_that_forces_make_nan_goes_back_and_the_other_rests():
    sim = over(objects=[block(name="a"), block(name="b", at=(0, D, 0.3))])
    Driver(sim).advance(60)
    x = sim.world.x[sim.world.bodies[0].nodes].copy()
    sim.world.x[sim.world.bodies[1].nodes] = np.nan
    records = Driver(sim).advance(5)
    assert (records["status"][records["body"] == 1] != STATUS["CONVERGED"]).any()
    assert abs(sim.world.x[sim.world.bodies[0].nodes] - x).max() <= 1e-8


def test_a_factor_learns_of_contact():
    """Once the worker has seen the contacts, sliding costs a few iterations; without, many more (never: the first)."""

    def iterations(update: str) -> float:
        sim = over(velocity=(3, 0, 0), solver={"preconditioner": "cholesky", "update": update}, cells=(8, 5, 8))
        return float(Driver(sim).advance(30)["iterations"][15:].mean())

    assert iterations("lockstep-2") <= 0.6 * iterations("never")
