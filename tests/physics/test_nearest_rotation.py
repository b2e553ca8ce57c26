# SPDX-License-Identifier: MIT
"""kernels/polar.cuh through the elements' kernel: the rotation nearest to F, against singular value decomposition.

With singular values s1 >= s2 >= |s3| (s3 < 0 where det F < 0) the rotation is unique where s2 + s3 > 0, and conditioned
like s1 / (s2 + s3).
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.effects.corotational import rotation_matrices
from tests.reference.corotational import nearest_rotation
from tests.scenes import random_rotations
from tests.texts import module_in

COUNT = 2000


def kernel(F: NDArray, real: str = "double") -> NDArray:
    """Rotations of elements whose rest shape is the unit tetrahedron, so that F holds the edges now."""
    m, dtype = len(F), np.dtype("f8" if real == "double" else "f4")
    corners = np.zeros((m, 4, 3), dtype)
    corners[:, 1:] = np.swapaxes(F, 1, 2)
    quaternion = np.full((m, 4), np.nan, dtype)
    module_in("effects/corotational.cu", real).bind(
        "elements", m, tets=np.arange(4 * m, dtype=np.int32).reshape(m, 4), x=corners.reshape(-1, 3),
        v=np.zeros((4 * m, 3), dtype), gradients=np.repeat(np.eye(3, dtype=dtype).reshape(9, 1), m, axis=1),
        lame=np.ones((2, m), dtype), stiffness_coefficient=np.ones(m, dtype), h=0.01, quaternion=quaternion,
        scaled_gradients=np.zeros((m, 4, 4), dtype), nodal_impulse=np.zeros((m, 4, 3), dtype),
    )()  # fmt: skip
    return rotation_matrices(quaternion)


def with_singular_values(s1, s2, s3, seed: int = 1) -> NDArray:
    """Random matrices U diag(s1, s2, s3) V^T with U, V proper rotations."""
    s = np.stack(np.broadcast_arrays(s1, s2, s3), axis=-1) * np.ones((COUNT, 1))
    U, V = random_rotations(COUNT, seed), random_rotations(COUNT, seed + 1)
    return (U * s[:, None, :]) @ np.swapaxes(V, 1, 2)


def singular_values(F: NDArray) -> NDArray:
    """s1 >= s2 >= |s3|, the last with the sign of det F, (m, 3)."""
    s = np.linalg.svd(F, compute_uv=False)
    s[:, 2] *= np.sign(np.linalg.det(F))
    return s


def loss(F: NDArray, R: NDArray) -> NDArray:
    """(max - value) / s1 of the objective tr(R^T F), (m,)."""
    s = singular_values(F)
    return (s.sum(axis=1) - np.einsum("mij,mij->m", R, F)) / np.maximum(s[:, 0], 1e-300)


RANDOM = np.random.default_rng(0)
GENERAL = RANDOM.normal(size=(COUNT, 3, 3))
SHARE = RANDOM.random(COUNT)
WELL_POSED = {
    "random": GENERAL,
    "inverted": -GENERAL * np.sign(np.linalg.det(GENERAL))[:, None, None],
    "a rotation": random_rotations(COUNT),
    "near a rotation": random_rotations(COUNT) + 1e-3 * GENERAL,
    "flat": with_singular_values(1, 0.1 + 0.9 * SHARE, 0),
    "nearly flat": with_singular_values(1, 0.1 + 0.9 * SHARE, -1e-8),
    "barely inverted": with_singular_values(1, 0.5, -0.5 * SHARE),
    "nearly a reflection": with_singular_values(1, 1, -1 + 1e-3 + 0.1 * SHARE),
    "needle 1e-2": with_singular_values(1, 1e-2, 1e-2 * SHARE),
    "needle 1e-4": with_singular_values(1, 1e-4, 1e-4 * SHARE),
    "scaled 1e-6": 1e-6 * GENERAL,
    "scaled 1e6": 1e6 * GENERAL,
    "scaled 1e-30": 1e-30 * GENERAL,
}
DEGENERATE = {
    "needle 1e-6": with_singular_values(1, 1e-6, 1e-6 * SHARE),
    "needle 1e-9": with_singular_values(1, 1e-9, -1e-9 * SHARE),
    "rank one": with_singular_values(1, 0, 0),
    "a reflection": with_singular_values(1, 1, -1),
    "s2 + s3 = 0": with_singular_values(1, 0.5, -0.5),
    "s2 + s3 = 1e-7": with_singular_values(1, 0.5, -0.5 + 1e-7),
    "zero": np.zeros((COUNT, 3, 3)),
}
well_posed = pytest.mark.parametrize("F", WELL_POSED.values(), ids=WELL_POSED.keys())
any_matrix = pytest.mark.parametrize(
    "F", [*WELL_POSED.values(), *DEGENERATE.values()], ids=[*WELL_POSED.keys(), *DEGENERATE.keys()]
)


@any_matrix
def test_it_is_a_proper_rotation(F):
    R = kernel(F)
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-14
    np.testing.assert_allclose(np.linalg.det(R), 1, rtol=0, atol=1e-14)


@well_posed
def test_it_is_the_nearest_one(F):
    """The rotation equals that by singular values, up to rounding times the condition number."""
    R, s = kernel(F), singular_values(F)
    assert loss(F, R).max() < 1e-14
    expected = np.array([nearest_rotation(f) for f in F])
    gap = (s[:, 1] + s[:, 2]) / s[:, 0]
    assert (np.abs(R - expected).max(axis=(1, 2)) * gap).max() < 3e-14


@any_matrix
def test_the_objective_is_optimal_even_where_the_rotation_is_not_unique(F):
    """Within 1e-5 of its scale in the worst case (s2 + s3 below 1e-5 s1: needles, reflections)."""
    assert loss(F, kernel(F)).max() < 1e-5


def test_nothing_gives_the_identity():
    np.testing.assert_array_equal(kernel(np.zeros((3, 3, 3))), np.tile(np.eye(3), (3, 1, 1)))


def test_diagonal_matrices_need_no_luck():
    """Exact zeros in the right places: where an algorithm that searches along directions might stand still."""
    signs = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)], float)
    F = np.concatenate([np.einsum("mi,ij->mij", signs * s, np.eye(3)) for s in ([1, 0.5, 0.2], [0.2, 1, 1e-3])])
    assert loss(F, kernel(F)).max() < 1e-14


def test_it_is_a_pure_function_whatever_stands_beside_it():
    """Items share vector registers; each result must depend on its own F alone, to the last bit."""
    F = np.concatenate([GENERAL[:37], np.full((1, 3, 3), np.nan), np.zeros((1, 3, 3)), GENERAL[37:90]])
    whole = kernel(F)
    for i in (0, 36, 39, 60, len(F) - 1):
        np.testing.assert_array_equal(kernel(F[i : i + 1])[0], whole[i])


@well_posed
def test_it_turns_with_its_argument(F):
    """R(Q F) = Q R(F)."""
    Q, s = random_rotations(COUNT, 9), singular_values(F)
    gap = (s[:, 1] + s[:, 2]) / s[:, 0]
    assert (np.abs(kernel(Q @ F) - Q @ kernel(F)).max(axis=(1, 2)) * gap).max() < 1e-13


@pytest.mark.parametrize("name", [n for n in WELL_POSED if n != "scaled 1e-30"])
def test_single_precision_is_the_same_to_its_rounding(name):
    F = WELL_POSED[name].astype(np.float32).astype(float)
    R, s = kernel(F, "float"), singular_values(F)
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 2e-6
    assert loss(F, R).max() < 2e-3
    conditioned = (s[:, 1] + s[:, 2]) / s[:, 0] > 0.05
    assert loss(F, R)[conditioned].max(initial=0) < 2e-6
    assert np.abs(R - kernel(F)).max(axis=(1, 2))[conditioned].max(initial=0) < 1e-4
