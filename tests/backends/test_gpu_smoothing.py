# SPDX-License-Identifier: MIT
"""Solves of a GPU that go on with a smoothed factor (smoothing_state.cuh), beside the CPU's."""

import ctypes as c

import numpy as np
import pytest
from scipy.sparse import bsr_array

from sim_server.backends.compiler import SOURCES
from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import SOLVE, Solver, SolverHost, compiled
from tests.scenes import bar, simulation

AFTER, TOO_SMALL = 8, 0.5  # SMOOTH_AFTER; an eigenvalue for which a smoothed factor is not positive definite
LENT = 15 << 10  # bytes that an inverse lends to products
SMOOTH = """
#include "smoothed.cu"
extern "C" void smooth(const PcgArguments* s) {
    launch_together(s->grid, THREADS, [&] { smoothed(*s); },
                    {{&memory, sizeof memory}, {shared_memory, sizeof shared_memory},
                     {shared_vector, sizeof shared_vector}});
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("solver"), SOLVE, "SMOOTHED")


@pytest.fixture(scope="module")
def smooth(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("smoothed"), SMOOTH)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> tuple[c.CDLL, c.CDLL]:
    """Both, for which a body of 50 nodes is large, and with inverses that lend memory."""
    text = (SOURCES / "backends/gpu/smoothing_state.cuh").read_text()
    assert "LARGE_NODES = 50000" in text
    folders = [tmp_path_factory.mktemp("large") for _ in range(2)]
    for folder in folders:
        (folder / "smoothing_state.cuh").write_text(text.replace("LARGE_NODES = 50000", "LARGE_NODES = 50"))
    lent = 'extern "C" int lends() { return memory.rows.lent && memory.rows.slabs >= 0; }'
    words = [(SOLVE, "SMOOTHED", f"LENT={LENT}"), (SMOOTH, f"LENT={LENT}")]
    solver, smooth = (compiled(f, text + lent, *defined) for f, (text, *defined) in zip(folders, words, strict=True))
    return solver, smooth


def falling() -> Simulation:
    """A beam whose soft end is let go."""
    body = bar((10, 3, 3), (2, 0.6, 0.6), fixed="X < 0.01", damping=(0.1, 0.0))
    body["effects"]["corotational"]["young"] = [{"where": "X < 1", "young": 5e6}, {"young": 2e3}]
    return simulation(
        body, gravity=(0, -9.81, 0), dt=0.03, preconditioner="cholesky", update="never", max_iterations=2000
    )


class SmoothedSolver(Solver):
    """One that solves with both kernels, after so many steps with a factor of the matrix of the first one.

    slow, largest: what solves find of those before, and leave
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, smooth: c.CDLL, blocks: int, steps: int = 12,
        host: SolverHost | None = None,
    ):  # fmt: skip
        super().__init__(falling(), monkeypatch, blocks=blocks, host=host)
        self.smooth, self.slow, self.unfinished = smooth, np.full(1, -1, np.int64), np.full(1, -1, np.int64)
        self.largest = np.zeros(1)
        for name in ("slow", "unfinished", "largest"):
            self.solver.params[name] = getattr(self, name).ctypes.data
        self.sim.engine.assemble()
        self.post(self.sim.engine.factor_matrix(0).copy(), 0)
        self.sim.engine.run(steps)
        self.counter += steps

    def launched(self, library: c.CDLL) -> None:
        super().launched(library)
        self.goes_on = int(self.unfinished[0]) == int(self.counter[0])
        self.smooth.smooth(c.c_void_p(self.solver.params.ctypes.data))

    def iterations(self, library: c.CDLL, fallbacks: int = 0) -> int:
        """Of a solve, which is right."""
        ours, theirs = self.solve(library)
        assert ours["status"] == theirs["status"] == 0 and self.error < 1e-4
        assert ours["residual"] <= 1e-6 and ours["fallbacks"] == fallbacks
        return int(ours["iterations"])


