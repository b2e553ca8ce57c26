# SPDX-License-Identifier: MIT
"""The patch test: an affine displacement of the boundary is the exact solution inside, whatever the mesh."""

import numpy as np
import pytest

from tests.physics.test_forces import elastic_forces
from tests.scenes import bar, elastic, interior, jittered_bar, mesh_file, random_rotations, simulation

SIZE, YOUNG, POISSON = (1.2, 1.0, 0.8), 2e5, 0.3
AFFINE = {
    "stretch and shear": np.array([[1.1, 0.05, 0.0], [0.0, 0.95, 0.08], [0.02, 0.0, 1.04]]),
    "half turned over": random_rotations(1, seed=4)[0] @ np.diag([0.6, 1.2, 1.1]),
    "inverted": random_rotations(1, seed=5)[0] @ np.diag([1.0, 0.9, -0.5]),
}
affine = pytest.mark.parametrize("F", AFFINE.values(), ids=AFFINE.keys())


@pytest.fixture
def sim(tmp_path):
    rest, tets = jittered_bar((4, 4, 4), SIZE, seed=1)
    return simulation(bar(mesh=mesh_file(tmp_path, rest, tets), young=YOUNG, poisson=POISSON))


@affine
def test_no_force_inside(sim, F):
    sim.world.x[:] = sim.world.rest @ F.T + [1.0, 2.0, 3.0]
    forces = elastic_forces(sim)
    inside = interior(sim.world.rest, SIZE)
    assert inside.sum() == 27
    assert np.abs(forces[inside]).max() < 1e-12 * YOUNG
    assert np.abs(forces[~inside]).max() > 1e-3 * YOUNG


@affine
def test_stress_is_uniform(sim, F):
    """Every element turns by the same rotation R and has the stress P = R (2 mu (S - I) + lambda tr(S - I) I)."""
    sim.world.x[:] = sim.world.rest @ F.T
    sim.world.v[:] = 0
    sim.engine.assemble()
    elements = elastic(sim)
    R = elements.rotation[0]
    assert np.abs(elements.rotation - R).max() < 1e-12
    lam = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    strain = R.T @ F - np.eye(3)
    stress = R @ (YOUNG / (1 + POISSON) * (strain + strain.T) / 2 + lam * np.trace(strain) * np.eye(3))
    X = sim.world.rest[elements.elements]
    volume = np.linalg.det(X[:, 1:] - X[:, :1]) / 6
    found = -np.einsum("mai,maj,m->mij", elements.nodal_impulse / sim.world.dt, X, 1 / volume)  # sum f_a (x) X_a = -V P
    assert np.abs(found - stress).max() < 1e-10 * YOUNG


def test_solving_for_the_inside_gives_the_affine_field(sim):
    """One linear solve with the boundary held displaced, by the assembled matrix itself; the strain is small."""
    rest, h = sim.world.rest, sim.world.dt
    displacement = rest @ (1e-7 * AFFINE["stretch and shear"].T)
    sim.engine.assemble()
    K = sim.matrix().toarray() - np.diag(np.repeat(sim.world.mass, 3))
    K /= h * h
    inside = np.repeat(interior(rest, SIZE), 3)
    solved = np.linalg.solve(K[np.ix_(inside, inside)], -K[np.ix_(inside, ~inside)] @ displacement.ravel()[~inside])
    np.testing.assert_allclose(solved, displacement.ravel()[inside], rtol=0, atol=1e-12 * np.abs(displacement).max())


def test_steps_settle_to_the_affine_field(tmp_path):
    """The patch test through the simulation: a deformed boundary is fixed, the inside starts anywhere."""
    rest, tets = jittered_bar((3, 3, 3), SIZE, seed=6)
    hold = "X < 1e-6 or X > 1.1999 or Y < 1e-6 or Y > 0.9999 or Z < 1e-6 or Z > 0.7999"
    sim = simulation(
        bar(mesh=mesh_file(tmp_path, rest, tets), young=YOUNG, fixed=hold, damping=(1.0, 0.1)), dt=0.1, tolerance=1e-12
    )
    target = rest @ AFFINE["stretch and shear"].T
    inside = interior(rest, SIZE)
    assert np.array_equal(sim.world.free > 0, inside)
    sim.world.x[~inside] = target[~inside]
    sim.engine.run(100)
    assert np.abs(sim.world.x - target).max() < 1e-9


def test_forces_are_the_solution_of_the_matrix(sim):
    """At rest, K u is the force of a small displacement u: one K serves both."""
    random = np.random.default_rng(3)
    u = 1e-7 * random.normal(size=sim.world.x.shape)
    sim.engine.assemble()
    K = sim.matrix() / sim.world.dt**2
    K.setdiag(K.diagonal() - np.repeat(sim.world.mass, 3) / sim.world.dt**2)
    sim.world.x += u
    forces = elastic_forces(sim).ravel()
    assert np.abs(forces + K @ u.ravel()).max() < 1e-5 * np.abs(forces).max()  # second order in u
