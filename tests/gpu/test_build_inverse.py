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

    builder = InverseBuilder(gpu, shape, p)
    storage = builder.storage()
    made = builder.build(values, storage, multiprocessors)
    made.event.synchronize()
    assert (made.matrix, made.scale) == (storage.matrix.data.ptr, storage.scale.data.ptr)
    return storage.matrix.get(), storage.scale.get()


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


@pytest.mark.parametrize("planes", [1, 2])
@pytest.mark.parametrize("groups", [1, 2, 3, 4])
def test_one_application_beside_the_steps_is_that_of_the_solver(gpu, groups, planes):
    from sim_server.backends.gpu.inverse.apply_inverse import InverseApplication
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder

    shape, values = factor(MIDDLE, seed=1)
    p = plan(shape, 132, groups, planes)
    builder = InverseBuilder(gpu, shape, p)
    storage = builder.storage()
    made = builder.build(values, storage)
    application = InverseApplication(gpu, p)
    chunks, scale = expanded(gpu, shape, values, p)
    for seed in range(3):
        r = np.random.default_rng(seed).normal(size=shape.size)
        z = application.begin(made.matrix, made.scale, r, builder._workspace.stream, 132 if seed else 1).result()
        expected = Application(p, chunks, scale)(r)
        assert np.linalg.norm(z - expected) <= 1e-5 * np.linalg.norm(expected)


def test_few_multiprocessors_make_the_same_bits(gpu):
    shape, values = factor(MIDDLE)
    p = plan(shape, 132, 2)
    (all_chunks, all_scale), (chunks, scale) = (expanded(gpu, shape, values, p, limit) for limit in (None, 3))
    assert np.array_equal(all_chunks.view(np.uint16), chunks.view(np.uint16)) and np.array_equal(all_scale, scale)


@pytest.mark.parametrize("count", [1, 3])
def test_values_in_pinned_memory_make_the_same_bits(gpu, count):
    """They are copied by the device itself; their memory may be given up, and used again, before that."""
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder
    from sim_server.backends.gpu.pinned import PinnedArray, pinned_array

    shape, values = factor(MIDDLE)
    p = plan(shape, 132, 2)
    chunks, scale = expanded(gpu, shape, values, p)
    builder = InverseBuilder(gpu, shape, p)
    storage = builder.storage()
    for _ in range(count):
        pinned = pinned_array(gpu.cp, len(values), np.dtype(np.float32))
        pinned[:] = values
        assert isinstance(pinned, PinnedArray)
        made = builder.build(pinned, storage)
        del pinned
        pinned_array(gpu.cp, len(values), np.dtype(np.float32))[:] = 3  # other memory, as long as the copy lasts
    made.event.synchronize()
    assert np.array_equal(storage.matrix.get().view(np.uint16), chunks.view(np.uint16))
    assert np.array_equal(storage.scale.get(), scale)


def test_the_scale_ends_with_its_largest(gpu):
    shape, values = factor(SMALL)
    scale = expanded(gpu, shape, values, plan(shape, 16, 2))[1]
    assert scale[-1] == scale[:-1].max() > 0


def test_fifty_in_a_row_allocate_nothing_and_end_with_the_last(gpu):
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder

    shape, first = factor(SMALL)
    second = factor(SMALL, seed=5)[1]
    other = factor(MIDDLE)
    p = plan(shape, 16, 2)
    builder = InverseBuilder(gpu, shape, p)
    larger = InverseBuilder(gpu, other[0], plan(other[0], 132, 1))  # moves the workspace that both use
    storages, large = [builder.storage() for _ in range(3)], larger.storage()
    builder.build(first, storages[0])
    larger.build(other[1], large)
    pool = gpu.cp.get_default_memory_pool()
    used, held = pool.used_bytes(), pool.total_bytes()
    for k in range(50):
        made = builder.build(second if k % 2 else first, storages[k % 3])
    made.event.synchronize()
    assert (pool.used_bytes(), pool.total_bytes()) == (used, held)
    for k in (48, 49):
        chunks, scale = expanded(gpu, shape, second if k % 2 else first, p)
        assert np.array_equal(storages[k % 3].matrix.get(), chunks)
        assert np.array_equal(storages[k % 3].scale.get(), scale)


def test_another_build_may_make_the_workspace_grow(gpu):
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder

    shape, values = factor(SMALL)
    builder = InverseBuilder(gpu, shape, plan(shape, 16, 2))
    storage = builder.storage()
    builder.build(values, storage).event.synchronize()
    before = storage.matrix.get()
    space = builder._workspace
    space.reserve(space.memory.nbytes + 1024, space.incoming.nbytes + 1024)
    storage.matrix.fill(0)
    builder.build(values, storage).event.synchronize()
    assert np.array_equal(storage.matrix.get(), before)


@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize(("groups", "planes", "limit"), [(1, 1, None), (2, 1, 3), (3, 2, 5)])
def test_several_at_a_time_have_the_bits_of_each_alone(gpu, groups, planes, limit, pinned):
    """Whatever their number: graphs are made for 1, 4, 16 and 64, and what they leave over is not touched. pinned: most
    of them lie one behind the other in page-locked memory, as those of a message do"""
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder
    from sim_server.backends.gpu.pinned import is_pinned, pinned_array

    factors = [factor(SMALL, seed) for seed in range(21)]
    shape, values = factors[0][0], [each[1] for each in factors]
    p = plan(shape, 4, groups, planes)
    alone = [expanded(gpu, shape, each, p, limit) for each in values]
    if pinned:
        rows = pinned_array(gpu.cp, len(values) * len(values[0]), np.dtype(np.float32)).reshape(len(values), -1)
        order = [0, 1, 2, 4, 3, *range(5, 21)]
        rows[order] = values
        values = [rows[place] for place in order]
        assert all(is_pinned(each) for each in values)
    builder = InverseBuilder(gpu, shape, p, 64)
    assert builder.most == 64
    for count in (1, 2, 4, 5, 21):
        storages = builder.several_storages(22) if pinned else [builder.storage() for _ in range(22)]
        builder.build_many(values[:count], storages[:count], limit).synchronize()
        for storage, (chunks, scale) in zip(storages[:count], alone, strict=False):
            assert storage.target == (storage.matrix.data.ptr, storage.scale.data.ptr)
            assert np.array_equal(storage.matrix.get().view(np.uint16), chunks.view(np.uint16))
            assert np.array_equal(storage.scale.get(), scale)
        assert not any(storage.scale.get().any() for storage in storages[count:])


def test_as_many_at_a_time_as_fit_into_the_workspace(gpu):
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder
    from sim_server.backends.gpu.inverse.expansion_batches import WORKSPACE

    shape, values = factor(MIDDLE)
    builder = InverseBuilder(gpu, shape, plan(shape, 132, 1), 64)
    assert 1 < builder.most < 64 and builder.most * builder._layout.size <= WORKSPACE
    storages = [builder.storage() for _ in range(builder.most)]
    builder.build_many([values] * builder.most, storages, None).synchronize()
    chunks = expanded(gpu, shape, values, builder.plan)[0]
    assert all(np.array_equal(storage.matrix.get().view(np.uint16), chunks.view(np.uint16)) for storage in storages)
