# SPDX-License-Identifier: MIT
"""Bodies of one thread block each, on threads of the processor: they exchange nothing, and read half of A."""

import numpy as np
import pytest

from sim_server.backends.gpu import row_partition
from sim_server.backends.gpu.row_partition import ROW_RANGE
from tests.backends.pcg_on_threads import SOLVE, Solver, compiled, steps
from tests.backends.test_gpu_correction import grabbed, hold
from tests.scenes import bar, simulation


@pytest.fixture(scope="module", params=[8, 4])  # rows of a slab for each warp: of up to eight warps, and of more
def library(request, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(row_partition, "warp_rows", lambda warps: request.param)
        yield compiled(tmp_path_factory.mktemp("alone"), SOLVE, "ALONE", f"WARP_ROWS={request.param}")


def solved(library, monkeypatch, shared: int | None = None, window: int | None = None):
    """Solutions of a few steps, the last ones with a factor."""
    beam = bar((1, 1, 24), young=1e6, fixed="Z < 0.01")
    sim = simulation(beam, gravity=(0, -9.81, 0), preconditioner="cholesky", update="never", tolerance=1e-10)
    solver = Solver(sim, monkeypatch, alone=True)
    ranges = solver.solver._work["row_ranges"].view(ROW_RANGE)
    if window is not None:
        ranges["window"] = window
    if shared is not None:
        solver.solver.params["shared"] = shared
    found = []
    for step in range(3):
        ours, theirs = solver.solve(library)
        assert ours["status"] == 0 and abs(int(ours["iterations"]) - int(theirs["iterations"])) <= 2
        assert solver.error < 1e-6
        found.append(solver.gpu.twin(solver.arrays["y"]).copy())
        if step == 1:
            solver.post(solver.matrix, step)
    return np.array(found), ranges


def test_a_window_of_the_matrix_serves_as_well_as_the_whole(library, monkeypatch):
    """To the bit: with all of A's upper triangle in shared memory, and with the rows that a slab needs."""
    whole, ranges = solved(library, monkeypatch)
    part, _ = solved(library, monkeypatch, shared=int(ranges["window"][0]) * 72 + 16_000)
    none, _ = solved(library, monkeypatch, window=0)
    assert np.array_equal(whole, part)
    np.testing.assert_allclose(none, whole, rtol=1e-6, atol=1e-12)


def test_corrections_are_those_of_a_cpu(library, monkeypatch):
    """What they exchange is in order without words that are polled."""
    solver = Solver(grabbed(), monkeypatch, near=40, alone=True)
    steps(solver, library, 1, factor_at=0)
    hold(solver.sim, 1e4, 0.0)
    ((ours, theirs),) = steps(solver, library, 1, factor_at=1)
    assert solver.used == 1 and ours <= theirs + 3
