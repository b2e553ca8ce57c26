# SPDX-License-Identifier: MIT
"""Edges of two bodies that meet between their nodes (kernels/edge_edge.cuh, edge_detection.cuh)."""

import numpy as np
import pytest

from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from tests.contact.scenes import D, block, floor, over
from tests.state import put

STATUS = KINDS.enumeration("Status")
JACOBI = {"preconditioner": "block_jacobi"}
FAR = floor(pose={"translate": [0, -100, 0]})
CELLS, SIZE = (5, 1, 1), (0.2, 0.05, 0.05)  # of a bar: its middle is between nodes
UP = 0.05 * 2**0.5  # height of a bar that stands on an edge


def crossed(speed: float, dt: float = 1 / 60, apart: float = 0.02, cells: tuple = CELLS, **table) -> Simulation:
    """A bar along x with an edge below over one along z with an edge above, which cross between their nodes."""
    young = 3e5 * max(1, speed) ** 2  # so that they do not bend round each other
    upper = block(name="upper", cells=cells, size=SIZE, young=young, rotate=(45, 0, 0), at=(-0.075, apart, 0.02))
    lower = block(name="lower", cells=CELLS, size=SIZE, young=young, rotate=(0, 90, 45), at=(0, -UP, 0.12))
    sim = over(FAR, objects=[upper, lower], gravity=(0, 0, 0), dt=dt, **({"solver": JACOBI} | table))
    world = sim.world
    top, bottom = (world.bodies[k].nodes for k in (0, 1))
    x, v = world.x.copy(), np.zeros(world.v.shape)
    x[bottom] -= [x[bottom, 0].mean(), x[bottom, 1].max(), x[bottom, 2].mean()]
    x[top] -= [x[top, 0].mean() + 0.002, x[top, 1].min() - apart, x[top, 2].mean() - 0.001]
    v[top], v[bottom] = (0, -speed, 0), (0, 0.2 * speed, 0)
    put(sim, world.x, x)
    put(sim, world.v, v)
    return sim


def along(sim: Simulation, body: int) -> np.ndarray:
    """Points on the body's edge that meets the other one, a little inside."""
    nodes = sim.world.bodies[body].nodes
    x, edge = sim.world.x[nodes], sim.marked[body]
    line = x[edge[np.argsort(sim.world.rest[nodes][edge] @ sim.axis[body])]]
    middle = x.mean(axis=0)
    points = np.concatenate([line[:-1] + s * (line[1:] - line[:-1]) for s in np.linspace(0, 1, 21)])
    return np.asarray(points + 1e-6 * (middle - points))


def mark(sim: Simulation) -> None:
    """Notes which nodes are on the edges that meet."""
    marked, axis = [], []
    for body, sign in zip(sim.world.bodies, (1, -1), strict=True):
        y = sign * sim.world.x[body.nodes, 1]
        marked.append(np.flatnonzero(y < y.min() + 1e-6))
        rest = sim.world.rest[body.nodes][marked[-1]]
        axis.append(rest[np.argmax(np.linalg.norm(rest - rest[0], axis=1))] - rest[0])
    sim.marked, sim.axis = marked, axis


def contains(sim: Simulation, body: int, points: np.ndarray) -> int:
    corners = sim.world.x[sim.world.bodies[body].tets]
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    weights = np.einsum("tij,ntj->nti", inverse, points[:, None] - corners[None, :, 0])
    return int(((weights > 0).all(axis=2) & (weights.sum(axis=2) < 1)).any(axis=1).sum())


def momentum(sim: Simulation) -> np.ndarray:
    return np.asarray(sim.world.mass @ sim.world.v)


def edge_rows(sim: Simulation) -> np.ndarray:
    given = sim.contact.contact_input()
    first = given.surfaces.edge_start[0]
    return first + np.flatnonzero(given.obstacle[first:] >= 0)


@pytest.mark.parametrize("dt", [0.005, 1 / 60, 0.03])
@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("cells", [CELLS, (9, 2, 2)])
def test_edges_do_not_pass_through_each_other(speed, dt, cells):
    sim = crossed(speed, dt, cells=cells)
    mark(sim)
    touched = False
    for _ in range(int(0.03 / speed / dt) + 4):
        sim.engine.run(1)
        records = sim.engine.records()
        touched = touched or records["contacts"].any()
        if (records["status"] == STATUS["RUNAWAY"]).any():  # its step is undone, and the other one may go on without it
            assert speed > 10
            break
        if speed <= 10:  # faster ones turn far in a step, and may then be dented for one
            assert not contains(sim, 0, along(sim, 1)) and not contains(sim, 1, along(sim, 0))
        upper, lower = (sim.world.x[b.nodes, 1].mean() for b in sim.world.bodies)
        assert upper > lower
    assert touched


