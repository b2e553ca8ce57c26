# SPDX-License-Identifier: MIT
"""Pattern of A against dense incidence, and several bodies in the same arrays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_server.mechanics.system import Stencil, System
from tests.scenes import bar, jittered_bar, mesh_file, simulation

GRAVITY = (0.0, -9.81, 0.0)
STEPS = 12


def dense_pattern(system: System) -> np.ndarray:
    """Node couplings that the block CSR has room for, (n, n)."""
    n = system.world.nodes
    out = np.zeros((n, n), int)
    rows = np.repeat(np.arange(n), np.diff(system.row_start))
    np.add.at(out, (rows, system.columns), 1)
    return out


def incidence(tets: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Two free nodes couple where they share an element; every node has its diagonal, (n, n)."""
    out = np.eye(len(free), dtype=int)
    for tet in tets:
        corners = [i for i in tet if free[i]]
        out[np.ix_(corners, corners)] = 1
    return out


@pytest.mark.parametrize("fixed", [None, "X < 0.01", "X < 0.6 and Y > 0.4", "Z > 0.9"])
def test_pattern_is_the_incidence_of_the_mesh(fixed):
    sim = simulation(bar((3, 2, 2), fixed=fixed))
    expected = incidence(sim.world.bodies[0].tets, sim.world.free)
    assert np.array_equal(dense_pattern(sim.system), expected)
    starts = sim.system.row_start
    for i in range(sim.world.nodes):
        assert (np.diff(sim.system.columns[starts[i] : starts[i + 1]]) > 0).all()


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_pattern_of_any_elements(data):
    """Elements of two and of four corners in no particular order, with nodes that none has and nodes that are held."""
    n = data.draw(st.integers(4, 12))
    several = [_elements(data, n, corners) for corners in data.draw(st.sampled_from([(4,), (2,), (4, 2), (2, 4)]))]
    world = simulation(bar((1, 1, 1), young=None)).world
    world.rest = world.x = world.v = np.zeros((n, 3))
    world.mass, world.free = (
        np.ones(n),
        np.array(data.draw(st.lists(st.sampled_from([0.0, 1.0]), min_size=n, max_size=n))),
    )
    system = System(world, several)
    patterns = [incidence(elements, world.free) for elements in several]
    assert np.array_equal(dense_pattern(system), np.maximum.reduce(patterns))
    for elements, stencil in zip(several, system.stencils, strict=True):
        _check_stencil(system, elements, stencil)


def _elements(data, n: int, corners: int) -> NDArray[np.int32]:
    nodes = st.permutations(range(n)).map(lambda p: p[:corners])
    return np.array(data.draw(st.lists(nodes, min_size=1, max_size=8)), np.int32)


def _check_stencil(system: System, elements: NDArray[np.int32], stencil: Stencil) -> None:
    corners, free = elements.shape[1], system.world.free
    for node in range(system.world.nodes):
        slots = stencil.corners[stencil.corner_start[node] : stencil.corner_start[node + 1]]
        assert sorted(slots) == np.flatnonzero(elements.ravel() == node).tolist()
    for block, (i, j) in enumerate(zip(system.row, system.column, strict=True)):
        pairs = stencil.pairs[stencil.pair_start[block] : stencil.pair_start[block + 1]]
        e, a, b = pairs // corners**2, pairs // corners % corners, pairs % corners
        assert (elements[e, a] == i).all()
        assert (elements[e, b] == j).all()
        sharing = sum(i in element and j in element for element in elements.tolist())
        assert len(pairs) == (sharing if free[i] and free[j] else 0)


def three_bodies(folder, **solver):
    """Unlike in mesh, material, damping and pose; the second has no elements that couple."""
    rest, tets = jittered_bar((3, 2, 2), (1.5, 1, 0.8), seed=3)
    bodies = [
        bar((4, 2, 2), name="a", fixed="X < 0.01", damping=(0.1, 0.01)),
        bar((1, 1, 1), name="b", young=None, pose={"translate": [5, 0, 0]}),
        bar(mesh=mesh_file(folder, rest, tets), name="c", young=3e4, fixed="X > 1.4", pose={"rotate": [40, 0, 70]}),
    ]
    return bodies, simulation(*bodies, gravity=GRAVITY, **solver)


def test_body_ranges(tmp_path):
    """body_pattern and body_values are the blocks of one body, numbered from 0; other bodies have none in its rows."""
    bodies, sim = three_bodies(tmp_path)
    sim.engine.assemble()
    whole = dense_pattern(sim.system)
    for body, table in zip(sim.world.bodies, bodies, strict=True):
        alone = simulation(table, gravity=GRAVITY)
        alone.engine.assemble()
        row_start, columns = sim.system.body_pattern(body.first, body.last)
        assert np.array_equal(row_start, alone.system.row_start)
        assert np.array_equal(columns, alone.system.columns)
        assert np.array_equal(sim.system.body_values(body.first, body.last), alone.system.values)
        assert not whole[body.nodes, : body.first].any()
        assert not whole[body.nodes, body.last :].any()
        assert sim.matrix(body.index).shape == (3 * (body.last - body.first),) * 2
    assert sim.system.body_values(*[(b.first, b.last) for b in sim.world.bodies][2]).base is not None  # a view


@pytest.mark.parametrize("preconditioner", ["none", "jacobi", "block_jacobi"])
def test_bodies_beside_one_another_move_as_if_alone(tmp_path, preconditioner):
    """Bit for bit: same kernels, same order of sums, own convergence."""
    solver = {"preconditioner": preconditioner, "tolerance": 1e-8, "max_iterations": 2000}
    bodies, sim = three_bodies(tmp_path, **solver)
    sim.engine.run(STEPS)
    records = sim.engine.records()
    for body, table in zip(sim.world.bodies, bodies, strict=True):
        alone = simulation(table, gravity=GRAVITY, **solver)
        alone.engine.run(STEPS)
        assert np.array_equal(sim.world.x[body.nodes], alone.world.x)
        assert np.array_equal(sim.world.v[body.nodes], alone.world.v)
        own, theirs = records[records["body"] == body.index], alone.engine.records()
        assert np.array_equal(own["iterations"], theirs["iterations"])
        assert np.array_equal(own["residual"], theirs["residual"])
        assert np.array_equal(own["step"], np.arange(1, STEPS + 1))


def test_threads_change_nothing(tmp_path):
    """Launches are cut at 512 items, bodies are solved beside one another: still the same to the last bit."""
    big = bar((12, 8, 8), (3, 1, 1), fixed="X < 0.01")
    runs = []
    for threads in (1, 3):
        solver = {"threads": threads, "preconditioner": "block_jacobi", "max_iterations": 2000}
        sim = simulation(big, bar(name="small", young=3e4), gravity=GRAVITY, **solver)
        sim.engine.run(3)
        runs.append((sim.world.x.copy(), sim.engine.records()["iterations"]))
    assert np.array_equal(runs[0][0], runs[1][0])
    assert np.array_equal(runs[0][1], runs[1][1])
