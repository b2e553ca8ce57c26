# SPDX-License-Identifier: MIT
"""Frames that are held and let go again: the warp switched off and on under a factor that is in use.

For a factor made in step t, following must be the warp, Q_s = R_s R_t^T Q_t, and holding none, Q_s = Q_t, whatever was
done before, between and since (kernels/nodes.cu); and the answer is the same in any frame.
"""

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.driver import Driver
from sim_server.engine import ADOPTED, HELD, MOVED, NOTE_ALWAYS, NOTED, Kind
from sim_server.simulation import Simulation
from tests.scenes import bar, factor_of, rotation, simulation
from tests.solver.solves import solve

POSE = {"pose": {"rotate": [40, 0, 70]}}
BEAM: dict[str, Any] = {
    "cells": (6, 2, 2),
    "size": (3, 1, 1),
    "young": 5e5,
    "poisson": 0.4,
    "fixed": "X < 0.01",
    **POSE,
}
SOLVER: dict[str, Any] = {"preconditioner": "cholesky", "tolerance": 1e-10, "factor_precision": "float64"}


def beam(**solver: Any) -> Simulation:
    """Bends under its weight."""
    return simulation(bar(**BEAM), gravity=(3.0, -9.81, 2.0), **SOLVER | solver)


def factor_at(sim: Simulation) -> None:
    """Half a step that is noted, and the factor of its matrix handed in."""
    settings = sim.engine.settings(0)
    settings.note = NOTE_ALWAYS
    sim.engine.assemble()
    settings.note = 0
    sim.engine.post_factor(0, *factor_of(sim), step=sim.engine.step)
    sim.engine.solve()


def run(sim: Simulation, holds: str) -> list[NDArray]:
    """Steps, each held (h), following (f), or following with a new factor (F) or held with one (H); their frames."""
    frames = []
    for what in holds:
        sim.engine.settings(0).hold = what in "hH"
        if what in "FH":
            factor_at(sim)
        else:
            sim.engine.run(1)
        frames.append(sim.system.rotation.copy())
    return frames


PATTERNS = ["FFffhhffhFffh", "FhhFhhffHffhhf", "FffHHhfhFhfHf", "HhfFhHffh"]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_frames_are_the_factors_own_turned_or_not_whatever_was_done_before(pattern):
    plain, other = beam(), beam()
    pure = run(plain, "".join("F" if what in "FH" else "f" for what in pattern))  # the rotations
    frames = run(other, pattern)
    assert np.abs(other.world.x - plain.world.x).max() < 1e-6 * np.abs(plain.world.x - plain.world.rest).max()
    made = 0
    for s, what in enumerate(pattern):
        turned = frames[made] if what in "hH" else pure[s] @ np.swapaxes(pure[made], 1, 2) @ frames[made]
        if s > 0:
            assert np.abs(frames[s] - turned).max() < 1e-6
        if what in "FH":
            made = s
    assert np.abs(frames[-1] - pure[-1]).max() > 1e-3, "a test of something"


def test_without_holding_nothing_changes_by_a_bit():
    noted, plain = beam(), beam()
    for sim, note in ((noted, NOTE_ALWAYS), (plain, 0)):
        for step in range(8):
            sim.engine.settings(0).note = note
            sim.engine.assemble()
            if step % 3 == 0:
                sim.engine.post_factor(0, *factor_of(sim), step=step)
            sim.engine.solve()
    assert np.array_equal(noted.world.x, plain.world.x)
    assert np.array_equal(noted.engine.records()["iterations"], plain.engine.records()["iterations"])


def test_what_was_done_is_in_the_records():
    sim = beam()
    run(sim, "fFhhfF")
    flags = [0, NOTED, HELD | MOVED | ADOPTED, HELD | MOVED, MOVED, MOVED | NOTED]
    assert sim.engine.records()["warping"].tolist() == flags


