# SPDX-License-Identifier: MIT
"""Bodies that touch themselves: the kernels of a GPU, run by threads of the processor, step by step against the loop of
the CPU."""

import ctypes as c
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu.islands import OWN_SURFACES
from sim_server.simulation import Simulation
from tests.contact.kernels_beside import TEXT, compiled
from tests.contact.scenes import floor, fork
from tests.contact.test_contact_islands_of_a_gpu import ISLANDS, STEP, TIGHT, IslandsBeside
from tests.contact.test_self_contact import body, close, crossings, made, own_rows
from tests.state import put

CELLS = (6, 5, 1)  # of a fork
CONTACT: dict[str, Any] = {"tolerance": 1e-8, "passes": 200}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("own"), TEXT + ISLANDS + STEP, OWN_SURFACES)


class OwnBeside(IslandsBeside):
    """Steps of bodies that touch themselves. Each may be an island."""

    singles = True

    def momentum(self) -> np.ndarray:
        """Of the kernels' solution [kg m/s]."""
        w = self.sim.world
        change = np.einsum("n,nij,nj->i", w.mass, self.arrays["rotation"], self.gpu.twin(self.arrays["y"]))
        return np.asarray(w.mass @ w.predictor + change)


def uneven(sim: Simulation) -> Simulation:
    """Moves nodes a little: of triangles that a vertex meets at once each device takes another one."""
    put(sim, sim.world.x, sim.world.x + np.random.default_rng(1).normal(0, 1e-4, sim.world.x.shape))
    return sim


def arms(folder: Path, speed: float, **contact: Any) -> Simulation:
    """A fork whose arms are driven into each other, without momentum."""
    sim = made(body(fork(folder, CELLS)), contact=CONTACT | contact, solver=TIGHT)
    close(sim, speed)
    return uneven(sim)


def two_forks(folder: Path, **contact: Any) -> Simulation:
    """One of them comes down on the other one while the arms of both meet."""
    mesh = fork(folder, CELLS)
    one, other = body(mesh, "one"), body(mesh, "other", pose={"translate": [0.033, 0.004, 0.0125]})
    sim = made(one, other, contact=CONTACT | contact, solver=TIGHT)
    close(sim, 1.0)
    v = sim.world.v.copy()
    v[sim.world.bodies[1].nodes, 2] -= 0.3
    put(sim, sim.world.v, v)
    return uneven(sim)


@pytest.mark.parametrize("speed", [1.0, 10.0, 50.0])
def test_arms_that_are_driven_into_each_other(library, monkeypatch, tmp_path, speed):
    """The body is an island of its own, its records are those of the CPU, and momentum is kept."""
    beside = OwnBeside(library, arms(tmp_path, speed), monkeypatch)
    size = beside.sim.world.mass.sum() * speed
    first, then = beside.near(1e-6), beside.near(1e-6)
    assert (first["contacts"][0] > 0) == (speed > 1) and len(own_rows(beside.sim)) and crossings(beside.sim) == 0
    assert beside.tally["islands"] == 1 and beside.tally["alone"] == 0 and beside.seen == 0
    assert abs(beside.momentum()).max() <= 1e-8 * size
    ours = beside.gpu.twin(beside.arrays["values"])[: len(beside.matrix)]  # with the contacts of the first step
    assert np.abs(ours - beside.matrix).max() <= 1e-6 * np.abs(beside.matrix).max() and then["passes"][0] > 0


def test_a_body_that_is_nowhere_near_itself_is_no_island(library, monkeypatch, tmp_path):
    beside = OwnBeside(library, arms(tmp_path, 0.0), monkeypatch)
    beside.sim.world.v[:, 2] = 1.0
    assert beside.near(1e-6)["passes"][0] == 0
    assert beside.tally["islands"] == 0 and beside.tally["alone"] == 1


def test_arms_that_still_pass_are_held_apart(library, monkeypatch, tmp_path):
    """Contacts with hardly any stiffness; both sides by their masses, and each place counts once."""
    beside = OwnBeside(library, arms(tmp_path, 3.0, stiffness=1e-6, passes=30), monkeypatch)
    assert beside.near(1e-5)["clipped"][0] > 0 and beside.tally["rounds"] == 3
    assert abs(beside.momentum()).max() <= 1e-8 * beside.sim.world.mass.sum() * 3.0


def test_a_strip_that_folds_onto_itself_on_a_floor(library, monkeypatch):
    """With friction, its memory, and rows of sweeps, from where it begins to touch itself."""
    pose = {"rotate": [0, 0, 88], "translate": [0, 0.001, 0]}
    strip = body(
        {"bar": [24, 1, 1], "size": [0.24, 0.005, 0.01], "split": "kuhn"}, young=3e3, damping=(4.0, 0.004), pose=pose
    )
    sims = [
        made(strip, gravity=(0, -9.81, 0), dt=0.01, solver=TIGHT, obstacle=[floor()], contact=CONTACT) for _ in range(2)
    ]
    first, sim = sims
    given = first.contact.contact_input()
    while not (given.force[own_rows(first)] > 0).any():
        first.engine.run(1)
    for name in ("x", "v"):
        put(sim, getattr(sim.world, name), getattr(first.world, name).copy())
    beside, touched, sweeps = OwnBeside(library, sim, monkeypatch), 0, 0
    for _ in range(4):
        beside.near(1e-6)
        rows = own_rows(sim)
        touched += int((sim.contact.contact_input().force[rows] > 0).sum())
        sweeps += int(beside.tally["rounds"])
        assert crossings(sim) == 0
    assert touched > 0 and sweeps > 0


@pytest.mark.parametrize("between", [True, False])
def test_two_bodies_that_touch_themselves(library, monkeypatch, tmp_path, between):
    """And each other, of which alone forces are told, or not."""
    beside = OwnBeside(library, two_forks(tmp_path, between=between), monkeypatch)
    beside.near(1e-6)
    rows, given = own_rows(beside.sim), beside.contact
    owner = np.where(given.corner[rows, 0] < beside.sim.world.bodies[1].first, 0, 1)
    assert set(given.obstacle[rows] == owner) == ({True, False} if between else {True})
    assert beside.tally["islands"] == 2 - between and beside.seen == 2 * between
