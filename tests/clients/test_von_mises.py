# SPDX-License-Identifier: MIT
"""Von Mises stress against values known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clients.log.von_mises import StressField
from tests.sample_run import REST, TETS

YOUNG, POISSON = 2e5, 0.3
MU = YOUNG / (2 * (1 + POISSON))


def field(**options: np.ndarray) -> StressField:
    return StressField(REST, TETS, np.full(2, YOUNG), np.full(2, POISSON), **options)


@pytest.mark.parametrize("strain", [0.01, -0.02, 0.3])
@pytest.mark.parametrize("turn", [(0, 0, 0), (50, -20, 170)])
def test_uniaxial_tension(strain: float, turn: tuple[float, float, float]) -> None:
    """A bar pulled along x that contracts freely: stress E e along the axis and nothing else, however it is turned."""
    stretched = REST * [1 + strain, 1 - POISSON * strain, 1 - POISSON * strain]
    x = Rotation.from_euler("xyz", turn, degrees=True).apply(stretched) + np.array([3, 2, 1])
    np.testing.assert_allclose(field().nodes(x), abs(YOUNG * strain), rtol=1e-9)


@pytest.mark.parametrize("turn", [(90, 0, 0), (10, 20, 30), (0, 180, 0)])
def test_rigid_motion_is_free_of_stress(turn: tuple[float, float, float]) -> None:
    x = Rotation.from_euler("xyz", turn, degrees=True).apply(REST) - [5, 0, 0]
    np.testing.assert_allclose(field().nodes(x), 0, atol=1e-9 * YOUNG)


def test_uniform_swelling_is_free_of_shear() -> None:
    np.testing.assert_allclose(field().nodes(1.5 * REST), 0, atol=1e-9 * YOUNG)


def test_pure_shear() -> None:
    """Principal stretches 1 + e, 1 - e, 1: deviator diag(1, -1, 0) 2 mu e, von Mises sqrt(3) 2 mu e."""
    np.testing.assert_allclose(field().nodes(REST * [1.02, 0.98, 1]), np.sqrt(3) * 2 * MU * 0.02, rtol=1e-9)


def test_full_tensor_agrees() -> None:
    """Against R (2 mu (S - I) + lambda tr(S - I) I) R^T written out, for an arbitrary deformation."""
    gradient = np.eye(3) + 0.2 * np.random.default_rng(0).standard_normal((3, 3))
    u, s, vt = np.linalg.svd(gradient)
    assert np.linalg.det(gradient) > 0
    rotation, strain = u @ vt, vt.T @ np.diag(s) @ vt - np.eye(3)
    lame = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    stress = rotation @ (2 * MU * strain + lame * np.trace(strain) * np.eye(3)) @ rotation.T
    deviator = stress - np.trace(stress) / 3 * np.eye(3)
    expected = np.sqrt(1.5 * (deviator**2).sum())
    np.testing.assert_allclose(field().tets(REST @ gradient.T), expected, rtol=1e-9)


def test_an_inverted_tet_is_stressed() -> None:
    """Mirrored, the singular values of F are all 1; the stretch is not."""
    np.testing.assert_allclose(field().tets(REST * [1, 1, -1]), 2 * MU * 2, rtol=1e-9)


def test_nodes_average_by_volume() -> None:
    """Tet 0 has 1/6 of volume, tet 1 has 1/3; node 0 touches tet 0 alone, node 4 tet 1 alone, the others both."""
    stress = StressField(REST, TETS, np.array([1e5, 4e5]), np.full(2, 0.25))
    x = REST * [1.01, 1, 1]
    np.testing.assert_allclose(stress.tets(x), [800, 3200], rtol=1e-9)
    np.testing.assert_allclose(stress.nodes(x), [800, 2400, 2400, 2400, 3200], rtol=1e-9)


def test_restricted_to_some_nodes() -> None:
    x = REST * [1.01, 1, 1]
    assert len(field(nodes=np.array([4])).tets(x)) == 1
    np.testing.assert_allclose(field(nodes=np.array([4])).nodes(x)[4], field().nodes(x)[4])
    assert field(nodes=np.array([4])).nodes(x)[0] == 0


def test_a_flat_tet_is_left_out() -> None:
    rest = REST.copy()
    rest[3] = [0.25, 0.25, 0]  # tet 0 is flat, tet 1 is not
    stress = StressField(rest, TETS, np.full(2, YOUNG), np.full(2, POISSON))
    assert np.isfinite(stress.nodes(rest)).all() and len(stress.tets(rest)) == 1