def test_a_row_is_kept_while_edges_that_bear_each_other_turn_a_little():
    """A bar over an edge, of which one side all but lies on the other one's edge."""
    sim = crossed(0.0, apart=0.5 * D)
    sim.engine.assemble()
    given, row = sim.contact.contact_input(), edge_rows(sim)[0]
    top = sim.world.bodies[0].nodes
    x, pivot = sim.world.x[top].copy(), given.weight[row, :2] @ sim.world.x[given.corner[row, :2]]

    def rows_at(degrees: float) -> list[int]:
        """Once the upper bar is turned about its edge, from where one side lies flat."""
        c, s = np.cos(np.radians(45 - degrees)), np.sin(np.radians(45 - degrees))
        sim.world.x[top] = pivot + (x - pivot) @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
        sim.engine.assemble()
        return edge_rows(sim).tolist()

    assert row in rows_at(4) and row not in rows_at(2)
    for force, kept in ((0.0, False), (2.0, True)):
        assert row in rows_at(4)
        given.force[row] = force
        assert (row in rows_at(2)) == kept and (row in rows_at(-2)) == kept
        assert row not in rows_at(-4)


def test_momentum_is_kept_and_energy_does_not_grow():
    contact = {"thickness": D, "tolerance": 1e-6, "passes": 200}
    sim = crossed(1.0, contact=contact, solver=JACOBI | {"tolerance": 1e-12, "max_iterations": 3000})
    before, size = momentum(sim), sim.world.mass.sum() * 1.0
    start, used = sim.kinetic_energy(), 0
    for _ in range(20):
        sim.engine.run(1)
        used = max(used, len(edge_rows(sim)))
    assert used > 0 and sim.engine.records()["contacts"].any()
    assert abs(momentum(sim) - before).max() <= 1e-9 * size
    assert sim.kinetic_energy() <= start


def test_a_row_is_the_derivative_of_the_distance_of_the_edges():
    sim = crossed(1.0, apart=0.5 * D)
    sim.engine.assemble()
    given, x = sim.contact.contact_input(), sim.world.x
    rows = edge_rows(sim)
    assert len(rows) == 1
    corner, weight, normal = given.corner[rows[0]], given.weight[rows[0]], given.normal[rows[0]]
    assert weight[:2].sum() == pytest.approx(1) and weight[2:].sum() == pytest.approx(-1)

    def distance(at: np.ndarray) -> float:
        n = np.cross(at[1] - at[0], at[3] - at[2])
        return abs(float((at[0] - at[2]) @ n) / np.linalg.norm(n))

    at, h = x[corner].copy(), 1e-6
    assert given.gap[rows[0]] == pytest.approx(distance(at), abs=1e-12)
    for a in range(4):
        for k in range(3):
            step = np.zeros((4, 3))
            step[a, k] = h
            slope = (distance(at + step) - distance(at - step)) / (2 * h)
            assert slope == pytest.approx(weight[a] * normal[k], abs=1e-9)
    sites = given.surfaces.node_site[corner]
    ours, theirs = (abs(weight[s]) @ given.stiffness[2 * sites[s]] for s in (slice(0, 2), slice(2, 4)))
    assert given.stiffness[rows[0]] == pytest.approx(2 * ours * theirs / (ours + theirs))


def test_parallel_edges_and_flat_ones_have_no_rows():
    """Blocks one over the other, with edges over edges and diagonals across."""
    one, other = block(name="one", at=(0, 0, 0)), block(name="other", at=(0.003, 0.06 + 0.5 * D, 0.002))
    sim = over(FAR, objects=[one, other], gravity=(0, 0, 0), solver=JACOBI)
    sim.engine.assemble()
    assert len(edge_rows(sim)) == 0 and (sim.contact.contact_input().obstacle >= 0).any()


def test_a_row_keeps_its_forces_while_its_edges_are_the_same():
    sim = crossed(0.0, apart=0.5 * D)
    sim.world.v[:] = 0
    sim.engine.assemble()
    given, row = sim.contact.contact_input(), edge_rows(sim)[0]
    given.force[row], given.traction[row] = 2.0, [0.5, 0, 0.25]
    sim.world.x[sim.world.bodies[0].nodes] += [0.002, 0, 0.001]
    sim.engine.assemble()
    assert edge_rows(sim).tolist() == [row] and given.force[row] == 2.0
    np.testing.assert_allclose(given.traction[row], [0.5, 0, 0.25], atol=1e-12)
    sim.world.x[sim.world.bodies[0].nodes] += [0, 0.1, 0]
    sim.engine.assemble()
    assert not len(edge_rows(sim)) and not given.force.any()
