# SPDX-License-Identifier: MIT
"""kernels/contact_law.cuh: forces as derivatives of a convex function, stiffness as theirs, and its limits."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.texts import compiled

TEXT = """#include "kernel.h"
#include "contact_law.cuh"
struct Probe {
    int n;                   // rows
    const double* normal;    // (n, 3)
    const double* drift;     // (n, 3)
    const double* anchor;    // (n, 3)
    const double* gap;       // (n,)
    double thickness;
    double stiffness;
    double friction;
    double limit;
    int closed;
    const double* s;         // (n, 3)
    double* force;           // (n, 3) out: normal force and traction together
    double* normal_force;    // (n,) out
    double* matrix;          // (n, 6) out
};
KERNEL(probe, Probe) {
    const ContactRow row = {p.normal + 3 * i, p.drift + 3 * i, p.anchor + 3 * i,
                            p.gap[i], p.thickness, p.stiffness, p.friction};
    const ContactForce f = contact_force(row, p.s + 3 * i, p.limit, p.closed != 0);
    for (int k = 0; k < 3; ++k) p.force[3 * i + k] = f.normal * row.normal[k] + f.traction[k];
    p.normal_force[i] = f.normal;
    contact_stiffness(row, f, f.traction, 1, p.matrix + 6 * i);
}
"""
D, K, MU = 1e-3, 2e3, 0.5


@pytest.fixture(scope="module")
def law(tmp_path_factory):
    with compiled(TEXT, tmp_path_factory.mktemp("law")) as modules:
        yield modules["double"]


class Rows:
    """Random rows, near the kinks of the law."""

    def __init__(self, n: int = 200, seed: int = 0):
        random = np.random.default_rng(seed)
        normal = random.normal(size=(n, 3))
        self.normal = normal / np.linalg.norm(normal, axis=1)[:, None]
        self.drift = 1e-3 * random.normal(size=(n, 3))
        anchor = random.normal(size=(n, 3))
        self.anchor = anchor - self.normal * np.einsum("ij,ij->i", anchor, self.normal)[:, None]
        self.gap = D * random.uniform(-1, 3, n)
        self.s = 1e-3 * random.normal(size=(n, 3))

    def ask(self, law: Any, s: Any = None, limit: float = 1.0, closed: int = 0, friction: float = MU) -> tuple:
        s = self.s if s is None else np.ascontiguousarray(s)
        n = len(s)
        out = {"force": np.zeros((n, 3)), "normal_force": np.zeros(n), "matrix": np.zeros((n, 6))}
        given: dict[str, Any] = {name: getattr(self, name) for name in ("normal", "drift", "anchor", "gap")}
        given |= {"thickness": D, "stiffness": K, "friction": friction, "limit": limit, "closed": closed}
        law.bind("probe", n, **given, s=s, **out)()
        upper = out["matrix"][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(n, 3, 3)
        return out["force"], out["normal_force"], upper

    def potential(self, s: np.ndarray, limit: float) -> np.ndarray:
        """The convex function of which -force is the gradient, written anew."""
        depth = D - self.gap - np.einsum("ij,ij->i", self.normal, s)
        e = s - self.drift
        e -= self.normal * np.einsum("ij,ij->i", self.normal, e)[:, None]
        t, most = np.linalg.norm(self.anchor - K * e, axis=1), MU * limit
        return 0.5 * K * np.maximum(depth, 0) ** 2 + np.where(t <= most, 0.5 * t**2, most * t - 0.5 * most**2) / K


@pytest.mark.parametrize("limit", [0.0, 0.5, 3.0, 1e9])
def test_force_is_minus_the_gradient_of_a_convex_function(law, limit):
    rows, step = Rows(), 1e-7
    force, _, _ = rows.ask(law, limit=limit)
    for k in range(3):
        e = step * np.eye(3)[k]
        slope = (rows.potential(rows.s + e, limit) - rows.potential(rows.s - e, limit)) / (2 * step)
        assert abs(force[:, k] + slope).max() <= 1e-6 * abs(force).max()


@pytest.mark.parametrize("closed", [0, 1])
@pytest.mark.parametrize("limit", [0.0, 0.5, 3.0])
def test_stiffness_is_minus_the_derivative_of_the_force(law, limit, closed):
    rows, step = Rows(seed=1), 1e-9
    _, _, matrix = rows.ask(law, limit=limit, closed=closed)
    for k in range(3):
        e = step * np.eye(3)[k]
        ahead, behind = (rows.ask(law, rows.s + sign * e, limit, closed)[0] for sign in (1, -1))
        assert abs(matrix[:, :, k] + (ahead - behind) / (2 * step)).max() <= 1e-6 * K
    assert np.linalg.eigvalsh(matrix).min() >= -1e-9 * K
    assert np.linalg.eigvalsh(matrix).max() <= K * (1 + 1e-9)


@settings(max_examples=30, deadline=None)
@given(limit=st.floats(0, 10), friction=st.floats(0, 2), seed=st.integers(0, 10**6))
def test_forces_push_and_friction_keeps_to_its_cone(law, limit, friction, seed):
    rows = Rows(50, seed)
    force, normal, _ = rows.ask(law, limit=limit, friction=friction)
    traction = force - normal[:, None] * rows.normal
    assert (normal >= 0).all()
    assert abs(np.einsum("ij,ij->i", traction, rows.normal)).max() <= 1e-9 * max(limit, 1)
    assert np.linalg.norm(traction, axis=1).max() <= friction * limit * (1 + 1e-12) + 1e-15


def test_a_row_that_counts_as_closed_may_pull(law):
    rows = Rows(seed=2)
    _, normal, _ = rows.ask(law, closed=1)
    depth = D - rows.gap - np.einsum("ij,ij->i", rows.normal, rows.s)
    assert np.allclose(normal, K * depth, rtol=1e-12)
    assert (normal < 0).any()


def test_one_that_sticks_has_no_creep(law):
    """Held at the anchor's slip, the traction is the anchor's, for ever."""
    rows = Rows(seed=3)
    rows.s = rows.drift - rows.normal * rng_depth(rows)[:, None]
    force, normal, _ = rows.ask(law, limit=1e9)
    assert np.allclose(force - normal[:, None] * rows.normal, rows.anchor, rtol=1e-12, atol=1e-12)


def rng_depth(rows: Rows) -> np.ndarray:
    return 1e-3 * np.random.default_rng(4).uniform(0, 1, len(rows.gap))
