# SPDX-License-Identifier: MIT
"""The reference of locking: linear strains exactly, and the sag of a cantilever between its two forms."""

import numpy as np
import pytest

from sim_server.mesh import bar
from tests.reference.quadratic_statics import (
    SAG,
    SIZE,
    body_force,
    displacements,
    face_shares,
    gradients,
    with_mid_nodes,
)
from tests.scenes import jittered_bar


@pytest.mark.parametrize("mean", [False, True])
def test_the_patch_test(mean: bool):
    """Held on its surface as a linear field, which the inside takes on: put as a load of what is held."""
    mesh = with_mid_nodes(*jittered_bar((2, 2, 2), (1, 1, 1)))
    slope = np.array([[0.1, 0.2, 0.0], [0.0, -0.1, 0.3], [0.2, 0.0, 0.1]])
    field = mesh.rest @ slope.T
    g, volume = gradients(mesh)
    assert volume.sum() == pytest.approx(1)
    found = np.einsum("mqak,mai->mqik", g, field[mesh.tets])
    np.testing.assert_allclose(found, np.broadcast_to(slope, found.shape), atol=1e-12)
    held = np.zeros((len(mesh.rest), 3), bool)
    held[mesh.rest[:, 0] < 1e-9, 0] = held[mesh.rest[:, 1] < 1e-9, 1] = held[mesh.rest[:, 2] < 1e-9, 2] = True
    force = np.outer(face_shares(mesh.rest, mesh.tets, mesh.rest[:, 2] > 1 - 1e-9), [0, 0, 1])
    u = displacements(mesh, 0.3, held, force, mean)
    np.testing.assert_allclose(u, mesh.rest * [-0.3, -0.3, 1.0], atol=1e-9)  # a bar pulled along z by its E


@pytest.mark.parametrize("poisson", SAG)
def test_the_sag_lies_between_both_forms(poisson: float):
    box = bar((4, 4, 16), SIZE)
    mesh = with_mid_nodes(box.rest, box.tets)
    held = np.repeat((mesh.rest[:, 2] < 1e-9)[:, None], 3, axis=1)
    tip = mesh.rest[:, 2] > SIZE[2] - 1e-9
    force = body_force(mesh, np.array([0.0, -1.0, 0.0]))
    assert force.sum(axis=0) == pytest.approx([0, -4, 0])
    stiff, soft = (-displacements(mesh, poisson, held, force, mean)[tip, 1].mean() for mean in (False, True))
    assert stiff < SAG[poisson] < soft < 1.05 * stiff
