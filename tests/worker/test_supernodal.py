# SPDX-License-Identifier: MIT
"""Native Cholesky factors: narrow and wide supernodes, float32, several at once; the rest is in test_factorize.py."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.linalg import cholesky, cython_blas

from precond_worker.errors import NotPositiveDefinite
from precond_worker.factorization import blas
from precond_worker.factorization.factorize import Analysis
from precond_worker.factorization.modified_cholesky import ModifiedCholesky
from sim_server.simulation import Simulation
from tests.reference import supernodal
from tests.worker.block_matrices import bar_edges, dense_matrix, diagonal_blocks, pattern, spd

SMALL = pattern(27 + 2, bar_edges(2, 2, 2))  # and two nodes by themselves
CUBE = pattern(343, bar_edges(6, 6, 6), np.arange(3))  # its separator is wide enough for LAPACK


@pytest.fixture(scope="module")
def cube():
    """Analysis of the cube and a matrix of it."""
    return Analysis(*CUBE, "supernodal"), spd(*CUBE, seed=1)


def test_it_is_the_dense_factor(cube):
    """Also where LAPACK eliminates. Entries outside the pattern are zero."""
    analysis, values = cube
    width = np.diff(analysis.pattern.super_start)
    assert width.min() == 3 and np.count_nonzero(width > 64) and np.count_nonzero((width > 12) & (width < 64))
    order = analysis.pattern.permutation
    dense = cholesky(dense_matrix(*CUBE, values)[np.ix_(order, order)], lower=True)
    found = supernodal.lower(analysis.pattern, analysis.factorize(values, np.float64))
    assert np.abs(found - dense).max() < 1e-13 * np.abs(dense).max()


def test_it_factorizes_a_beam():
    """A stiffness matrix, whose entries cancel and whose pivots vary."""
    sim = Simulation.load("deploy/scenes/beam.toml", ["object.beam.mesh.bar=[2,2,6]", "solver.preconditioner=none"])
    sim.engine.run(2)
    graph = sim.system.body_pattern(0, sim.world.nodes)
    values = np.array(sim.system.body_values(0, sim.world.nodes))
    matrix = dense_matrix(*graph, values)
    analysis = Analysis(*graph, "supernodal")
    order = analysis.pattern.permutation
    for dtype, error in ((np.float64, 1e-14), (np.float32, 3e-6)):
        lower = supernodal.lower(analysis.pattern, analysis.factorize(values, dtype))
        assert np.abs(lower @ lower.T - matrix[np.ix_(order, order)]).max() < error * np.abs(matrix).max()


def test_a_bad_pivot_in_a_wide_supernode_is_named(cube):
    analysis, values = cube
    node = int(analysis.pattern.permutation[-10]) // 3
    bad = values.copy()
    bad[diagonal_blocks(*CUBE)[node], 2, 2] *= -1
    with pytest.raises(NotPositiveDefinite, match=f"pivot not positive at node {node}, axis z"):
        analysis.factorize(bad)
    again = Analysis(*CUBE, "supernodal").factorize(values)
    assert analysis.factorize(values).tobytes() == again.tobytes()


def test_wide_supernodes_of_an_indefinite_matrix_keep_its_inertia(cube):
    analysis, values = cube
    order, bad = analysis.pattern.permutation, values.copy()
    bad[diagonal_blocks(*CUBE)[order[-60::3] // 3]] *= -1
    matrix = dense_matrix(*CUBE, bad)[np.ix_(order, order)]
    modified = ModifiedCholesky(*CUBE, "supernodal")
    lower = supernodal.lower(modified.pattern, modified.factorize(bad, np.float64))
    negative = int(np.count_nonzero(np.linalg.eigvalsh(matrix) < 0))
    assert modified.remedy == f"{negative} pivots of LDL^T turned positive" and negative > 40
    change = np.linalg.eigvalsh(lower @ lower.T - matrix)
    assert np.count_nonzero(change > 1e-8 * change[-1]) == negative and change[0] > -1e-10 * change[-1]


def test_arithmetic_is_in_the_type_of_the_factor(cube):
    analysis, values = cube
    exact = analysis.factorize(values, np.float64)
    found = analysis.factorize(values, np.float32)
    assert not np.array_equal(found, exact.astype(np.float32))
    assert np.abs(found - exact).max() < 1e-5 * np.abs(exact).max()


@pytest.mark.parametrize("power", [-100, -31, 40, 100])
def test_float32_has_the_same_digits_at_any_scale(power):
    """A is scaled by a power of four before, L by one of two after."""
    single, values = Analysis(*SMALL, "supernodal"), spd(*SMALL, seed=2)
    found = single.factorize(values * 4.0**power, np.float32)
    assert np.array_equal(found, single.factorize(values, np.float32) * np.float32(2.0**power))


def test_what_float32_cannot_tell_from_singular_is_made_in_float64():
    start, columns = SMALL
    rows = np.repeat(np.arange(len(start) - 1), np.diff(start))
    values = np.where((rows == columns)[:, None, None], 0.0, -np.eye(3))
    values[diagonal_blocks(*SMALL)] = (np.diff(start)[:, None, None] - 1 + 1e-6) * np.eye(3)  # of a free body
    analysis = Analysis(*SMALL, "supernodal")
    exact = analysis.factorize(values, np.float64)
    assert np.array_equal(analysis.factorize(values, np.float32), exact.astype(np.float32))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_several_at_once_do_not_disturb_each_other(dtype):
    matrices = [spd(*CUBE, seed=seed) for seed in range(2)]
    analyses = [Analysis(*CUBE, "supernodal") for _ in matrices]
    alone = [a.factorize(m, dtype).tobytes() for a, m in zip(analyses, matrices, strict=True)]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(5):
            together = pool.map(lambda a, m: a.factorize(m, dtype).tobytes(), analyses, matrices)
            assert list(together) == alone


def test_another_interface_of_scipy_is_refused():
    with pytest.raises(ImportError, match="not the one of LAPACK, 10 addresses"):
        blas.address(cython_blas.__pyx_capi__["dgemm"], "d", 10)
    with pytest.raises(ImportError, match="names no float"):
        blas.address(cython_blas.__pyx_capi__["dsyrk"], "s", 10)
