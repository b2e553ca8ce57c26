# SPDX-License-Identifier: MIT
"""Factors expanded on the device, beside NumPy and the CPU's triangular solves. Runs where there is a GPU."""

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.gpu.inverse.plan import plan
from tests.reference.partitioned import Application, stored
from tests.solver.solves import applied
from tests.worker.block_matrices import bar_edges, pattern, spd

pytestmark = pytest.mark.gpu
SMALL, MIDDLE = (3, 3, 10), (5, 5, 20)  # cells of a bar


@pytest.fixture(scope="module")
def gpu():
    from sim_server.backends.gpu.device import Gpu
    from sim_server.errors import DeviceError

    try:
        return Gpu()
    except DeviceError as error:
        pytest.skip(str(error))


def factor(cells, seed=0):
    """Pattern of L, its values in float32, and a way to change them."""
    nodes = int(np.prod(np.add(cells, 1)))
    graph = pattern(nodes, bar_edges(*cells), np.arange((cells[0] + 1) * (cells[1] + 1)))
    analysis = Analysis(*graph)
    return analysis.pattern, analysis.factorize(spd(*graph, seed=seed), np.float32)


def expanded(gpu, shape, values, p, multiprocessors=None):
    """Chunks and scale, on the host."""
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder

    expansion = InverseBuilder(gpu, shape, p)
    target = expansion.target()
    made = expansion.build(values, target, multiprocessors)
    made.event.synchronize()
    assert (made.matrix, made.scale) == (target.matrix.data.ptr, target.scale.data.ptr)
    return target.matrix.get(), target.scale.get()


@pytest.mark.parametrize("groups", [1, 2, 3, 4])
@pytest.mark.parametrize("cells", [SMALL, MIDDLE])
def test_chunks_are_those_of_numpy(gpu, cells, groups):
    """A number between two float16 may be rounded either way: one unit of the last place, at most 2^-11 below 1."""
    shape, values = factor(cells)
    for blocks, planes in ((16, 1), (132, 2)):
        p = plan(shape, blocks, groups, planes)
        (chunks, scale), (exact, lengths) = expanded(gpu, shape, values, p), stored(shape, values, p, np.float16)
        np.testing.assert_allclose(scale, lengths, rtol=1e-5)
        if planes == 1:
            allowed = 2.0**-10 * np.abs(exact).astype(float) + 2.0**-20
            assert (np.abs(chunks.astype(float) - exact) <= allowed).all()
        assert np.array_equal(chunks == 0, exact == 0) or planes == 2


@pytest.mark.parametrize(("planes", "bound"), [(1, 2.0**-9), (2, 1e-5)])
@pytest.mark.parametrize("groups", [1, 2, 3])
def test_it_applies_as_the_triangular_solves_do(gpu, groups, planes, bound):
    shape, values = factor(MIDDLE, seed=1)
    p = plan(shape, 132, groups, planes)
    r = np.random.default_rng(0).normal(size=shape.size)
    z = Application(p, *expanded(gpu, shape, values, p))(r)
    expected = applied(shape, values)(r)
    assert np.linalg.norm(z - expected) <= bound * np.linalg.norm(expected)


def test_few_multiprocessors_make_the_same_bits(gpu):
    shape, values = factor(MIDDLE)
    p = plan(shape, 132, 2)
    (all_chunks, all_scale), (chunks, scale) = (expanded(gpu, shape, values, p, limit) for limit in (None, 3))
    assert np.array_equal(all_chunks.view(np.uint16), chunks.view(np.uint16)) and np.array_equal(all_scale, scale)


def test_the_scale_ends_with_its_largest(gpu):
    shape, values = factor(SMALL)
    expansion_scale = expanded(gpu, shape, values, plan(shape, 16, 2))[1]
    assert expansion_scale[-1] == expansion_scale[:-1].max() > 0


def test_fifty_in_a_row_allocate_nothing_and_end_with_the_last(gpu):
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder

    shape, first = factor(SMALL)
    second = factor(SMALL, seed=5)[1]
    other = factor(MIDDLE)
    p = plan(shape, 16, 2)
    expansion = InverseBuilder(gpu, shape, p)
    larger = InverseBuilder(gpu, other[0], plan(other[0], 132, 1))  # moves the workspace that both use
    targets, large = [expansion.target() for _ in range(3)], larger.target()
    expansion.build(first, targets[0])
    larger.build(other[1], large)
    pool = gpu.cp.get_default_memory_pool()
    used, held = pool.used_bytes(), pool.total_bytes()
    for k in range(50):
        made = expansion.build(second if k % 2 else first, targets[k % 3])
    made.event.synchronize()
    assert (pool.used_bytes(), pool.total_bytes()) == (used, held)
    for k in (48, 49):
        chunks, scale = expanded(gpu, shape, second if k % 2 else first, p)
        assert np.array_equal(targets[k % 3].matrix.get(), chunks)
        assert np.array_equal(targets[k % 3].scale.get(), scale)


def test_another_expansion_may_make_the_workspace_grow(gpu):
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder

    shape, values = factor(SMALL)
    expansion = InverseBuilder(gpu, shape, plan(shape, 16, 2))
    target = expansion.target()
    expansion.build(values, target).event.synchronize()
    before = target.matrix.get()
    space = expansion._workspace
    space.reserve(space.memory.nbytes + 1024, space.incoming.nbytes + 1024)
    target.matrix.fill(0)
    expansion.build(values, target).event.synchronize()
    assert np.array_equal(target.matrix.get(), before)
