# SPDX-License-Identifier: MIT
"""Contacts that a factor does not know: its correction (woodbury.h), and block Jacobi (pass_choice.cuh)."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.cpu import corrections
from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import block, floor, over
from tests.scenes import factor_of

BEAM: dict[str, Any] = {
    "cells": (20, 2, 2), "size": (0.4, 0.02, 0.02), "young": 1e7, "friction": 0.5, "fixed": "X < 0.001",
    "damping": (5.0, 0.0), "at": (0, 0, 0),
}  # fmt: skip
EXACT = {"preconditioner": "cholesky", "factor_precision": "float64", "tolerance": 1e-8, "update": "never"}
PRESSED, LIFTED = 28, 30  # steps: until the rod presses, and until it begins to leave


def pressed(device: str = "cpu", **solver: Any) -> Simulation:
    """A slender beam that a rod bends upwards, slides along, and leaves."""
    times = ((0.0, 0.3, -0.014), (0.15, 0.3, 0.01), (0.45, 0.36, 0.01), (0.6, 0.36, -0.05), (9.0, 0.36, -0.05))
    frames = [{"time": t, "rotate": [90, 0, 0], "translate": [x, y, 0.01]} for t, x, y in times]
    rod = {"name": "rod", "shape": "capsule", "radius": 0.01, "length": 0.06, "friction": 0.3, "keyframes": frames}
    contact = {"tolerance": 1e-6, "passes": 50}
    return over(rod, objects=[block(**BEAM)], dt=0.015, contact=contact, solver=EXACT | solver, device=device)


def run(sim: Simulation, steps: int = LIFTED) -> NDArray[Any]:
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    return driver.advance(steps - 1)


def each(records: NDArray[Any]) -> float:
    """Iterations of a pass."""
    touching = records["passes"] > 0
    return float(records["iterations"][touching].sum() / records["passes"][touching].sum())


@pytest.fixture(scope="module")
def known() -> tuple[NDArray[Any], NDArray[np.float64]]:
    sim = pressed()
    return run(sim), sim.world.x.copy()


def test_a_factor_without_contacts_is_corrected_for_those_that_come_and_slide(known):
    records, x = known
    assert (records["status"] == 0).all() and records["contacts"][-1] > 0
    assert (records["kind"] == Kind.CHOLESKY).all()
    sim = pressed(woodbury=0)
    uncorrected = run(sim)
    assert each(records) <= 4
    assert each(uncorrected) >= 2 * each(records)
    np.testing.assert_allclose(sim.world.x, x, rtol=0, atol=1e-7)


@pytest.mark.parametrize("preconditioner", ["block_jacobi", "incomplete_cholesky", "none"])
def test_the_answer_is_that_of_any_preconditioner(known, preconditioner):
    sim = pressed(preconditioner=preconditioner, max_iterations=20_000)
    Driver(sim).advance(LIFTED)
    np.testing.assert_allclose(sim.world.x, known[1], rtol=0, atol=1e-7)


def test_a_factor_that_knows_contacts_is_corrected_for_those_that_are_gone():
    """Made while the rod presses, it serves after the rod has left."""

    def afterwards(woodbury: int) -> NDArray[Any]:
        driver = Driver(pressed(woodbury=woodbury))
        assert driver.advance(PRESSED)["contacts"][-1] > 0
        driver.step_with_fresh_factors()
        records = driver.advance(LIFTED + 20 - PRESSED)
        return records[records["passes"] == 0]["iterations"]

    corrected, uncorrected = afterwards(32), afterwards(0)
    assert corrected.mean() <= 0.75 * uncorrected.mean()


def test_a_factor_replaced_in_mid_contact_knows_what_it_knows():
    sim = pressed()
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    driver.advance(LIFTED // 2)
    driver.step_with_fresh_factors()
    assert each(driver.advance(1)) <= 3
    assert each(driver.advance(LIFTED // 2 - 3)) <= 4


def test_a_memory_too_short_costs_iterations_not_the_answer(known, monkeypatch):
    monkeypatch.setattr(corrections, "KNOWN_CONTACTS", (1, 1))
    sim = pressed()
    run(sim, PRESSED // 2)
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    assert driver.advance(1)["contacts"][0] > 1
    assert sim.engine.corrected(0) == 0
    driver.advance(LIFTED - PRESSED // 2 - 2)
    np.testing.assert_allclose(sim.world.x, known[1], rtol=0, atol=1e-7)


def test_a_factor_that_is_not_of_its_step_costs_iterations_not_the_answer(known):
    """Made of the matrix without contacts, said to be of a step that had some."""
    sim = pressed()
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    driver.advance(4)
    sim.engine.assemble()
    pattern, values = factor_of(sim)
    sim.engine.post_factor(0, pattern, values, sim.engine.step)
    sim.engine.solve()
    corrected = []
    for _ in range(LIFTED - 6):
        assert driver.advance(1)["status"][0] == 0
        corrected.append(sim.engine.corrected(0))
    assert any(corrected)
    np.testing.assert_allclose(sim.world.x, known[1], rtol=0, atol=1e-7)


def test_triangles_that_a_tool_touches_are_corrected_with_what_couples_their_nodes():
    """Between nodes the rod touches triangles alone."""
    sim = pressed()
    run(sim, 18)
    records = Driver(sim).advance(4)
    given = sim.contact.contact_input()
    assert given.faces is not None
    first, last = given.faces.start[[0, -1]]
    assert (given.force[first:last] > 0).any() and not given.force[:first].any()
    assert sim.engine.corrected(0) >= 6
    assert each(records) <= 3


def test_more_contacts_than_are_corrected_are_left_to_the_iteration():
    solver = EXACT | {"woodbury": 4}
    sim = over(cells=(5, 2, 5), solver=solver)
    records = run(sim, 20)
    assert (records["status"] == 0).all()
    assert records["contacts"].max() > 4 and sim.engine.corrected(0) == 0


def test_block_jacobi_takes_over_where_it_costs_less_and_the_factor_where_it_does():
    """A compact block that hits the floor, and a slender beam: both with the factor of their first step."""
    solver = {"preconditioner": "cholesky", "update": "never", "woodbury": 0}
    block_hits = over(floor(0.0), cells=(8, 5, 8), velocity=(0, -3, 0), at=(0, 0.03, 0), contact={}, solver=solver)
    hits = run(block_hits, 12)
    assert (hits["kind"][hits["passes"] > 1] == Kind.BLOCK_JACOBI).any()
    bends = run(pressed(woodbury=0))
    assert (bends["kind"] == Kind.CHOLESKY).mean() >= 0.8


def test_the_scheduler_sees_contacts_as_excess_iterations():
    """Of two blocks the one that touches comes first."""
    objects = [block(name="far", at=(0, 0.5, 0)), block(name="touches", at=(0, 0.002, 0.3))]
    sim = over(objects=objects, velocity=(1, -1, 0), solver={"preconditioner": "cholesky", "update": "never"})
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    driver.advance(5)
    far, touches = (state.solves.excess for state in driver.bodies)
    assert touches > 2 * far
