# SPDX-License-Identifier: MIT
"""kernels/svd3.cuh and eigen9.cuh, what the projection of stiffness rests on, against NumPy."""

import numpy as np
import pytest

from tests.scenes import random_rotations
from tests.texts import compiled

TEXT = """#define WIDE
#include "hyperelastic.cuh"
struct Svd {
    int n;          // items
    const real* F;  // (n, 9)
    real* u;        // (n, 9) out: columns one after another
    real* s;        // (n, 3) out
    real* v;        // (n, 9) out
};
KERNEL(svd, Svd) {
    Principal<number> f = principal(load9(p.F, i));
    put_row(p.u, i, p.n, {f.u[0].x, f.u[0].y, f.u[0].z, f.u[1].x, f.u[1].y, f.u[1].z, f.u[2].x, f.u[2].y, f.u[2].z});
    put_row(p.s, i, p.n, f.s);
    put_row(p.v, i, p.n, {f.v[0].x, f.v[0].y, f.v[0].z, f.v[1].x, f.v[1].y, f.v[1].z, f.v[2].x, f.v[2].y, f.v[2].z});
}
struct Eigen {
    int n;             // items
    const real* a;     // (n, 81)
    real* value;       // (n, 9) out
    real* vector;      // (n, 81) out
};
KERNEL(eigen, Eigen) {
    number a[9][9];
    for (int k = 0; k < 81; ++k) a[k / 9][k % 9] = row_at<81>(p.a, i, k);
    Eigen9<number> e;
    eigen9(a, e);
    put_row(p.value, i, p.n, e.value);
    for (int k = 0; k < 81; ++k) row_put<81>(p.vector, i, k, e.vector[k / 9][k % 9]);
}
"""
PRECISIONS = {"double": ("f8", 4e-15), "float": ("f4", 4e-6)}
RANDOM = np.random.default_rng(5)
COUNT = 600


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    with compiled(TEXT, tmp_path_factory.mktemp("texts")) as modules:
        yield modules


def with_stretches(*s) -> np.ndarray:
    s = np.stack(np.broadcast_arrays(*s), axis=-1) * np.ones((COUNT, 1))
    return (random_rotations(COUNT, 1) * s[:, None, :]) @ np.swapaxes(random_rotations(COUNT, 2), 1, 2)


SMALL = 10.0 ** RANDOM.uniform(-18, 0, COUNT)
MATRICES = {
    "random": RANDOM.normal(size=(COUNT, 3, 3)),
    "small strains": np.eye(3) + 1e-3 * RANDOM.normal(size=(COUNT, 3, 3)),
    "equal stretches": with_stretches(1.3, 1.3, 1.3),
    "two equal stretches": with_stretches(1.3, 0.7, 0.7),
    "nearly flat": with_stretches(1.0, 0.8, SMALL),
    "nearly flat, inverted": with_stretches(1.0, 0.8, -SMALL),
    "needles": with_stretches(1.0, SMALL, -SMALL * RANDOM.random(COUNT)),
    "flat": with_stretches(1.0, 0.8, 0.0),
    "a line": with_stretches(1.0, 0.0, 0.0),
    "diagonal": np.eye(3) * RANDOM.normal(size=(COUNT, 1, 3)),
    "a point": np.zeros((3, 3, 3)),
    "large": 1e8 * RANDOM.normal(size=(COUNT, 3, 3)),
    "small": 1e-8 * RANDOM.normal(size=(COUNT, 3, 3)),
}


@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("name", MATRICES)
def test_singular_values_and_vectors(texts, name, real):
    dtype, eps = PRECISIONS[real]
    F = MATRICES[name].astype(dtype)
    u, v, s = np.zeros((len(F), 9), dtype), np.zeros((len(F), 9), dtype), np.zeros((len(F), 3), dtype)
    texts[real].bind("svd", len(F), F=F.reshape(-1, 9), u=u, s=s, v=v)()
    U, V = (np.swapaxes(a.astype(float).reshape(-1, 3, 3), 1, 2) for a in (u, v))
    size = np.linalg.norm(F.astype(float), axis=(1, 2))
    for R in (U, V):
        assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 2 * eps
        assert (np.linalg.det(R) > 0.5).all()
    assert (np.abs((U * s[:, None, :]) @ np.swapaxes(V, 1, 2) - F).max(axis=(1, 2)) <= 2 * eps * size).all()
    assert (s[:, 0] >= s[:, 1] * (1 - eps)).all() and (s[:, 1] >= np.abs(s[:, 2]) - eps * size).all()


def of_eigenvalues(values: np.ndarray) -> np.ndarray:
    """(n, 9, 9) with these eigenvalues (n, 9)."""
    q, _ = np.linalg.qr(RANDOM.normal(size=(len(values), 9, 9)))
    return (q * values[:, None, :]) @ np.swapaxes(q, 1, 2)


SPECTRA = {
    "random": RANDOM.normal(size=(COUNT, 9)),
    "one below zero": np.abs(RANDOM.normal(size=(COUNT, 9))) * [-1, 1, 1, 1, 1, 1, 1, 1, 1],
    "none below zero": np.abs(RANDOM.normal(size=(COUNT, 9))),
    "all below zero": -np.abs(RANDOM.normal(size=(COUNT, 9))),
    "three alike below zero": np.tile([-1.0, -1, -1, 2, 2, 3, 5, 8, 1e3], (COUNT, 1)),
    "over many decades": RANDOM.choice([-1, 1], (COUNT, 9)) * 10.0 ** RANDOM.uniform(-12, 0, (COUNT, 9)),
    "half of them zero": RANDOM.normal(size=(COUNT, 9)) * (np.arange(9) % 2),
    "zero": np.zeros((COUNT, 9)),
}


@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("name", SPECTRA)
@pytest.mark.parametrize("scale", [1.0, 1e-8])
def test_what_is_below_zero_of_nine_by_nine(texts, name, real, scale):
    dtype, eps = PRECISIONS[real]
    A = of_eigenvalues(scale * SPECTRA[name])
    A = (0.5 * (A + np.swapaxes(A, 1, 2))).astype(dtype)
    value, vector = np.zeros((COUNT, 9), dtype), np.zeros((COUNT, 81), dtype)
    texts[real].bind("eigen", COUNT, a=A.reshape(COUNT, 81), value=value, vector=vector)()
    q = vector.astype(float).reshape(COUNT, 9, 9)
    assert np.abs(q @ np.swapaxes(q, 1, 2) - np.eye(9)).max() < 3 * eps
    below = np.einsum("nk,nki,nkj->nij", np.minimum(value, 0), q, q)
    expected, p = np.linalg.eigh(A.astype(float))
    expected = np.einsum("nk,nik,njk->nij", np.minimum(expected, 0), p, p)
    size = np.linalg.norm(A.astype(float), axis=(1, 2))
    assert (np.abs(below - expected).max(axis=(1, 2)) <= 3 * eps * size).all()
