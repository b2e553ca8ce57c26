# SPDX-License-Identifier: MIT
"""Every hyperelastic law: energy, forces and stiffness against the reference and against finite differences."""

import numpy as np
import pytest

from tests.physics.laws import (
    LAWS,
    Law,
    deform,
    determinants,
    error_of_forces,
    error_of_stiffness,
    forces,
    odd_bar,
    reference_system,
    stiffness,
)  # fmt: skip
from tests.scenes import random_rotations

every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())
STATES = {
    f"{name} {size}": (law, size) for name, law in LAWS.items() for size in ((0.1, 0.6) if law.inverts else (0.18,))
}
every_state = pytest.mark.parametrize(("law", "size"), STATES.values(), ids=STATES.keys())


def stirred(folder, law: Law, size: float, **scene):
    """Random positions and velocities; at size 0.6 some elements are inside out."""
    sim = odd_bar(folder, law, **scene)
    deform(sim, size, seed=2)
    J = determinants(sim)
    assert (J.min() < -0.2 and (J < 0).sum() > 1) if size > 0.5 else J.min() > 0.4
    return sim


@every_state
def test_energy_and_forces_are_those_of_the_reference(tmp_path, law, size):
    sim = stirred(tmp_path, law, size)
    energy, f, _ = reference_system(sim, law)
    assert sim.potential_energy() == pytest.approx(energy, rel=1e-11)
    assert np.abs(forces(sim) - f).max() < 1e-11 * np.abs(f).max()


@every_state
def test_forces_are_minus_the_slope_of_the_energy(tmp_path, law, size):
    sim = stirred(tmp_path, law, size)
    assert error_of_forces(sim) < 1e-6


@every_state
def test_the_stiffness_is_minus_the_slope_of_the_forces(tmp_path, law, size):
    """The stiffness with projection = "none" is the derivative of the forces, and that of the reference."""
    sim = stirred(tmp_path, law, size, projection="none")
    K = stiffness(sim)
    assert np.abs(K - reference_system(sim, law)[2]).max() < 1e-8 * np.abs(K).max()
    assert error_of_stiffness(sim) < 1e-5


@pytest.mark.slow
@every_state
def test_projected_stiffness_is_that_of_the_reference_and_semidefinite(tmp_path, law, size):
    """Eigenvalues of every element's d2W/dF2 clamped at 0, or made absolute, or the one or the other by their mode."""
    plain = reference_system(stirred(tmp_path, law, size), law)[2]
    for projection in ("clamp", "absolute", "excess"):
        sim = stirred(tmp_path, law, size, projection=projection)
        K, expected = stiffness(sim), reference_system(sim, law, projection)[2]
        assert np.abs(K - expected).max() < 1e-7 * np.abs(K).max(), projection
        values = np.linalg.eigvalsh(K)
        assert values[0] > -1e-11 * values[-1], projection
        changed = np.abs(K - plain).max() > 1e-5 * np.abs(K).max()
        assert changed or law.name == "st_venant_kirchhoff", f"{projection}: there was something to project"


@every_law
def test_the_stiffness_is_symmetric_and_blind_to_translations(tmp_path, law):
    K = stiffness(stirred(tmp_path, law, 0.1))
    assert np.abs(K - K.T).max() < 1e-14 * np.abs(K).max()
    moved = np.tile(np.eye(3), (len(K) // 3, 1))
    assert np.abs(K @ moved).max() < 1e-12 * np.abs(K).max()


@every_law
def test_the_right_hand_side_has_the_stiffness_times_the_velocity(tmp_path, law):
    """b = h f - h (h + beta) K v with the projected K that stands in A."""
    sim = stirred(tmp_path, law, 0.15, damping=(0.0, 0.03), dt=0.013)
    v = sim.world.v.copy()
    sim.engine.assemble()
    b, c = sim.system.b.copy(), 0.013 * (0.013 + 0.03)
    K = stiffness(sim) * 0.013**2 / c
    expected = 0.013 * forces(sim) - c * (K * c / 0.013**2 / (c / 0.013**2) @ v.ravel()).reshape(-1, 3)
    assert np.abs(b - expected).max() < 1e-11 * np.abs(expected).max()


@every_law
def test_no_force_and_no_energy_at_rest_moved_and_turned(tmp_path, law):
    sim = odd_bar(tmp_path, law)
    for R in random_rotations(5, seed=7):
        sim.world.x[:] = sim.world.rest @ R.T + [3.0, -2.0, 7.0]
        assert np.abs(forces(sim)).max() < 1e-10 * 3e4
        assert abs(sim.potential_energy()) < 1e-11 * 3e4


@every_law
def test_forces_turn_with_the_body_and_balance(tmp_path, law):
    sim = stirred(tmp_path, law, 0.12)
    x, f = sim.world.x.copy(), forces(sim).copy()
    assert np.abs(f.sum(axis=0)).max() < 1e-12 * np.abs(f).max()
    assert np.abs(np.cross(x, f).sum(axis=0)).max() < 1e-11 * np.abs(f).max()
    for R in random_rotations(3, seed=8):
        sim.world.x[:] = x @ R.T
        assert np.abs(forces(sim) - f @ R.T).max() < 1e-10 * np.abs(f).max()
