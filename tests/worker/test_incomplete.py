# SPDX-License-Identifier: MIT
"""Incomplete factors: what is dropped, what bounds them, and that no matrix breaks them down."""

import numpy as np
import pytest
from numpy.typing import NDArray

from precond_worker.errors import NotPositiveDefinite
from precond_worker.factorization.registry import make_factorization
from precond_worker.symbolic.blocks import node_norms
from protocol.method import Method
from protocol.refused import Refused
from tests.reference import supernodal
from tests.scenes import random_rotations
from tests.worker.block_matrices import GRAPHS, dense_matrix, diagonal_blocks, spd

graphs = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS.keys())
BAR = GRAPHS["bar with a fixed end"]


def incomplete(drop_tolerance: float = 0.0, fill: float = 0.0) -> Method:
    return Method("incomplete_cholesky", drop_tolerance=drop_tolerance, fill=fill)


def in_place(analysis, values: NDArray) -> NDArray:
    """L L^T in the order of the matrix."""
    lower, order = supernodal.lower(analysis.pattern, values), analysis.pattern.permutation
    product = np.empty_like(lower)
    product[np.ix_(order, order)] = lower @ lower.T
    return product


def coupled(matrix: NDArray) -> NDArray[np.bool_]:
    """Which nodes share a block that is not zero."""
    nodes = len(matrix) // 3
    return np.abs(matrix).reshape(nodes, 3, nodes, 3).max(axis=(1, 3)) > 0


@graphs
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_with_nothing_dropped_it_is_the_matrix(graph, dtype):
    analysis, values = make_factorization(*graph, incomplete()), spd(*graph, seed=1)
    matrix = dense_matrix(*graph, values)
    made = analysis.factorize(values, dtype)
    analysis.pattern.check()
    assert made.dtype == dtype and analysis.remedy == ""
    error = np.abs(in_place(analysis, made.astype(float)) - matrix).max() / np.abs(matrix).max()
    assert error < (1e-6 if dtype == np.float32 else 1e-13)


@graphs
@pytest.mark.parametrize("omega", [0.7, 1.0, 1.6])
def test_ssor_is_its_formula_on_the_pattern_of_the_matrix(graph, omega):
    analysis, values = make_factorization(*graph, Method("ssor", omega=omega)), spd(*graph, seed=2)
    matrix = dense_matrix(*graph, values)
    own = np.arange(len(matrix)) // 3
    D = np.where(own[:, None] == own, matrix, 0) / omega
    lower = np.where(own[:, None] > own, matrix, 0)
    expected = (D + lower) @ np.linalg.inv(D) @ (D + lower).T * omega / (2 - omega)
    made = analysis.factorize(values, np.float64)
    assert np.abs(in_place(analysis, made) - expected).max() < 1e-12 * np.abs(expected).max()
    blocks, nodes = len(values), len(graph[0]) - 1
    assert len(made) == 6 * nodes + 9 * (blocks - nodes) // 2
    first = analysis.pattern
    analysis.factorize(spd(*graph, seed=3), np.float64)
    assert analysis.pattern is first  # nothing is dropped: it never changes, and is sent once


def test_more_dropped_is_less_kept_and_further_off():
    values = spd(*BAR, seed=4)
    matrix, sizes, errors = dense_matrix(*BAR, values), [], []
    for tolerance in (0.0, 0.001, 0.01, 0.05, 0.3):
        analysis = make_factorization(*BAR, incomplete(tolerance))
        made = analysis.factorize(values, np.float64)
        sizes.append(len(made))
        errors.append(np.linalg.norm(in_place(analysis, made) - matrix))
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) == len(sizes)
    assert errors == sorted(errors)


def test_what_is_kept_is_above_the_tolerance_of_its_row():
    tolerance, values = 0.05, spd(*BAR, seed=5)
    analysis = make_factorization(*BAR, incomplete(tolerance))
    made = analysis.factorize(values, np.float64)
    lower = supernodal.lower(analysis.pattern, made)
    nodes = len(lower) // 3
    blocks = np.linalg.norm(lower.reshape(nodes, 3, nodes, 3), axis=(1, 3))
    order = analysis.pattern.permutation[::3] // 3
    row = np.sqrt(np.linalg.norm(values[diagonal_blocks(*BAR)], axis=(1, 2)))[order]
    off = np.tril(blocks, -1)
    kept = off > 0
    assert kept.any()
    assert (off / row[:, None])[kept].min() > tolerance


@pytest.mark.parametrize("fill", [0.3, 1.0, 2.0])
def test_fill_bounds_every_column(fill):
    values, nodes = spd(*BAR, seed=6), len(BAR[0]) - 1
    analysis = make_factorization(*BAR, incomplete(0.0, fill))
    analysis.factorize(values, np.float64)
    below = np.diff(analysis.pattern.row_start) // 3 - 1
    most = int(np.ceil(fill * (len(BAR[1]) - nodes) / 2 / nodes))
    assert below.max() == most