@pytest.mark.parametrize("before", ["F", "Fhh", "FhhHffh"])
def test_a_turned_body_needs_one_iteration_also_after_it_was_held(before):
    sim = simulation(bar((5, 2, 2), (2.5, 1, 1), young=1e7), warm_start=False, **SOLVER | {"tolerance": 1e-6})
    sim.world.v[:] = np.random.default_rng(0).normal(scale=0.1, size=sim.world.v.shape)
    run(sim, before + "H")
    R = rotation((1, -2, 0.5), 2.5)
    iterations = {}
    for hold in (False, True):
        sim.engine.settings(0).hold = hold
        x, v = sim.world.x.copy(), sim.world.v.copy()
        sim.engine.assemble()
        here = solve(sim)[1]["iterations"]
        sim.world.x[:], sim.world.v[:] = x @ R.T, v @ R.T
        sim.engine.assemble()
        iterations[hold] = int(solve(sim)[1]["iterations"]) - int(here)
        sim.world.x[:], sim.world.v[:] = x, v
    assert iterations[False] == 0
    assert iterations[True] > 4


def test_a_copied_matrix_is_noted_in_the_step_of_the_copy():
    sim = beam()
    sim.engine.settings(0).note = 2
    target = np.zeros_like(sim.system.values)
    sim.engine.run(2)
    sim.engine.request_matrix(0, target)
    sim.engine.run(2)
    assert sim.engine.matrix_step(0) == 2
    assert sim.engine.records()["warping"].tolist() == [0, 0, NOTED, 0]


@pytest.mark.parametrize("update", ["never", "every-9", "lockstep-1", "lockstep-4"])
def test_auto_tries_and_gives_the_same_motion(update):
    automatic, without = (beam(warp=warp, update=update) for warp in ("auto", False))
    records = Driver(automatic).advance(60)
    others = Driver(without).advance(60)
    held = records["warping"] & HELD > 0
    assert 0 < np.count_nonzero(held) < 30
    assert (others["warping"] & HELD).all()
    assert (records["kind"][held] == Kind.CHOLESKY).all()
    assert np.abs(automatic.world.x - without.world.x).max() < 1e-6 * np.abs(without.world.x - without.world.rest).max()
    assert records["iterations"].sum() < others["iterations"].sum()


def test_further_linearizations_of_a_step_leave_what_was_noted():
    """With Newton-Raphson the launches of a step are made again; a factor is of the first linearization."""
    newton = {"integrator": {"linearizations": 6, "tolerance": 1e-8}}
    pure, mixed = beam(**newton), beam(**newton)
    rotations, frames = [], []
    for step, what in enumerate("FfhFhfhF"):
        for sim, found, held in ((pure, rotations, False), (mixed, frames, what == "h")):
            sim.engine.settings(0).hold, sim.engine.settings(0).note = held, NOTE_ALWAYS if what == "F" else 0
            sim.engine.assemble()
            found.append(sim.system.rotation.copy())
            if what == "F":
                sim.engine.post_factor(0, *factor_of(sim), step=step)
            sim.engine.solve()
    assert (mixed.engine.records()["linearizations"] > 1).all()
    for made, s in ((0, 2), (3, 4), (3, 6)):
        assert np.abs(frames[s] - frames[made]).max() < 1e-12
    for made, s in ((0, 1), (0, 3), (3, 5), (3, 7)):
        turned = rotations[s] @ np.swapaxes(rotations[made], 1, 2) @ frames[made]
        assert np.abs(frames[s] - turned).max() < 1e-6


def test_auto_with_several_bodies_holds_each_for_itself():
    objects = [bar(**BEAM), bar(**BEAM | {"name": "stiff", "pose": {"translate": [0, 9, 0]}, "young": 5e11})]
    solver = {"update": "lockstep-4", **SOLVER, "tolerance": 1e-6}
    sim = simulation(*objects, gravity=(0, -9.81, 0), **solver)
    records = Driver(sim).advance(60)
    held = [np.count_nonzero(records["warping"][records["body"] == body] & HELD) for body in (0, 1)]
    assert held[0] > 0 and held[1] == 0, "it hardly turns"
    alone = simulation(objects[0], gravity=(0, -9.81, 0), **solver)
    assert np.array_equal(Driver(alone).advance(60)["warping"], records["warping"][records["body"] == 0])


def test_where_workers_assemble_frames_follow():
    sim = beam(warp="auto", build="worker", update="lockstep-4")
    assert not any(itertools.chain(Driver(sim).advance(60)["warping"] & HELD))
