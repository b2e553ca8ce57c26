# SPDX-License-Identifier: MIT
"""kernels/vector_math.h: log, exp and cbrt of a vector, against the system's."""

import numpy as np
import pytest

from tests.texts import compiled

TEXT = """#define WIDE
#include "kernel.h"
struct Map {
    int n;          // items
    const real* a;  // (n,)
    real* out;      // (n,)
};
KERNEL(log_of, Map) { put(p.out, i, log(at(p.a, i))); }
KERNEL(exp_of, Map) { put(p.out, i, exp(at(p.a, i))); }
KERNEL(cbrt_of, Map) { put(p.out, i, cbrt(at(p.a, i))); }
"""
RANDOM = np.random.default_rng(3)
NEAR_ONE = 1 + np.concatenate([10.0 ** RANDOM.uniform(-16, -1, 2000), -(10.0 ** RANDOM.uniform(-16, -1, 2000))])
POSITIVE = np.concatenate([10.0 ** RANDOM.uniform(-307, 308, 4000), NEAR_ONE, [5e-324, 2e-310, 1.0, 2.0, 0.5]])
GIVEN = {
    "log": POSITIVE,
    "cbrt": POSITIVE[POSITIVE > 1e-300],
    "exp": np.concatenate(
        [RANDOM.uniform(-708, 709.7, 4000), RANDOM.normal(size=4000), 1e-8 * RANDOM.normal(size=999)]
    ),
}


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    """The module in double and single precision."""
    with compiled(TEXT, tmp_path_factory.mktemp("texts")) as modules:
        yield modules


def of(texts, name: str, a: np.ndarray, real: str = "double") -> np.ndarray:
    a = a.astype("f8" if real == "double" else "f4")
    out = np.full_like(a, 7.0)
    texts[real].bind(f"{name}_of", len(a), a=a, out=out)()
    return out


@pytest.mark.parametrize("name", GIVEN)
def test_within_two_units_in_the_last_place(texts, name):
    a = GIVEN[name]
    exact = getattr(np, name)(a.astype(np.longdouble))  # the system's in double precision errs by a unit or two itself
    assert np.abs((of(texts, name, a) - exact) / np.spacing(np.abs(exact.astype(float)))).max() <= 2


def test_limits_and_what_is_no_number(texts):
    inf, nan = np.inf, np.nan
    a = np.array([0.0, -0.0, -1.0, -inf, inf, nan, 710.0, -746.0, 1e300, -1e300])
    np.testing.assert_array_equal(of(texts, "log", a)[:6], [-inf, -inf, nan, nan, inf, nan])
    np.testing.assert_array_equal(of(texts, "exp", a), [1, 1, np.exp(-1.0), 0, inf, nan, inf, 0, inf, 0])


def test_single_precision_too(texts):
    a = np.linspace(0.1, 5, 100)
    for name in GIVEN:
        np.testing.assert_allclose(of(texts, name, a, "float"), getattr(np, name)(a), rtol=1e-6, atol=1e-7)
