# SPDX-License-Identifier: MIT
"""Factors of matrices from before a cut: symmetric, positive, and nearly as good as one that knows of it."""

from typing import Any

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.effects.cutting import Cutting
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.cutting.cut_scenes import cut, made
from tests.scenes import factor_of

CUTS = {
    "slit": "abs(X - 1) < 0.1 and Y > 0.25",
    "corner": "X > 1.6 and Y > 0.25 and Z > 0.25",
    "through": "abs(X - 1) < 0.1",
}
NOTHING = "X < -1"
FINE = {"bar": [20, 5, 5], "size": [2.0, 0.5, 0.5], "split": "mirrored"}
SCATTERED = " or ".join(f"abs(X - {x:.1f}) < 0.03" for x in np.arange(0.2, 2, 0.2))  # a sheet out of each two layers
STIFF = {"corotational": {"young": 2e6, "poisson": 0.45}}


def beam(update: str, preconditioner: str = "cholesky", **keys: Any) -> Simulation:
    solver = {"preconditioner": preconditioner, "update": update, "max_iterations": 3000, "tolerance": 1e-6}
    return made(mesh=FINE, own=STIFF, solver=solver, **keys)


def iterations(sim: Simulation, where: str, steps: int = 3) -> list[int]:
    """Those of the steps after a cut. The factor of `lockstep-6` is from before it."""
    driver = Driver(sim)
    driver.advance(14)
    cut(sim, where)
    records = driver.advance(steps)
    assert (records["status"] == pb.CONVERGED).all()
    return records["iterations"].tolist()


@pytest.mark.parametrize("name", CUTS)
def test_an_old_factor_serves_after_a_cut_as_it_did_before(name, monkeypatch):
    where = CUTS[name]
    after, uncut = iterations(beam("lockstep-6"), where), iterations(beam("lockstep-6"), NOTHING)
    assert max(after) <= 2 * max(uncut) + 4
    assert max(iterations(beam("every-1", "block_jacobi"), where)) > 4 * max(after)
    monkeypatch.setattr(Cutting, "cut_input", lambda *_: None)
    plain = beam("lockstep-6")
    plain.engine.forget_matrices(0)  # or the factor would be refreshed where the cut changed the matrix
    assert max(iterations(plain, where)) > 2 * max(after), "without the method"


def prepared(where: str) -> Simulation:
    """A factor, then a cut, and the matrix after it."""
    sim = beam("never")
    sim.engine.run(3)
    sim.engine.post_factor(0, *factor_of(sim), sim.engine.step)
    sim.engine.run(1)
    cut(sim, where)
    sim.engine.run(1)
    sim.engine.assemble()
    return sim


def test_the_corrected_factor_is_symmetric_and_positive():
    sim = prepared(CUTS["slit"])
    random = np.random.default_rng(1)
    n = 3 * sim.world.nodes
    there = np.repeat(sim.world.free > 0, 3)
    r, s = random.standard_normal((2, n)) * there
    z, y = sim.engine.precondition(0, r), sim.engine.precondition(0, s)
    assert z @ s == pytest.approx(y @ r, rel=1e-5) and z @ r > 0 and y @ s > 0
    gone = np.repeat(sim.cutting.at_rest > 0, 3)
    assert gone.any() and not z[gone].any()


def test_it_is_exact_on_the_nodes_that_lost_elements():
    """P^-1 A e = e for what is zero elsewhere: so errors at the cut need no iterations."""
    sim = prepared(CUTS["slit"])
    lost = (sim.cutting.changed_at > 0) & (sim.world.free > 0)
    e = np.repeat(lost, 3) * np.random.default_rng(2).standard_normal(3 * sim.world.nodes)
    found = sim.engine.precondition(0, sim.matrix() @ e)
    np.testing.assert_allclose(found, e, atol=1e-5 * np.abs(e).max())


def test_a_cut_too_large_for_a_direct_solve_sets_nodes_without_elements_apart_alone():
    sim = beam("lockstep-6")
    found = iterations(sim, SCATTERED, steps=2)
    wanted, treated, gone = sim.engine.cut_nodes(0)
    assert wanted > 0 and treated == 0 and gone > 0
    assert max(found) < 1500


def test_steps_by_the_factor_alone_iterate_until_it_knows_of_the_cut():
    sim = beam("lockstep-4", integrator={"scheme": "ros2"})
    driver = Driver(sim)
    driver.advance(20)
    cut(sim, CUTS["slit"])
    records = driver.advance(16)
    forms, knows = records["form"], records["factor_step"] >= 20
    assert (forms[~knows] != pb.FACTOR).all() and (~knows).any()
    assert (forms[knows] == pb.FACTOR).any(), "then steps need no iterations again"
    assert (records["status"] == pb.CONVERGED).all()
