# SPDX-License-Identifier: MIT
"""Corotational tetrahedra that turn with an edge and a face in place of the nearest rotation."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.physics.test_forces import REGIONS, SIZE, elastic_forces, stir, stirred
from tests.physics.test_system_matrix import frame
from tests.reference.corotational import turned_frame
from tests.scenes import bar, elastic, jittered_bar, mesh_file, random_rotations, simulation, solid


def qr_bar(folder: Path, **table) -> Simulation:
    """A bar of unequal elements and two materials."""
    solver = {k: table.pop(k) for k in ("dt", "warp", "tolerance", "gravity") if k in table}
    mesh = mesh_file(folder, *jittered_bar((3, 2, 2), SIZE, seed=2))
    return simulation(bar(mesh=mesh, young=REGIONS, poisson=0.2, rotation="qr", **table), **solver)


@stirred
@pytest.mark.parametrize("fixed", [None, "X < 0.01"])
def test_everything_is_the_reference(tmp_path, size, fixed):
    """Rotations, energy, matrix and right-hand side, also where elements are inverted."""
    sim = qr_bar(tmp_path, damping=(0.7, 0.03), dt=0.013, fixed=fixed, gravity=(1, -9.81, 2))
    stir(sim, size)
    sim.engine.assemble()
    reference, e = solid(sim), elastic(sim)
    expected = np.array([turned_frame(sim.world.x[t], sim.world.rest[t]) for t in e.elements])
    assert np.abs(e.rotation - expected).max() < 1e-11
    gravity = sim.effects["gravity"].energy()
    assert sim.potential_energy() - gravity == pytest.approx(reference.energy(), rel=1e-11)
    A, R, b = reference.matrix(), frame(sim), reference.right_side()
    found = sim.matrix().toarray()
    assert np.abs(found - R.T @ A @ R).max() < 1e-11 * np.abs(A).max()
    assert np.linalg.eigvalsh(found)[0] > 0
    assert np.abs(sim.system.b * sim.world.free[:, None] - b).max() < 1e-11 * np.abs(b).max()


def test_rigid_motion_is_exact(tmp_path):
    sim = qr_bar(tmp_path)
    for R in random_rotations(20, seed=7):
        sim.world.x[:] = sim.world.rest @ R.T + [3.0, -2.0, 7.0]
        assert np.abs(elastic_forces(sim)).max() < 1e-13 * 4e5
        assert sim.potential_energy() < 1e-20 * 4e5
        assert np.abs(elastic(sim).rotation - R).max() < 1e-13


def test_forces_balance(tmp_path):
    """No force in all, as the stiffness has none for a translation; a torque is left, as the frame is no best fit."""
    sim = qr_bar(tmp_path)
    stir(sim, 0.1)
    forces = elastic_forces(sim)
    assert np.abs(forces.sum(axis=0)).max() < 1e-13 * np.abs(forces).max() * len(forces)


def test_small_strains_are_those_of_the_nearest_rotation(tmp_path):
    """The forces differ by the second order of the strains."""
    ratios = []
    for size in (1e-3, 1e-4):
        forces = []
        for rotation in ("qr", "polar"):
            mesh = mesh_file(tmp_path, *jittered_bar((3, 2, 2), SIZE, seed=2))
            sim = simulation(bar(mesh=mesh, young=REGIONS, poisson=0.2, rotation=rotation))
            stir(sim, size)
            forces.append(elastic_forces(sim).copy())
        ratios.append(np.abs(forces[0] - forces[1]).max() / np.abs(forces[1]).max())
    assert ratios[0] < 0.02 and ratios[1] == pytest.approx(ratios[0] / 10, rel=0.2)


FLAT = {
    "a point": lambda x: 0 * x,
    "a line": lambda x: x * [1.0, 0.0, 0.0],
    "another line": lambda x: x.sum(axis=1, keepdims=True) * [0.3, -0.2, 0.9],
    "a plane": lambda x: x * [1.0, 1.0, 0.0],
    "inside out": lambda x: x * [-1.0, 1.0, 1.0],
    "an edge lost in each": lambda x: x * [0.0, 1.0, 1.0],
}


@pytest.mark.parametrize("shape", FLAT.values(), ids=FLAT.keys())
def test_it_is_a_rotation_through_inversion(tmp_path, shape):
    """Also where the edge or the face is lost: then any rotation, but one."""
    sim = qr_bar(tmp_path)
    sim.world.x[:] = shape(sim.world.rest)
    forces = elastic_forces(sim)
    R = elastic(sim).rotation
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-12
    np.testing.assert_allclose(np.linalg.det(R), 1, rtol=1e-12)
    assert np.abs(forces).max() > 1e3  # something drives it back
    assert np.linalg.eigvalsh(sim.matrix().toarray())[0] > 0


@pytest.mark.parametrize("rotation", ["qr", "polar"])
def test_it_recovers_from_inside_out(rotation):
    sim = simulation(
        bar((3, 2, 2), (1.5, 1, 1), young=1e5, poisson=0.3, rotation=rotation, damping=(1.0, 0.01)), dt=0.03
    )
    random = np.random.default_rng(2)
    sim.world.x[:] = sim.world.rest * [-1, 1, 1] + 1e-3 * random.normal(size=sim.world.x.shape)
    sim.engine.run(600)
    elements, w = elastic(sim).elements, sim.world
    edges = w.x[elements[:, 1:]] - w.x[elements[:, :1]]
    assert np.linalg.det(edges).min() > 0
    assert sim.potential_energy() < 1e-3 * 1e5


def test_bodies_may_differ_in_it():
    """Each as if alone, bit for bit."""
    tables = [bar(name="a"), bar(name="b", rotation="qr"), bar(name="c", rotation="qr", young=3e4), bar(name="d")]
    together = simulation(*tables, gravity=(0, -9.81, 0), preconditioner="block_jacobi")
    assert [name for name in together.effects if name.startswith("corotational")] == ["corotational", "corotational_qr"]
    stir(together, 0.03)
    start = together.world.x.copy(), together.world.v.copy()
    together.engine.run(5)
    for body, table in zip(together.world.bodies, tables, strict=True):
        alone = simulation(table, gravity=(0, -9.81, 0), preconditioner="block_jacobi")
        alone.world.x[:], alone.world.v[:] = start[0][body.nodes], start[1][body.nodes]
        alone.engine.run(5)
        assert np.array_equal(together.world.x[body.nodes], alone.world.x)
