# SPDX-License-Identifier: MIT
"""Bodies that touch themselves on a GPU beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import fork
from tests.contact.test_self_contact import EXACT, body, close, crossings, made
from tests.state import put

pytestmark = pytest.mark.gpu

STATUS = KINDS.enumeration("Status")
RIBBON = "deploy/scenes/ribbon.toml"
Cells = tuple[int, int, int]
THIN = (6, 5, 1)  # cells of a fork


def arms(folder: Path, speed: float, uneven: float = 0.0, cells: Cells = (8, 5, 2), **table: Any) -> Simulation:
    """A fork whose arms are driven into each other, without momentum. uneven: by which nodes are moved [m]"""
    sim = made(body(fork(folder, cells)), contact={"passes": 200, "tolerance": table.pop("tolerance", 1e-3)}, **table)
    close(sim, speed)
    put(sim, sim.world.x, sim.world.x + np.random.default_rng(1).normal(0, 1, sim.world.x.shape) * uneven)
    return sim


@pytest.mark.parametrize("speed", [1.0, 10.0, 50.0])
def test_arms_that_are_driven_into_each_other_do_not_pass_and_keep_their_momentum(tmp_path, speed):
    sim = arms(tmp_path, speed, device="gpu")
    w, size = sim.world, (sim.world.mass * np.linalg.norm(sim.world.v, axis=1)).sum()
    for _ in range(8):
        sim.engine.run(1)
        sim.fetch()
        assert crossings(sim) == 0
    records = sim.engine.records()
    assert (records["status"] == STATUS["CONVERGED"]).all() and records["contacts"].max() > 0
    assert abs(w.mass @ w.v).max() <= 1e-9 * size
    assert not len(sim.engine.other_reactions())  # what a body exerts on itself is nothing


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_tight_tolerances_leave_no_difference(tmp_path, speed):
    """One cell thick: of triangles that a vertex meets at once each device takes another one."""
    sims = [arms(tmp_path, speed, 1e-4, THIN, tolerance=1e-8, device=device) for device in ("gpu", "cpu")]
    for _ in range(6):
        for sim in sims:
            sim.engine.run(1)
        sims[0].fetch()
        assert np.abs(sims[0].world.x - sims[1].world.x).max() < 1e-8
    g, c = (sim.engine.records() for sim in sims)
    assert (g["contacts"] == c["contacts"]).all() and (g["status"] == c["status"]).all()
    assert g["work"] == pytest.approx(c["work"], rel=1e-3, abs=1e-7)


def test_arms_with_hardly_any_stiffness_are_held_apart(tmp_path):
    contact = {"passes": 30, "tolerance": 1e-8, "stiffness": 1e-6}
    sim = made(body(fork(tmp_path)), contact=contact, device="gpu")
    close(sim, 3.0)
    size = (sim.world.mass * np.linalg.norm(sim.world.v, axis=1)).sum()
    sim.engine.run(2)
    sim.fetch()
    assert sim.engine.records()["clipped"].any()
    assert abs(sim.world.mass @ sim.world.v).max() <= 1e-8 * size


def test_a_ribbon_falls_and_comes_to_rest_on_itself():
    keys = ["solver.preconditioner=cholesky", "solver.update=lockstep-3"]
    sim = Simulation.load(RIBBON, keys, "gpu")
    driver = Driver(sim)
    for _ in range(25):
        records = driver.advance(20)
        sim.fetch()
        assert crossings(sim) == 0
    assert records["contacts"][-1] > 20 and abs(sim.world.v).max() < 1e-2


@pytest.mark.parametrize("what", ["arms", "ribbon"])
def test_runs_repeat_to_the_bit(tmp_path, what):
    """Also in batches, whose steps are one graph, and by halves of a step."""

    def run(advance: Callable[[Simulation], None]) -> list[bytes]:
        keys = ["solver.preconditioner=block_jacobi"]
        sim = arms(tmp_path, 10.0, device="gpu") if what == "arms" else Simulation.load(RIBBON, keys, "gpu")
        advance(sim)
        records = sim.engine.records()
        sim.fetch()
        names = ("residual", "contact_residual", "iterations", "passes", "contacts", "work", "status")
        return [sim.world.x.tobytes(), sim.world.v.tobytes(), *(records[n].tobytes() for n in names)]

    def singly(sim: Simulation) -> None:
        for _ in range(25):
            sim.engine.run(1)

    def by_halves(sim: Simulation) -> None:
        for _ in range(25):
            sim.engine.assemble()
            sim.engine.solve()

    first, *others = [run(lambda sim: sim.engine.run(25)), run(singly), run(by_halves)]
    assert all(other == first for other in others)


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_other_precisions_do_not_let_arms_pass(tmp_path, precision):
    sim = arms(tmp_path, 10.0, device="gpu", solver=EXACT | {"precision": precision, "tolerance": 1e-5})
    for _ in range(4):
        sim.engine.run(1)
        sim.fetch()
        assert crossings(sim) == 0
    assert sim.engine.records()["contacts"].any()