def test_neither_units_nor_rotations_of_nodes_change_what_is_kept():
    """A scaled matrix and one in other frames of the nodes: the same blocks, the same L but for scale and frames."""
    values, (start, columns) = spd(*BAR, seed=7), BAR
    rows, R = np.repeat(np.arange(len(start) - 1), np.diff(start)), random_rotations(len(start) - 1, seed=8)
    turned = np.einsum("bij,bjk,blk->bil", R[rows], values, R[columns])
    analysis = make_factorization(*BAR, incomplete(0.02))
    product = in_place(analysis, analysis.factorize(values, np.float64))
    pattern = analysis.pattern
    scaled = in_place(analysis, analysis.factorize(1e-9 * values, np.float64))
    assert analysis.pattern is pattern
    assert np.abs(1e9 * scaled - product).max() < 1e-12 * np.abs(product).max()
    other = in_place(analysis, analysis.factorize(turned, np.float64))
    assert analysis.pattern is pattern
    nodes = len(R)
    back = np.einsum("nji,njmk,mkl->niml", R, other.reshape(nodes, 3, nodes, 3), R).reshape(product.shape)
    assert np.abs(back - product).max() < 1e-10 * np.abs(product).max()


def test_the_same_values_give_the_same_bits_whatever_came_before():
    one, other = spd(*BAR, seed=9), spd(*BAR, seed=10, zeros=0.5)
    analysis = make_factorization(*BAR, incomplete(0.02))
    first, pattern = analysis.factorize(one, np.float32), analysis.pattern.id
    analysis.factorize(other, np.float32)
    assert analysis.pattern.id != pattern  # what is kept follows the matrix
    assert analysis.factorize(one, np.float32).tobytes() == first.tobytes()
    assert analysis.pattern.id == pattern
    assert make_factorization(*BAR, incomplete(0.02)).factorize(one, np.float32).tobytes() == first.tobytes()


@graphs
@pytest.mark.parametrize("tolerance", [0.0, 0.1])
@pytest.mark.parametrize("depth", [0.02, 0.5, 3.0])
def test_a_matrix_that_is_not_positive_definite_is_shifted(graph, tolerance, depth):
    values = spd(*graph, seed=11)
    values[diagonal_blocks(*graph)] -= depth * np.linalg.eigvalsh(dense_matrix(*graph, values))[-1] * np.eye(3)
    analysis = make_factorization(*graph, incomplete(tolerance))
    made = analysis.factorize(values, np.float64)
    assert np.isfinite(made).all() and (made[analysis.pattern.diagonal] > 0).all()
    if np.linalg.eigvalsh(dense_matrix(*graph, values))[0] < 0 and tolerance == 0:
        assert analysis.remedy.startswith("diagonal shifted by ")
    analysis.factorize(spd(*graph, seed=11), np.float64)
    assert analysis.remedy == ""


@pytest.mark.parametrize("taken", [0.6, 0.65, 0.7, 0.8, 0.9])
def test_the_shift_is_the_least_of_its_triplings(taken):
    """L L^T is the shifted matrix, and a third of the shift is too little."""
    values, own = spd(*BAR, seed=12), diagonal_blocks(*BAR)
    values[own] -= taken * values[own]
    norm = np.repeat(node_norms(BAR[0], values), 3)
    matrix = dense_matrix(*BAR, values)
    analysis = make_factorization(*BAR, incomplete())
    product = in_place(analysis, analysis.factorize(values, np.float64))
    shift = float(analysis.remedy.split()[-1])
    assert np.abs(product - matrix - shift * np.diag(norm)).max() < 1e-12 * np.abs(product).max()
    assert np.linalg.eigvalsh(matrix + shift / 3 * np.diag(norm))[0] < 0


def test_ssor_needs_positive_diagonal_blocks():
    values = spd(*BAR, seed=13)
    values[diagonal_blocks(*BAR)[40]] *= -1
    with pytest.raises(NotPositiveDefinite, match="diagonal block of node 40 is not positive definite"):
        make_factorization(*BAR, Method("ssor")).factorize(values, np.float64)


@pytest.mark.parametrize("method", [incomplete(0.01), Method("ssor")], ids=lambda m: m.name)
def test_wrong_matrices_are_refused_and_the_next_one_is_fine(method):
    analysis, values = make_factorization(*BAR, method), spd(*BAR, seed=14)
    bad = values.copy()
    bad[5, 1, 1] = np.nan
    for wrong, words in ((bad, "NaN or infinity"), (values[:-1], "allowed"), (0 * values, "node")):
        with pytest.raises(ValueError, match=words):
            analysis.factorize(wrong, np.float64)
    with pytest.raises(NotPositiveDefinite, match="out of the range of float32"):
        analysis.factorize(1e80 * values, np.float32)
    assert np.isfinite(analysis.factorize(values, np.float32)).all()


@pytest.mark.parametrize(
    ("method", "words"),
    [
        (Method("lu"), "Matrix.method is 'lu'; allowed: cholesky, incomplete_cholesky, ssor"),
        (incomplete(1.0), "drop_tolerance is 1.0; allowed: at least 0, below 1"),
        (incomplete(float("nan")), "drop_tolerance"),
        (incomplete(0.1, -1.0), "fill is -1.0"),
        (incomplete(0.1, float("inf")), "fill is inf"),
        (Method("ssor", omega=2.0), "omega is 2.0; allowed: above 0, below 2"),
        (Method("ssor", omega=float("nan")), "omega"),
    ],
)  # fmt: skip
def test_a_method_out_of_range_is_refused(method, words):
    with pytest.raises(Refused, match=words.replace("(", r"\(")):
        make_factorization(*BAR, method)
