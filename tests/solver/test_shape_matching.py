# SPDX-License-Identifier: MIT
"""Rotations of nodes where elements have none: shape matching over neighbours (shape_matching.py).

The exact properties of the warp hold for it as for the mean of element rotations. Iterations found in the falling beam
of test_warp_in_motion.py, lockstep-10: element rotations 3.4, neighbours of level 1 3.6, of level 2 3.8, no warp 10.2.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.kinds import Kind
from sim_server.mechanics.shape_matching import neighbours
from sim_server.mesh import pose_matrix
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, factor_of, rotation, scene, simulation
from tests.solver.solves import solve

ONCE = {"tolerance": 1e-6, "warm_start": False, "max_iterations": 2000, "factor_precision": "float64"}
LEVELS = [1, 2]


@pytest.fixture
def matched(monkeypatch) -> None:
    """Every body as if its elements had no rotations."""
    monkeypatch.setattr(Simulation, "rotated_bodies", lambda sim: [])


def launches(sim: Simulation) -> list[str]:
    return [launch.name for launch in sim.engine.launches]


def expected(sim: Simulation, level: int) -> NDArray:
    """(n, 3, 3) by the book: neighbours by a search over elements, nearest rotations by SVD."""
    rest, x, mass = sim.world.rest, sim.world.x, sim.world.mass
    beside = [{i}.union(*(set(t) for t in sim.world.bodies[0].tets.tolist() if i in t)) for i in range(len(rest))]
    out = []
    for i in range(len(rest)):
        group = beside[i]
        for _ in range(level - 1):
            group = set().union(*(beside[j] for j in group))
        k = sorted(group)
        m = mass[k][:, None]
        X, now = rest[k] - (m * rest[k]).sum(0) / m.sum(), x[k] - (m * x[k]).sum(0) / m.sum()
        u, _, vt = np.linalg.svd((m * now).T @ X)
        out.append(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
    return np.array(out)


@pytest.mark.parametrize("level", LEVELS)
def test_rotations_are_those_of_the_formula(level, matched):
    sim = simulation(bar((3, 2, 2), (2, 1, 1)), warp_level=level)
    random = np.random.default_rng(1)
    sim.world.x[:] = sim.world.x @ rotation((1, 2, 3), 2.0).T + random.normal(scale=0.15, size=sim.world.x.shape)
    sim.engine.assemble()
    assert np.abs(sim.system.rotation - expected(sim, level)).max() < 1e-9


def test_neighbours_share_an_element_or_one_with_a_neighbour():
    chain = np.array([[0, 1, 2, 3], [3, 4, 5, 6], [6, 7, 8, 9]], np.int32)
    start, found = neighbours(chain, 11, 1)
    assert found[start[3] : start[4]].tolist() == [0, 1, 2, 4, 5, 6]
    assert start[10] == start[11], "a node of no element has none"
    start, found = neighbours(chain, 11, 2)
    assert found[start[3] : start[4]].tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert found[start[0] : start[1]].tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("angle", [1, 90, 135, 180, 270])
def test_a_turned_body_needs_one_iteration_with_the_factor_of_the_unturned_one(angle, level, matched):
    sim = simulation(bar((5, 2, 2), (2.5, 1, 1), young=1e7), preconditioner="cholesky", warp_level=level, **ONCE)
    sim.world.v[:] = np.random.default_rng(0).normal(size=sim.world.v.shape)
    sim.engine.assemble()
    sim.engine.post_factor(0, *factor_of(sim), step=0)
    assert solve(sim)[1]["iterations"] == 1
    R = rotation((1, -2, 0.5), np.radians(angle))
    sim.world.x[:], sim.world.v[:] = sim.world.x @ R.T + [1.0, 2.0, 3.0], sim.world.v @ R.T
    sim.engine.assemble()
    _, record = solve(sim)
    assert (record["status"], record["kind"], record["iterations"]) == (0, Kind.CHOLESKY, 1)
    assert np.abs(sim.system.rotation - R).max() < 1e-12


def falling(pose: tuple[float, float, float] | None, level: int, **solver: Any) -> NDArray:
    """Iterations of each step."""
    frame: dict[str, Any] = {"pose": {"rotate": list(pose)}} if pose else {}
    g = (pose_matrix(pose) if pose else np.eye(3)) @ [0, -9.81, 0]
    beam = bar((10, 2, 2), (8, 1.6, 1.6), young=5e5, poisson=0.4, fixed="X < 0.01", damping=(0.1, 0.01), **frame)
    table = {"preconditioner": "cholesky", "update": "lockstep-10", "warp_level": level, **solver}
    return Driver(simulation(beam, gravity=tuple(g), **table)).advance(60)["iterations"]


@pytest.mark.parametrize("level", LEVELS)
def test_a_posed_beam_takes_as_many_iterations_and_the_warp_pays(level, matched):
    plain, posed = falling(None, level), falling((40.0, 0.0, 70.0), level)
    assert np.abs(posed[10:] - plain[10:]).max() <= 1
    assert posed[10:].mean() == pytest.approx(plain[10:].mean(), rel=0.05)
    assert plain[10:].mean() < 0.6 * falling(None, level, warp=False)[10:].mean()


def test_it_costs_nothing_where_elements_have_rotations(monkeypatch):
    assert "shape_matching.match" not in launches(simulation(bar()))
    monkeypatch.setattr(Simulation, "rotated_bodies", lambda sim: sim.world.bodies[:1])
    table = [bar(), bar(name="other", pose={"rotate": [0, 0, 90], "translate": [0, 5, 0]})]
    assert "shape_matching.match" not in launches(simulation(*table, warp=False))
    mixed, alone = simulation(*table), simulation(table[0])
    assert launches(mixed)[-5:-2] == ["shape_matching.match", "nodes.rotate", "rotate_blocks.rotate_blocks"]
    for sim in (mixed, alone):
        sim.world.x[:45] += np.random.default_rng(0).normal(scale=0.05, size=(45, 3))
        sim.engine.assemble()
    assert np.array_equal(mixed.system.rotation[:45], alone.system.rotation), "others keep the mean of their elements"
    assert np.abs(mixed.system.rotation[45:] - rotation((0, 0, 1), np.pi / 2)).max() < 1e-12


def test_bodies_that_nothing_couples_need_no_rotations():
    sim = simulation(bar(young=None))
    assert "shape_matching.match" not in launches(sim)
    sim.engine.run(2)
    assert np.array_equal(sim.system.rotation, np.tile(np.eye(3), (45, 1, 1)))


@pytest.mark.parametrize("level", [0, 3, 1.5])
def test_other_levels_are_refused(level):
    with pytest.raises(ValueError, match=r"solver.warp_level"):
        scene(bar(), warp_level=level)
