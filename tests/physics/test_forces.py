# SPDX-License-Identifier: MIT
"""Elastic energy, forces and the right-hand side, against finite differences and the plain reference."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from tests.reference.corotational import Solid, deformation
from tests.scenes import bar, jittered_bar, mesh_file, random_rotations, simulation, solid

SIZE = (1.5, 1.0, 0.8)
REGIONS = [{"where": "X < 0.6", "young": 4e5, "poisson": 0.45}, {"young": 3e4}]


def solid_bar(folder: Path, **table) -> Simulation:
    """A bar of unequal elements and two materials."""
    solver = {k: table.pop(k) for k in ("gravity", "dt", "warp") if k in table}
    mesh = mesh_file(folder, *jittered_bar((3, 2, 2), SIZE, seed=2))
    return simulation(bar(mesh=mesh, young=REGIONS, poisson=0.2, **table), **solver)


def stir(sim: Simulation, size: float, seed: int = 3) -> None:
    """Moves the nodes by up to about `size` m and gives them velocities."""
    random = np.random.default_rng(seed)
    sim.world.x += size * random.normal(size=sim.world.x.shape)
    sim.world.v[:] = random.normal(size=sim.world.v.shape)


def gaps(body: Solid) -> NDArray:
    """(s2 + s3) / s1 of every element with the sign of det F on s3: how far its rotation is from not being unique."""
    out = []
    for tet in body.tets:
        F = deformation(body.x[tet], body.rest[tet])
        s = np.linalg.svd(F, compute_uv=False)
        out.append((s[1] + np.sign(np.linalg.det(F)) * s[2]) / s[0])
    return np.array(out)


def elastic_forces(sim: Simulation) -> NDArray:
    """Forces by the kernels: b / h of an undamped body at rest in its present shape."""
    sim.world.v[:] = 0
    sim.engine.assemble()
    return sim.system.b / sim.world.dt


STIRRED = {"small": 0.02, "large": 0.1, "with inverted elements": 0.25}
stirred = pytest.mark.parametrize("size", STIRRED.values(), ids=STIRRED.keys())


@stirred
def test_energy_is_that_of_the_reference(tmp_path, size):
    sim = solid_bar(tmp_path)
    stir(sim, size)
    assert sim.potential_energy() == pytest.approx(solid(sim).energy(), rel=1e-12)


@stirred
def test_forces_are_minus_the_slope_of_the_energy(tmp_path, size):
    """Central differences, node by node; step 1e-6 m, so rounding and truncation leave about 1e-8 of the largest."""
    sim = solid_bar(tmp_path)
    stir(sim, size, seed=5)
    body, x = solid(sim), sim.world.x
    assert gaps(body).min() > 1e-3  # every rotation is unique, so the energy is smooth
    inverted = sum(np.linalg.det(deformation(body.x[t], body.rest[t])) < 0 for t in body.tets)
    assert (inverted > 5) == (size > 0.2)
    slope, step = np.zeros_like(x), 1e-6
    for index in np.ndindex(*x.shape):
        at, energy = x[index], []
        for x[index] in (at + step, at - step):
            energy.append(sim.potential_energy())
        x[index] = at
        slope[index] = (energy[0] - energy[1]) / (2 * step)
    forces = elastic_forces(sim)
    assert np.abs(forces + slope).max() < 2e-7 * np.abs(forces).max()


@stirred
def test_forces_are_those_of_the_reference(tmp_path, size):
    sim = solid_bar(tmp_path)
    stir(sim, size)
    expected = solid(sim).forces()
    assert np.abs(elastic_forces(sim) - expected).max() < 1e-12 * np.abs(expected).max()


@stirred
@pytest.mark.parametrize("fixed", [None, "X < 0.01"])
def test_the_right_hand_side_with_everything_in_it(tmp_path, size, fixed):
    """b = h f + h (h + beta) K v - h alpha M v + h M g; in the material frame it is R^T b, and 0 at fixed nodes."""
    sim = solid_bar(tmp_path, damping=(0.7, 0.03), gravity=(1, -9.81, 2), dt=0.013, fixed=fixed)
    stir(sim, size)
    sim.engine.assemble()
    expected = solid(sim).right_side()
    bound = 1e-12 * np.abs(expected).max()
    assert np.abs(sim.system.b * sim.world.free[:, None] - expected).max() < bound
    turned = np.einsum("nji,nj->ni", sim.system.rotation, expected)
    assert np.abs(sim.system.b_material - turned).max() < bound
    assert (sim.system.b_material[sim.world.free == 0] == 0).all()


@pytest.mark.parametrize("damping", [(0.0, 0.05), (0.4, 0.0)])
def test_each_damping_alone(tmp_path, damping):
    sim = solid_bar(tmp_path, damping=damping)
    stir(sim, 0.05)
    sim.engine.assemble()
    expected = solid(sim).right_side()
    assert np.abs(sim.system.b - expected).max() < 1e-12 * np.abs(expected).max()


def test_no_force_in_a_body_moved_and_turned(tmp_path):
    """Any rigid motion of the rest shape: forces and energy are rounding of E L^2 and E L^3."""
    sim = solid_bar(tmp_path)
    for R in random_rotations(20, seed=7):
        sim.world.x[:] = sim.world.rest @ R.T + [3.0, -2.0, 7.0]
        assert np.abs(elastic_forces(sim)).max() < 1e-13 * 4e5
        assert sim.potential_energy() < 1e-20 * 4e5


def test_forces_turn_with_the_body(tmp_path):
    sim = solid_bar(tmp_path)
    stir(sim, 0.08)
    x, forces = sim.world.x.copy(), elastic_forces(sim).copy()
    for R in random_rotations(5, seed=8):
        sim.world.x[:] = x @ R.T
        assert np.abs(elastic_forces(sim) - forces @ R.T).max() < 1e-11 * np.abs(forces).max()


def test_forces_and_torques_balance(tmp_path):
    """sum f = 0 and sum x cross f = 0 in any shape: internal forces move no body."""
    sim = solid_bar(tmp_path)
    stir(sim, 0.1)
    forces = elastic_forces(sim)
    size = np.abs(forces).max()
    assert np.abs(forces.sum(axis=0)).max() < 1e-13 * size * len(forces)
    assert np.abs(np.cross(sim.world.x, forces).sum(axis=0)).max() < 1e-13 * size * len(forces)


def test_gravity_and_its_energy(tmp_path):
    g = (0.5, -9.81, 1.0)
    sim = simulation(bar(young=None, density=800), gravity=g, dt=0.05)
    sim.engine.assemble()
    np.testing.assert_allclose(sim.system.b, 0.05 * sim.world.mass[:, None] * np.array(g), rtol=1e-15)
    before = sim.potential_energy()
    sim.world.x += [0.0, 2.0, 0.0]
    assert sim.potential_energy() - before == pytest.approx(sim.world.mass.sum() * 9.81 * 2, rel=1e-12)
