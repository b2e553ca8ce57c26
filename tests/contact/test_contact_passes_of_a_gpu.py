# SPDX-License-Identifier: MIT
"""The kernels of contact of a GPU, run by threads of the processor, step by step against the loop of the CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from sim_server.backends.declarations import Declarations
from tests.contact.kernels_beside import TEXT, Beside, compiled
from tests.contact.scenes import D, block, edge, floor, over, ram

SET_BACK = Declarations("kernels/kinds.h").enumeration("Status")["CONTACT"]
ROUNDS = Declarations("kernels/contact_passes.cuh").constant("ROUNDS")
STEP = """
extern "C" int step(const ContactArguments* c, const ContactSolve* first, const ContactSolve* pass, const System* s) {
    int loops = 0;
    launch(s->bodies, CONTACT_THREADS, [&] { begin_contact(*c); });
    for (one_pass(*c, *first, *s); *c->active > 0 && loops < 200; ++loops) one_pass(*c, *pass, *s);
    launch(s->grid, CONTACT_THREADS, [&] { finish_contact(*c); });
    return loops;
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("passes"), TEXT + STEP)


SMALL: dict[str, Any] = {"cells": (3, 2, 3), "solver": {"preconditioner": "block_jacobi"}}


def test_a_block_falls_and_comes_to_rest(library, monkeypatch):
    beside = Beside(library, over(at=(0, 0.02, 0), **SMALL), monkeypatch)
    records = [beside.compare(1e-7) for _ in range(12)]
    assert records[0]["contacts"] == 0 and records[-1]["contacts"] == 16 and max(r["passes"] for r in records) > 2


def test_a_copy_of_the_matrix_knows_contacts(library, monkeypatch):
    """As on a CPU: those that carried force in the step before."""
    beside = Beside(library, over(velocity=(1, 0, 0), **SMALL), monkeypatch)
    values = beside.arrays["values"]
    for step in range(4):
        beside.compare(1e-7)
        made = beside.matrix - values
        assert np.abs(beside.gpu.twin(values) - beside.matrix).max() <= 1e-12 * np.abs(values).max()
        assert np.array_equal(beside.passes.known(values), beside.gpu.twin(values))
        assert (np.abs(made).max() > 0) == (step > 0)


def test_a_block_slides(library, monkeypatch):
    beside = Beside(library, over(velocity=(2, 0, 0), friction=0.1, **SMALL), monkeypatch)
    for _ in range(10):
        record = beside.compare(1e-6)
    force, traction = beside.contact.force, np.linalg.norm(beside.contact.traction, axis=1)
    limit = (0.1 * 0.5) ** 0.5 * force
    assert record["contacts"] == (force > 0).sum() > 8 and (traction > 0.9 * limit)[force > 0].any()


def test_a_block_at_rest_whose_edge_is_lifted_needs_one_solve_a_step(library, monkeypatch):
    """Nodes a little further off than the thickness would be hit without the forces that are there."""
    beside = Beside(library, over(*edge(), **SMALL), monkeypatch)
    records = [beside.compare(1e-6) for _ in range(9)]
    hit = beside.contact.entry <= 1
    assert (hit & (beside.contact.force == 0)).sum() >= 4 and records[-1]["contacts"] == 16
    assert max(r["passes"] for r in records[-2:]) <= 1


def test_an_obstacle_hits_a_block_at_10_m_per_s(library, monkeypatch):
    beside = Beside(library, over(ram(), floor(), at=(0, 0.02, 0), **SMALL), monkeypatch)
    records = [beside.compare(1e-6) for _ in range(5)]
    assert max(r["contacts"] for r in records) == 16 and max(r["passes"] for r in records) > 6


@pytest.mark.parametrize(("few", "rounds"), [({"passes": 1}, 0), ({"passes": 200, "stiffness": 1e-5}, ROUNDS)], ids=str)
def test_points_are_held_back_where_passes_or_rounds_run_out(library, monkeypatch, few, rounds):
    beside = Beside(library, over(ram(), floor(), at=(0, 0.02, 0), contact=few, **SMALL), monkeypatch)
    records = [beside.compare(1e-6) for _ in range(3)]
    assert beside.rounds == rounds and max(r["clipped"] for r in records) > 0
    assert {r["status"] for r in records if r["clipped"]} == {SET_BACK}


def test_bodies_go_their_own_ways(library, monkeypatch):
    objects = [block(cells=(2, 1, 2), at=(0, 0.004, 0)), block(0.3, (3, 2, 3), at=(0.3, 0.02, 0), name="other")]
    apart = {"thickness": D, "between": False}
    beside = Beside(library, over(objects=objects, contact=apart, solver=SMALL["solver"]), monkeypatch)
    for _ in range(6):
        beside.compare(1e-6)
