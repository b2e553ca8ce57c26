# SPDX-License-Identifier: MIT
"""Shape functions of quadratic tetrahedra and their rule of integration."""

import numpy as np

from sim_server.mesh.quadratic import EDGES
from sim_server.mesh.shape_functions import POINTS, quadratic_gradients, quadratic_shapes
from sim_server.mesh.surface import volumes
from tests.mesh.test_quadratic_mesh import jittered


def test_values_are_one_at_their_node_and_sum_to_one():
    corners = np.eye(4)
    nodes = np.concatenate([corners, corners[np.array(EDGES)].mean(axis=1)])
    assert np.allclose(quadratic_shapes(nodes)[0], np.eye(10), atol=1e-15)
    points = np.random.default_rng(1).dirichlet(np.ones(4), 20)
    values, derivatives = quadratic_shapes(points)
    assert np.allclose(values.sum(axis=1), 1, rtol=1e-14) and np.abs(derivatives.sum(axis=1)).max() < 1e-14


def test_derivatives_are_those_of_the_values():
    points, step = np.random.default_rng(2).dirichlet(np.ones(4), 5), 1e-6
    derivatives = quadratic_shapes(points)[1]
    for k in range(3):
        move = step * (np.eye(4)[k + 1] - np.eye(4)[0])
        central = (quadratic_shapes(points + move)[0] - quadratic_shapes(points - move)[0]) / (2 * step)
        assert np.allclose(central, derivatives[..., k], atol=1e-9)


def field(x):
    """A quadratic function, (...,), and its gradient (..., 3)."""
    a = np.array([[1.0, 0.3, -0.7], [0.3, -2, 0.5], [-0.7, 0.5, 0.8]])
    b = np.array([0.2, -1, 3])
    return ((x @ a) * x).sum(axis=-1) + x @ b + 4, 2 * x @ a + b


def test_the_gradient_of_a_quadratic_field_is_exact_in_straight_elements():
    mesh = jittered()
    gradients = quadratic_gradients(mesh.rest, mesh.quadratic)[1]
    points = np.einsum("qk,mki->mqi", POINTS, mesh.rest[mesh.quadratic[:, :4]])
    found = np.einsum("mqai,ma->mqi", gradients, field(mesh.rest[mesh.quadratic])[0])
    assert np.allclose(found, field(points)[1], atol=1e-11)


def test_an_affine_field_is_exact_in_curved_elements():
    mesh = jittered(curved=0.08)
    parts, gradients = quadratic_gradients(mesh.rest, mesh.quadratic)
    map = np.random.default_rng(4).uniform(-1, 1, (3, 3))
    found = np.einsum("mqaj,mai->mqij", gradients, mesh.rest[mesh.quadratic] @ map.T)
    assert np.allclose(found, map, atol=1e-12)
    assert (parts > 0).all() and np.abs(gradients.sum(axis=2)).max() < 1e-12


def test_parts_of_the_volume():
    mesh = jittered()
    parts = quadratic_gradients(mesh.rest, mesh.quadratic)[0]
    assert np.allclose(4 * parts, volumes(mesh.rest, mesh.quadratic[:, :4])[:, None], rtol=1e-12)
    curved = jittered(curved=0.08)
    parts = quadratic_gradients(curved.rest, curved.quadratic)[0]
    assert not np.allclose(4 * parts.min(axis=1), 4 * parts.max(axis=1), rtol=1e-3)


def test_the_rule_integrates_polynomials_of_second_degree():
    """Against the integrals 6 a! b! / (a + b + 3)! of La^a Lb^b over an element of volume 1."""
    assert np.allclose(POINTS.sum(axis=1), 1)
    assert np.isclose((POINTS[:, 0] ** 2).mean(), 6 * 2 / 120) and np.isclose(
        (POINTS[:, 0] * POINTS[:, 1]).mean(), 0.05
    )
