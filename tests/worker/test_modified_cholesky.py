# SPDX-License-Identifier: MIT
"""Complete factors of matrices that are not positive definite."""

import numpy as np
import pytest

from precond_worker.errors import NotPositiveDefinite
from precond_worker.factorization.modified_cholesky import ModifiedCholesky
from precond_worker.factorization.registry import make_factorization
from precond_worker.symbolic.blocks import node_norms
from tests.reference import supernodal
from tests.worker.block_matrices import GRAPHS, dense_matrix, diagonal_blocks, spd
from tests.worker.test_factorize import LIBRARIES

library = pytest.mark.parametrize("library", LIBRARIES)
graphs = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS.keys())
BAR = GRAPHS["bar with a fixed end"]


def lowered(graph, seed: int, share: float):
    """Values of a matrix whose lowest eigenvalue went below zero by `share` of its spectrum."""
    values = spd(*graph, seed=seed)
    spectrum = np.linalg.eigvalsh(dense_matrix(*graph, values))
    values[diagonal_blocks(*graph)] -= (spectrum[0] + share * (spectrum[-1] - spectrum[0]) + 1e-3) * np.eye(3)
    return values


@library
@graphs
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_as_many_pivots_are_turned_as_there_are_negative_eigenvalues(graph, library, share):
    """Sylvester's law of inertia; and L |D| L^T differs from A in a space of that many dimensions, no more."""
    values = lowered(graph, 3, share)
    analysis = ModifiedCholesky(*graph, library)
    made = analysis.factorize(values, np.float64)
    order = analysis.pattern.permutation
    matrix = dense_matrix(*graph, values)[np.ix_(order, order)]
    negative = int(np.count_nonzero(np.linalg.eigvalsh(matrix) < 0))
    assert negative > 0
    assert analysis.remedy == f"{negative} pivot{'s' if negative > 1 else ''} of LDL^T turned positive"
    lower = supernodal.lower(analysis.pattern, made)
    change = np.linalg.svd(lower @ lower.T - matrix, compute_uv=False)
    assert np.count_nonzero(change > 1e-8 * change[0]) == negative


@library
def test_a_good_matrix_after_a_bad_one_needs_no_remedy(library):
    analysis, good = ModifiedCholesky(*BAR, library), spd(*BAR, seed=4)
    plain = analysis.factorize(good, np.float32)
    assert analysis.remedy == ""
    analysis.factorize(lowered(BAR, 4, 0.1), np.float32)
    assert analysis.remedy
    assert analysis.factorize(good, np.float32).tobytes() == plain.tobytes()
    assert analysis.remedy == ""


@library
def test_a_shift_where_no_pivots_can_be_found_on_the_diagonal(library):
    """A diagonal block of zeros: LDL^T without pivoting divides by zero."""
    values, own = spd(*BAR, seed=5), diagonal_blocks(*BAR)
    rows = np.repeat(np.arange(len(BAR[0]) - 1), np.diff(BAR[0]))
    size = np.linalg.norm(values[own], axis=(1, 2)).max()
    analysis = ModifiedCholesky(*BAR, library)
    order = analysis.pattern.permutation
    first = next(int(p) // 3 for p in order[::3] if np.count_nonzero(rows == int(p) // 3) > 1)  # eliminated first
    values[own[first]] = 1e-30 * size * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]])
    made = analysis.factorize(values, np.float64)
    assert analysis.remedy.startswith("diagonal shifted by ")
    assert np.isfinite(made).all() and (made[analysis.pattern.diagonal] > 0).all()
    shift = float(analysis.remedy.split()[-1])
    norm = np.repeat(node_norms(BAR[0], values), 3)
    shifted = (dense_matrix(*BAR, values) + shift * np.diag(norm))[np.ix_(order, order)]
    lower = supernodal.lower(analysis.pattern, made)
    assert np.abs(lower @ lower.T - shifted).max() < 1e-10 * np.abs(shifted).max()


@library
def test_what_no_remedy_helps_against_is_said(library):
    analysis, values = ModifiedCholesky(*BAR, library), spd(*BAR, seed=6)
    with pytest.raises(NotPositiveDefinite, match="out of the range of float32"):
        analysis.factorize(1e80 * values, np.float32)
    with pytest.raises(ValueError, match="NaN or infinity"):
        analysis.factorize(np.nan * values, np.float32)
    with pytest.raises(NotPositiveDefinite, match="not positive definite"):
        analysis.factorize(0 * values, np.float32)


def test_cholesky_is_what_is_made_unless_something_else_is_asked_for():
    assert isinstance(make_factorization(*BAR), ModifiedCholesky)


@library
@pytest.mark.parametrize(("dtype", "least", "shift"), [(np.float32, 1e-10, 1e-6), (np.float64, 1e-15, 1e-12)])
def test_a_matrix_that_is_singular_but_for_rounding_is_shifted(library, dtype, least, shift):
    """A body that nothing holds at a huge time step: its rigid motions weigh nothing beside its stiffness. Without the
    shift conjugate gradients with the factor take thousands of iterations."""
    rows, columns = np.repeat(np.arange(len(BAR[0]) - 1), np.diff(BAR[0])), BAR[1]
    values = np.where((rows == columns)[:, None, None], 0.0, -np.eye(3))
    own = diagonal_blocks(*BAR)
    values[own] = (np.diff(BAR[0])[:, None, None] - 1 + least) * np.eye(3)  # a Laplacian and next to nothing
    values[own[np.diff(BAR[0]) == 1]] = np.eye(3)  # nodes that are held
    analysis = ModifiedCholesky(*BAR, library)
    made = analysis.factorize(values, dtype)
    assert analysis.remedy == f"diagonal shifted by {shift:g}"
    order = analysis.pattern.permutation
    matrix = dense_matrix(*BAR, values)[np.ix_(order, order)]
    lower = supernodal.lower(analysis.pattern, made.astype(float))
    error = np.abs(lower @ lower.T - matrix).max() / np.abs(matrix).max()
    assert error < 2 * shift
    assert np.linalg.cond(lower) ** 2 < 100 / shift
