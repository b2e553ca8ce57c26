# SPDX-License-Identifier: MIT
"""Solves of bodies that touch each other that end by the estimated error of positions: the kernels of a GPU, run by
threads of the processor."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.contact.kernels_beside import TEXT, compiled
from tests.contact.test_contact_islands_of_a_gpu import ISLANDS, STEP, IslandsBeside, pile

POSITION = 1e-7  # [m]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("islands"), TEXT + ISLANDS + STEP, "-DERRORS")


def bounded(position: float) -> Simulation:
    """Two blocks, one on the other."""
    table: dict[str, Any] = pile(2).scene.resolved() | {"accuracy": {"position": position}}
    table["effects"]["contact"]["tolerance"] = 1e-3
    table["solver"] = {"preconditioner": "block_jacobi", "max_iterations": 3000}
    return Simulation(Scene.model_validate(table, context={"folder": "."}))


def test_solves_end_within_the_bound_as_on_a_cpu(library, monkeypatch):
    ours, exact = (IslandsBeside(library, bounded(p), monkeypatch) for p in (POSITION, 1e-13))
    told = []
    for number in range(4):
        y, theirs = ours.step()
        reference, _ = exact.step()
        result, record = ours.results[number], ours.sim.engine.records()
        assert (result["status"] == SolveStatus.CONVERGED).all()
        assert (ours.told[number]["residual"] <= 1e-3).all()
        dx_dv = ours.bodies["dx_dv"][0]
        if number == 0:  # from the same state
            assert dx_dv * np.linalg.norm(y - reference, axis=1).max() <= POSITION
        assert dx_dv * np.linalg.norm(y - theirs, axis=1).max() <= 2 * POSITION
        assert (np.abs(result["iterations"] - record["iterations"]) <= 2 * record["passes"] + 2).all()
        assert (result["iterations"] < exact.results[number]["iterations"]).all()
        told.append((result["solve_error"], record["solve_error"]))
        ours.counter += 1
        exact.counter += 1
    found, known = (np.array(x) for x in zip(*told, strict=True))
    assert (found > 0).all() and 3 * found.max() <= POSITION
    assert np.nanmax(np.abs(np.log(found / known))) < np.log(5)
