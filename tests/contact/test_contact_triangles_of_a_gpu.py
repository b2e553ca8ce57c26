# SPDX-License-Identifier: MIT
"""Rows of triangles against obstacles: the kernels of a GPU, run by threads of the processor, step by step against the
loop of the CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.faces import DEFINED, corners_of_nodes, links_of_corners
from sim_server.simulation import Simulation
from tests.contact.kernels_beside import TEXT, Beside, compiled
from tests.contact.scenes import D, block, floor, over, thrust
from tests.contact.test_contact_triangles import SMALL, obstacle

OUT_OF_PASSES = Declarations("kernels/kinds.h").enumeration("Status")["CONTACT"]
ROUNDS = Declarations("kernels/contact_passes.cuh").constant("ROUNDS")
STEP = """
extern "C" void detect(const ContactArguments* c) { each_triangle(*c, [&] { detect_faces(*c); }); }
extern "C" int step(const ContactArguments* c, const ContactSolve* first, const ContactSolve* pass, const System* s) {
    int loops = 0;
    detect(c);
    launch(s->bodies, CONTACT_THREADS, [&] { begin_contact(*c); });
    for (one_pass(*c, *first, *s); *c->active > 0 && loops < 200; ++loops) one_pass(*c, *pass, *s);
    launch(s->bodies, CONTACT_THREADS, [&] { finish_faces(*c); });
    launch(s->grid, CONTACT_THREADS, [&] { finish_contact(*c); });
    return loops;
}
"""
TIGHT: dict[str, Any] = {"preconditioner": "block_jacobi", "tolerance": 1e-11, "max_iterations": 3000}
EXACT: dict[str, Any] = {"thickness": D, "tolerance": 1e-8, "passes": 100}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("triangles"), TEXT + STEP, DEFINED)


def thrown(name: str, speed: float, contact: dict[str, Any] = EXACT, **table: Any) -> Simulation:
    """A block over an obstacle that is smaller than its triangles."""
    given = SMALL | {"at": (0, 0.5 * D, 0), "velocity": (0.3 * speed, -speed, 0.1 * speed), "contact": contact}
    return over(obstacle(name), **{**given, "solver": TIGHT, **table})


def rows_in_use(beside: Beside) -> int:
    faces = beside.contact.faces
    assert faces is not None
    return int((beside.contact.force[faces.start[0] : faces.start[-1]] > 0).sum())


@pytest.mark.parametrize("name", ["corner", "rod", "ball"])
def test_steps_are_those_of_the_cpu(library, monkeypatch, name):
    """A block that comes down on something between its nodes, slides on it, and carries friction."""
    beside, used = Beside(library, thrown(name, 1.0), monkeypatch), 0
    for _ in range(6):
        beside.compare(1e-6)
        used = max(used, rows_in_use(beside))
    assert used > 0 and np.linalg.norm(beside.contact.traction, axis=1).max() > 0


def test_a_fast_block_gets_rows_by_the_sweep(library, monkeypatch):
    """Over a ball and a floor, where nodes touch, too; from farther away than a step without them goes."""
    sim = over(
        obstacle("ball"), floor(), **SMALL | {"at": (0, 0.06, 0), "velocity": (0, -8, 0)}, contact=EXACT, solver=TIGHT
    )
    beside, used = Beside(library, sim, monkeypatch), 0
    for _ in range(3):
        beside.compare(1e-6)
        used = max(used, rows_in_use(beside))
    assert used > 0 and beside.rounds > 0


@pytest.mark.parametrize("name", ["corner", "rod"])
@pytest.mark.parametrize(("passes", "stiffness", "rounds"), [(1, 0.001, 0), (200, 1e-6, ROUNDS)])
def test_triangles_are_held_back_where_passes_or_rounds_run_out(library, monkeypatch, name, passes, stiffness, rounds):
    few = {"thickness": D, "passes": passes, "stiffness": stiffness}
    beside = Beside(library, thrown(name, 10.0, few, at=(0, 0.05, 0)), monkeypatch)
    records = [beside.compare(1e-5) for _ in range(3)]
    assert beside.rounds == rounds and max(r["clipped"] for r in records) > 0


def test_a_block_that_a_ball_is_thrust_through_is_held_back_alike(library, monkeypatch):
    """Nodes that the ball takes through the floor have no place in front of both. Passes run out after a sweep."""
    given = {"cells": (3, 3, 3), "size": (0.1, 0.1, 0.1), "young": 1e5, "dt": 0.01, "at": (0, 0.006, 0)}
    beside = Beside(library, over(floor(), thrust(), **given, solver=TIGHT | {"tolerance": 1e-9}), monkeypatch)
    records = [beside.compare(1e-6) for _ in range(5)]
    assert 0 < beside.rounds < ROUNDS and max(r["clipped"] for r in records) > 0
    assert OUT_OF_PASSES in [r["status"] for r in records]


def test_a_copy_of_the_matrix_knows_contacts(library, monkeypatch):
    """As on a CPU: those that carried force in the step before, also between nodes of a triangle."""
    beside = Beside(library, thrown("ball", 1.0), monkeypatch)
    values, shared = beside.arrays["values"], []
    faces = beside.passes.faces
    assert faces is not None
    for _ in range(4):
        beside.compare(1e-6)
        made = beside.matrix - values
        assert np.abs(beside.gpu.twin(values) - beside.matrix).max() <= 1e-12 * np.abs(values).max()
        assert np.array_equal(beside.passes.known(values), beside.gpu.twin(values))
        shared.append(np.abs(made[faces.link_place]).max())
    assert shared[0] == 0 and shared[-1] > 0


def test_bodies_go_their_own_ways(library, monkeypatch):
    """One on a spike, one held at a side over a ball, one beside them in the air."""
    objects = [
        block(name="one", **{**SMALL, "at": (0, 0.5 * D, 0)}),
        block(name="held", fixed="X < 0.01", **{**SMALL, "at": (0.4, 0.5 * D, 0)}),
        block(name="free", **{**SMALL, "at": (2, 1, 0)}),
    ]
    ball = obstacle("ball")
    second = ball | {"name": "second", "pose": {"translate": [0.462, -0.006, 0.029]}}
    sim = over(
        obstacle("corner"), second, objects=objects, contact=EXACT | {"between": False}, solver=TIGHT,
        gravity=(0, -30, 0),
    )  # fmt: skip
    beside = Beside(library, sim, monkeypatch)
    for _ in range(4):
        beside.compare(1e-6)
    assert rows_in_use(beside) >= 2


def test_blocks_between_nodes_of_triangles_are_found():
    triangle = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    row_start, columns = (
        np.array([0, 3, 7, 11, 14], np.int32),
        np.array([0, 1, 2, 0, 1, 2, 3, 0, 1, 2, 3, 1, 2, 3], np.int32),
    )
    entry, first = corners_of_nodes(triangle, 4)
    assert entry.tolist() == [0, 1, 5, 2, 4, 6] and first.tolist() == [0, 1, 3, 5, 6]
    place, link_first, of_entry = links_of_corners(triangle, entry, row_start, columns)
    rows = np.repeat(np.arange(4), np.diff(row_start))
    assert link_first.tolist() == [0, 2, 5, 8, 10]
    for k, (number, corner) in enumerate(zip(*np.divmod(entry, 4), strict=True)):
        for m in (0, 1):
            at = place[of_entry[k, m]]
            assert (rows[at], columns[at]) == (triangle[number, corner], triangle[number, (corner + 1 + m) % 3])