@pytest.mark.parametrize("blocks", [1, 3])
def test_a_slow_solve_goes_on_and_those_that_follow_begin_so(library, smooth, monkeypatch, blocks):
    plain = SmoothedSolver(monkeypatch, smooth, blocks)
    plain.slow[:] = -2  # with the factor of step 0 nothing is smoothed
    without = plain.iterations(library)
    assert not plain.goes_on and plain.slow[0] == -2
    solver = SmoothedSolver(monkeypatch, smooth, blocks)
    first = solver.iterations(library)
    assert solver.goes_on and solver.slow[0] // 2 == 0 and AFTER < first < without
    second = solver.iterations(library)
    assert solver.goes_on and second < 0.75 * without
    solver.slow[:] = -1
    solver.solver.bodies["probe"] = 100
    assert solver.iterations(library) > 0 and not solver.goes_on  # what is measured is the factor


def test_a_solve_that_needs_little_more_does_not_go_on(library, smooth, monkeypatch):
    solver = SmoothedSolver(monkeypatch, smooth, 3, steps=1)
    solver.iterations(library)
    assert not solver.goes_on and solver.slow[0] == -1
    solver.slow[:] = 0
    assert solver.iterations(library) < 6 and solver.goes_on
    assert solver.slow[0] == -1  # few iterations: the next one begins without


def test_where_smoothing_does_not_help_the_factor_alone_does(library, smooth, monkeypatch):
    solver = SmoothedSolver(monkeypatch, smooth, 3)
    solver.largest[:] = TOO_SMALL
    assert solver.iterations(library) > AFTER and solver.goes_on and solver.slow[0] == -2
    assert solver.largest[0] == 0, "estimated anew"
    solver.iterations(library)
    assert not solver.goes_on and solver.slow[0] == -2


@pytest.mark.parametrize("blocks", [1, 3])
def test_the_largest_eigenvalue_is_estimated_once(library, smooth, monkeypatch, blocks):
    solver = SmoothedSolver(monkeypatch, smooth, blocks)
    solver.iterations(library)
    row_start, columns = solver.sim.system.body_pattern(0, solver.sim.world.nodes)
    n = len(row_start) - 1
    A = bsr_array((solver.matrix, columns, row_start), shape=(3 * n, 3 * n))
    D = solver.matrix[columns == np.repeat(np.arange(n), np.diff(row_start))]
    inverse = bsr_array((np.linalg.inv(D), np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
    largest = float(np.linalg.eigvals((inverse @ A).toarray()).real.max())
    assert 0.85 * largest < solver.largest[0] < 1.1 * largest
    solver.largest[:] *= 0.9
    kept = solver.largest.copy()
    solver.slow[:] = 0
    solver.iterations(library)
    assert solver.goes_on and np.array_equal(solver.largest, kept)


def test_large_bodies_go_on_soon_and_have_as_many_sweeps_as_they_need(large, monkeypatch):
    library, smooth = large
    solver = SmoothedSolver(monkeypatch, smooth, 3)
    solver.slow[:] = -2  # with the factor of step 0 nothing is smoothed
    without = solver.iterations(library)
    assert not solver.goes_on
    solver.slow[:] = -1
    first = solver.iterations(library)
    assert solver.goes_on and first < 0.7 * without and solver.slow[0] == 1  # slow: two sweeps from now on
    second = solver.iterations(library)
    assert solver.goes_on and second < first
    solver.post(solver.matrix, int(solver.counter[0]) - 1)  # a factor that is one step old: few iterations, one sweep
    solver.iterations(library)
    assert solver.goes_on and solver.slow[0] == 2 * (int(solver.counter[0]) - 2)
    solver.solver.bodies["tolerance"], solver.solver.bodies["warm_start"] = 0.1, 0
    ours, _ = solver.solve(library)
    assert ours["iterations"] == 1 and solver.slow[0] == -1, "hardly anything to do: without again"


def test_rows_pass_through_memory_that_the_inverse_lends(large, monkeypatch):
    """Where nothing else is left for them: as if there were enough."""
    found = []
    for memory in (128 << 10, 36 << 10):
        host = SolverHost()
        host.properties["sharedMemPerMultiprocessor"] = memory
        solver = SmoothedSolver(monkeypatch, large[1], 3, host=host)
        iterations = [solver.iterations(large[0]) for _ in range(3)]
        found.append((iterations, solver.gpu.twin(solver.arrays["y"]).copy()))
        assert [library.lends() for library in large] == [memory < 128 << 10] * 2
    (enough, y), (lent, same) = found
    assert lent == enough and np.allclose(y, same, rtol=1e-9, atol=1e-12)
