# SPDX-License-Identifier: MIT
"""Binary digits of large factors, estimated on the device, beside the host's estimate."""

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.gpu.inverse.digits import MOST_RESPONSE, largest_responses
from tests.worker.block_matrices import bar_edges, pattern, spd

pytestmark = pytest.mark.gpu


@pytest.fixture(scope="module")
def gpu():
    from sim_server.backends.gpu.device import Gpu
    from sim_server.errors import DeviceError

    try:
        return Gpu()
    except DeviceError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("library", ["supernodal", "gpu"])
@pytest.mark.parametrize("cells", [(3, 3, 10), (6, 6, 30)])
def test_it_is_the_hosts_and_repeats_to_the_bit(gpu, cells, library):
    from sim_server.backends.gpu.inverse.device_digits import DeviceDigits, LargeFactors
    from sim_server.backends.gpu.inverse.workspace import workspace

    nodes = int(np.prod(np.add(cells, 1)))
    graph = pattern(nodes, bar_edges(*cells), np.arange((cells[0] + 1) * (cells[1] + 1)))
    analysis = Analysis(*graph, library)
    values = analysis.factorize(spd(*graph, seed=1), np.float32).reshape(-1)
    stream, large = workspace(0).stream, LargeFactors(gpu)
    there = large.brought(values)
    digits = DeviceDigits(gpu, analysis.pattern)
    found = {digits.largest_response(there, stream, most) for most in (1, 8, 132) for _ in range(3)}
    assert len(found) == 1
    expected = float(largest_responses(analysis.pattern, [values])[0])
    assert found.pop() == pytest.approx(expected, rel=1e-3)
    np.testing.assert_array_equal(np.asarray(there), values)
    for multiprocessors in (8, None):
        planes = large.planes_for(analysis.pattern, there, multiprocessors)
        assert large.brought(there) is there and planes == (1 if expected <= MOST_RESPONSE else 2)


def test_an_inverse_is_the_same_from_the_device_and_from_the_host(gpu):
    from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder
    from sim_server.backends.gpu.inverse.device_digits import LargeFactors
    from sim_server.backends.gpu.inverse.plan import plan

    graph = pattern(6 * 6 * 21, bar_edges(5, 5, 20), np.arange(36))
    analysis = Analysis(*graph)
    values = analysis.factorize(spd(*graph, seed=1), np.float32)
    builder = InverseBuilder(gpu, analysis.pattern, plan(analysis.pattern, 132))
    chunks = []
    for source in (values, LargeFactors(gpu).brought(values)):
        storage = builder.storage()
        builder.build(source, storage).event.synchronize()
        chunks.append(storage.matrix.get())
    np.testing.assert_array_equal(*chunks)
