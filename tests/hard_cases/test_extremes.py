# SPDX-License-Identifier: MIT
"""What clients and workers may do at worst, in one process: factors of any age or of another body, grabs and values
beyond all bounds. None changes an answer, and what is refused is refused by its reason.

Workers and clients that do it over the network: tests/system/test_hostile_answers.py, tests/faults.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from protocol.factor import Factor
from sim_server.effects.touch import TouchError
from sim_server.parameters import BadParameter
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from tests.cutting.cut_scenes import cut, made
from tests.scenes import bar, simulation

STEPS = 120
BAR = {"cells": (4, 1, 1), "size": (0.4, 0.1, 0.1), "young": 1e5, "fixed": "X < 0.01", "damping": (1.0, 0.0)}
DOWN = (0.0, -9.81, 0.0)


def moved(update: str, **solver: object) -> np.ndarray:
    sim = simulation(bar(**BAR), gravity=DOWN, update=update, tolerance=1e-8, **solver)
    assert (Driver(sim).advance(STEPS)["status"] == 0).all()
    return sim.world.x


@pytest.mark.parametrize("age", [1, 10, 100])
def test_the_age_of_a_factor_does_not_change_the_answer(age: int) -> None:
    exact = moved("never", preconditioner="block_jacobi")
    np.testing.assert_allclose(moved(f"lockstep-{age}", preconditioner="cholesky"), exact, atol=1e-6 * 0.4)


class Swapped(Inline):
    """Gives each of two equal bodies the factor of the other one."""

    def poll(self) -> list[Factor]:
        return [replace(f, object="right" if f.object == "left" else "left") for f in super().poll()]


def test_the_factor_of_another_object_does_not_change_the_answer() -> None:
    def pair(swapped: bool) -> Simulation:
        stiff = bar(**BAR | {"young": 1e8}, name="left")
        soft = bar(**BAR, name="right", pose={"translate": [0, 1, 0]})
        table = {"preconditioner": "cholesky", "update": "lockstep-2", "tolerance": 1e-8}
        sim = simulation(stiff, soft, gravity=DOWN, **table)
        patterns = {b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies}
        records = Driver(sim, Swapped(patterns) if swapped else None).advance(STEPS)
        assert (records["status"] == 0).all()
        return sim

    np.testing.assert_allclose(pair(True).world.x, pair(False).world.x, atol=1e-6 * 0.4)


class Negated(Inline):
    """Factorizes -A, which is not positive definite."""

    def submit(self, job: Job) -> bool:
        return super().submit(replace(job, values=-job.values))


def test_the_factor_of_the_negated_matrix_does_not_change_the_answer() -> None:
    """Every pivot is turned: that is a factor of A again, or none."""
    sim = simulation(bar(**BAR), gravity=DOWN, update="lockstep-2", preconditioner="cholesky", tolerance=1e-8)
    source = Negated({b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies})
    assert (Driver(sim, source).advance(STEPS)["status"] == 0).all()
    exact = moved("never", preconditioner="block_jacobi")
    np.testing.assert_allclose(sim.world.x, exact, atol=1e-6 * 0.4)


@pytest.mark.parametrize("force", [(1e6, 0, 0), (math.nan, 0, 0), (math.inf, 0, 0)])
def test_a_push_beyond_all_bounds_is_refused_and_nothing_moves(force: tuple[float, float, float]) -> None:
    sim = simulation(bar(**BAR, touch=True), preconditioner="block_jacobi")
    assert sim.touch is not None
    with pytest.raises(TouchError, match=r"max_force|finite"):
        sim.touch.push("c", "bar", (0.4, 0, 0), 0.0, force, 1.0)
    before = sim.world.x.copy()
    sim.engine.run(3)
    np.testing.assert_array_equal(sim.world.x, before)


def test_a_grab_of_1e6_newton_exerts_what_the_object_allows() -> None:
    sim = simulation(bar(**BAR, touch={"max_force": 5.0}), preconditioner="block_jacobi")
    assert sim.touch is not None
    sim.touch.grab("c", "bar", (0.4, 0, 0), 0.0, (100.0, 0, 0), 1e9, 1e6, 10.0)
    before = sim.world.x.copy()
    sim.engine.run(200)
    moved = np.abs(sim.world.x - before).max()
    assert 5.0 * 0.4 / (1e5 * 0.01) < moved < 0.02, "a bar of E = 1e5 Pa under 5 N, and a dent"


def test_a_node_without_elements_cannot_be_grabbed() -> None:
    sim = made(own={"touch": True})
    cut(sim, "X > 1")
    sim.engine.run(1)
    assert sim.touch is not None
    with pytest.raises(TouchError, match="no free node"):
        sim.touch.grab("c", "bar", (2.0, 0.25, 0.25), 0.1, (3.0, 0, 0), 100.0, 10.0, 1.0)


def test_the_time_step_of_a_run_does_not_change() -> None:
    sim = simulation(bar(**BAR), preconditioner="block_jacobi")
    sim.engine.run(1)
    with pytest.raises(BadParameter, match="cannot change while steps run"):
        sim.parameters.set({"dt": "1e-6"})
