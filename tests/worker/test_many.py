# SPDX-License-Identifier: MIT
"""Matrices that are factorized together have the factors of each alone, to the bit; which need a remedy is told."""

from collections.abc import Iterator

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from precond_worker.factorization.modified_cholesky import ModifiedCholesky
from precond_worker.gpu.gpu_factorization import COPIES
from precond_worker.many import GivenMatrices
from precond_worker.symbolic import pivots
from precond_worker.symbolic.blocks import BLOCK, pivot_threshold
from precond_worker.symbolic.pivots import PivotCheck
from protocol.refused import Refused
from tests.reference import multifrontal
from tests.support.worker_gpu import FOUND, WorkerGpu, installed
from tests.worker.block_matrices import GRAPHS, diagonal_blocks, spd

BAR = GRAPHS["bars with fixed nodes"]
DTYPES = [np.float32, np.float64]
MATRICES = [spd(*BAR, seed=seed) for seed in range(6)]


def reference(plan, blocks: np.ndarray, values: np.ndarray, status: np.ndarray) -> None:
    """What the kernels compute, in NumPy. As theirs are, the values are of no use where a matrix has no factor."""
    status[:], values[:] = FOUND, np.nan
    if not np.isfinite(blocks).all():
        status[2] = 1
        return
    try:
        values[:] = multifrontal.factorize(plan, blocks.reshape(-1, 3, 3))
    except np.linalg.LinAlgError:
        status[0] = 5


@pytest.fixture(params=["supernodal", "gpu"])
def analysis(request) -> Iterator[ModifiedCholesky]:
    with installed(WorkerGpu(reference)):
        made = ModifiedCholesky(*BAR, request.param)
        assert made.most >= len(MATRICES) and made.together == (1 if request.param == "supernodal" else made.most)
        yield made


@pytest.mark.parametrize("dtype", DTYPES)
def test_they_are_to_the_bit_those_one_by_one(analysis, dtype):
    one_by_one = [analysis.factorize(matrix, dtype).copy() for matrix in MATRICES]
    for count in (6, 2, 1):
        made = analysis.begin_many(GivenMatrices(MATRICES[:count]), dtype).end()
        assert made.good.tolist() == [True] * count and made.values.dtype == dtype
        assert made.values.tobytes() == b"".join(each.tobytes() for each in one_by_one[:count])


@pytest.mark.parametrize("scale", [-1.0, np.nan])
def test_one_without_a_factor_spoils_no_later_ones(analysis, scale):
    expected = analysis.factorize(MATRICES[1])
    spoilt = analysis.begin_many(GivenMatrices([MATRICES[0], scale * MATRICES[1], MATRICES[2]])).end()
    assert not spoilt.good[1]
    made = analysis.begin_many(GivenMatrices(MATRICES[1:3])).end()
    assert made.good.all() and np.array_equal(made.values[0], expected)


def test_on_the_cpu_one_without_a_factor_costs_the_others_nothing():
    analysis = ModifiedCholesky(*BAR, "supernodal")
    made = analysis.begin_many(GivenMatrices([MATRICES[0], -MATRICES[1], MATRICES[2]])).end()
    assert made.good.tolist() == [True, False, True]
    assert np.array_equal(made.values[2], analysis.factorize(MATRICES[2]))


def test_two_may_be_under_way_on_a_device():
    with installed(WorkerGpu(reference)):
        analysis = ModifiedCholesky(*BAR, "gpu")
        one_by_one = [analysis.factorize(matrix).copy() for matrix in MATRICES]
        begun = [analysis.begin_many(GivenMatrices(MATRICES[k : k + 3])) for k in (0, 3)]
        assert begun[0].beside
        assert np.array_equal([*begun[0].end().values, *begun[1].end().values], one_by_one)


def test_one_whose_pivot_is_rounding_error_is_told_as_when_it_is_alone(analysis):
    """It gets a remedy when it is done alone."""
    singular = np.zeros_like(MATRICES[0])
    singular[diagonal_blocks(*BAR)] = np.eye(3)
    assert analysis.begin_many(GivenMatrices([MATRICES[0], singular])).end().good.tolist() == [True, True]
    singular[diagonal_blocks(*BAR)[3]] = 1 + 1e-12 * np.eye(3)
    good = analysis.begin_many(GivenMatrices([MATRICES[0], singular, MATRICES[1]])).end().good
    assert not good[1]
    analysis.factorize(singular)
    assert analysis.remedy


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("code", ["native", "NumPy"])
def test_pivots_are_judged_by_the_diagonal_of_their_node(dtype, code, monkeypatch):
    """As if entry by entry: each pivot's square is more than the threshold times the largest diagonal entry there."""
    if code == "NumPy":
        monkeypatch.setattr(pivots, "native", lambda: None)
    analysis, blocks = Analysis(*BAR), diagonal_blocks(*BAR)
    check, pattern = PivotCheck(analysis.pattern, blocks), analysis.pattern
    rng, threshold = np.random.default_rng(2), pivot_threshold(dtype)
    values = np.array([analysis.factorize(matrix, dtype) for matrix in MATRICES])
    matrices = np.array(MATRICES)
    for k in range(1, len(values)):  # one pivot about as large as the least that is allowed
        row = int(rng.integers(pattern.size))
        scale = np.abs(matrices[k, blocks[pattern.permutation[row] // BLOCK]].diagonal()).max()
        values[k, pattern.diagonal[row]] = np.sqrt(threshold * scale) * (1 + 1e-3 * (-1) ** k)
    expected = []
    for made, matrix in zip(values, matrices, strict=True):
        entries = np.abs(matrix[blocks].diagonal(axis1=1, axis2=2)).max(axis=1)[pattern.permutation // BLOCK]
        expected.append(bool((made[pattern.diagonal].astype(float) ** 2 > threshold * entries).all()))
    assert check.sound(values, check.scales(matrices.reshape(len(matrices), -1))).tolist() == expected
    assert True in expected[1:] and False in expected
    assert code == "NumPy" or pivots.native() is not None
    values[0, pattern.diagonal[7]] = np.nan
    assert not check.sound(values, check.scales(matrices.reshape(len(matrices), -1)))[0]


def test_a_matrix_of_another_size_is_left_to_be_done_alone(analysis):
    assert analysis.begin_many(GivenMatrices([MATRICES[0], MATRICES[1][:-1]])) is None
    assert analysis.begin_many(GivenMatrices([MATRICES[0][:-1]])) is None


class Spoilt(GivenMatrices):
    def copy_to(self, target):
        target[:] = np.nan
        raise Refused("lost or overwritten", "checksum")

    def addresses(self):
        raise Refused("lost or overwritten", "checksum")


def test_matrices_that_are_found_spoilt_while_they_are_copied_spoil_no_later_ones(analysis):
    """Of a launch of fewer than the plan is of, the other places keep what was there before."""
    whole = analysis.begin_many(GivenMatrices(MATRICES[:4])).end()
    for _ in range(2):  # both executors
        with pytest.raises(Refused, match="overwritten"):
            analysis.begin_many(Spoilt(MATRICES[:3]))
    for _ in range(2):
        made = analysis.begin_many(GivenMatrices(MATRICES[:2])).end()
        assert made.good.all() and np.array_equal(made.values, whole.values[:2])
    assert COPIES[1] == 4, "there are places to spare"
