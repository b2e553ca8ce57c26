# SPDX-License-Identifier: MIT
"""How many binary digits the inverse of a factor gets on a GPU (gpu/inverse/digits.py)."""

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from protocol.factor import FactorPattern
from sim_server.backends.gpu.inverse import digits as module
from sim_server.backends.gpu.inverse.digits import FEW, MOST_RESPONSE, largest_responses, planes_of
from sim_server.simulation import Simulation
from tests.hard_cases.case import BAR, GRAVITY, young
from tests.support.digits import iterations_by_digits
from tests.worker.block_matrices import bar_edges, dense_matrix, pattern, spd

SMALL = "object.bar.mesh={ bar = [2, 2, 8], size = [1, 1, 4] }"


def largest_response(of: FactorPattern, values: np.ndarray) -> float:
    return float(largest_responses(of, [values])[0])


def planes_for(of: FactorPattern, values: np.ndarray) -> int:
    return planes_of([(of, values)])[0]


def exact(matrix: np.ndarray) -> float:
    return float((np.diagonal(matrix) * np.diagonal(np.linalg.inv(matrix))).max())


@pytest.mark.parametrize("seed", range(4))
def test_the_estimate_is_near_the_largest_response(seed):
    graph = pattern(60, bar_edges(2, 3, 4), np.arange(5))
    values = spd(*graph, seed=seed)
    analysis, true = Analysis(*graph), exact(dense_matrix(*graph, values))
    for dtype in (np.float32, np.float64):
        found = largest_response(analysis.pattern, analysis.factorize(values, dtype))
        assert 0.6 * true < found < 2 * true


def test_it_is_exact_where_nothing_is_coupled():
    graph = pattern(7, np.empty((0, 2), int))
    values = np.zeros((7, 3, 3))
    values[:, range(3), range(3)] = np.geomspace(1e-8, 1e8, 21).reshape(7, 3)
    analysis = Analysis(*graph)
    assert largest_response(analysis.pattern, analysis.factorize(values)) == pytest.approx(1, rel=1e-6)


def test_units_and_ratios_between_nodes_do_not_change_it():
    """C A C with diagonal C: signs, and so what is estimated, stay those of A."""
    pair = FactorPattern.build(np.arange(2), [0, 1, 2], [0, 2, 3], [0, 1, 1])
    found = [largest_response(pair, np.array([a, 0.9 * b, b])) for a, b in ((1, 1), (1e3, 1), (1e-3, 1e6))]
    assert found == pytest.approx([found[0]] * 3, rel=1e-5)
    assert found[0] == pytest.approx(exact(np.array([[1, 0.9], [0.9, 1.81]])), rel=0.5)


@pytest.mark.parametrize("helpers", [0, 3])
def test_each_of_many_gets_what_it_would_get_alone(monkeypatch, helpers):
    """Of several patterns, in whatever order, by one thread or by several; one with NaN spoils no other."""
    monkeypatch.setattr(module, "helping_threads", lambda: helpers)
    graphs = [pattern(60, bar_edges(2, 3, 4)), pattern(7, np.empty((0, 2), int))]
    made = [Analysis(*graph) for graph in graphs]
    factors = [
        (made[k % 5 == 3].pattern, made[k % 5 == 3].factorize(spd(*graphs[k % 5 == 3], seed=k), np.float32))
        for k in range(4 * FEW)
    ]
    factors[6][1][:] *= np.where(np.arange(len(factors[6][1])) < 3, 1e-4, 1.0).astype(np.float32)
    factors[9][1][5] = np.nan
    alone = [planes_for(*each) for each in factors]
    assert planes_of(factors) == alone and alone[9] == 2 and set(alone) == {1, 2}
    own = [values for of, values in factors if of is made[0].pattern]
    assert np.array_equal(
        largest_responses(made[0].pattern, own), [largest_response(made[0].pattern, v) for v in own], equal_nan=True
    )


def test_the_same_factor_always_gets_the_same_and_one_with_nan_gets_22():
    graph = pattern(60, bar_edges(2, 3, 4))
    analysis, values = Analysis(*graph), spd(*graph, seed=3)
    factor = analysis.factorize(values, np.float32)
    assert largest_response(analysis.pattern, factor) == largest_response(analysis.pattern, factor.copy())
    assert planes_for(analysis.pattern, factor) == 1
    for k in (0, 100, len(factor) - 1):
        spoiled = factor.copy()
        spoiled[k] = np.nan
        assert planes_for(analysis.pattern, spoiled) == 2


CASES = {
    "usual": ((), 1),
    "stiff and soft side by side, 1e3": ((young(("X < 0.5", 1e7), ("true", 1e4)),), 1),
    "stiff and soft side by side, 1e6": ((young(("X < 0.5", 1e10), ("true", 1e4)),), 2),
    "from stiff to soft, 1e6": ((young(("Z < 1.3", 1e11), ("Z < 2.7", 1e8), ("true", 1e5)),), 1),
    "Poisson 0.49": (("object.bar.effects.corotational.poisson=0.49",), 1),
    "Poisson 0.4999": (("object.bar.effects.corotational.poisson=0.4999",), 2),
    "a step of 2 s": (("dt=2.0",), 2),
}


@pytest.mark.parametrize(("scene", "planes"), CASES.values(), ids=CASES.keys())
def test_factors_get_22_digits_where_11_take_several_times_the_iterations(scene, planes):
    """Of the matrix of a step, by CG with the inverse rounded as a GPU stores it."""
    found, made, factor = iterations_by_digits(Simulation.load(BAR, [GRAVITY, SMALL, *scene]), 10, 100)
    response = largest_response(made, factor)
    assert planes_for(made, factor) == planes and (response > MOST_RESPONSE) == (planes == 2)
    coarse, fine = found
    assert fine <= 3 and (coarse > 3 * fine if planes == 2 else coarse <= 5), (found, response)
