# SPDX-License-Identifier: MIT
"""Solves of a GPU that go on with a smoothed factor (smoothing_state.cuh), beside the CPU's."""

import ctypes as c

import numpy as np
import pytest

from sim_server.backends.compiler import SOURCES
from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import SOLVE, Solver, compiled
from tests.scenes import bar, simulation

AFTER, BROKEN = 8, 3.0  # SMOOTH_AFTER; a weight with which a smoothed factor is not positive definite
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


def falling() -> Simulation:
    """A beam whose soft end is let go."""
    body = bar((10, 3, 3), (2, 0.6, 0.6), fixed="X < 0.01", damping=(0.1, 0.0))
    body["effects"]["corotational"]["young"] = [{"where": "X < 1", "young": 5e6}, {"young": 2e3}]
    return simulation(
        body, gravity=(0, -9.81, 0), dt=0.03, preconditioner="cholesky", update="never", max_iterations=2000
    )


class SmoothedSolver(Solver):
    """One that solves with both kernels, after so many steps with a factor of the matrix of the first one.

    slow: what solves find of those before, and leave
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, smooth: c.CDLL, blocks: int, steps: int = 12):
        super().__init__(falling(), monkeypatch, blocks=blocks)
        self.smooth, self.slow, self.unfinished = smooth, np.full(1, -1, np.int64), np.full(1, -1, np.int64)
        for name in ("slow", "unfinished"):
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
    assert solver.goes_on and solver.slow[0] == 0 and AFTER < first < without
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


def test_where_smoothing_does_not_help_the_factor_alone_does(library, monkeypatch, tmp_path):
    text = (SOURCES / "backends/gpu/smoothing_state.cuh").read_text()
    assert "SMOOTH_WEIGHT = 0.5" in text
    (tmp_path / "smoothing_state.cuh").write_text(text.replace("SMOOTH_WEIGHT = 0.5", f"SMOOTH_WEIGHT = {BROKEN}"))
    solver = SmoothedSolver(monkeypatch, compiled(tmp_path, SMOOTH), 3)
    assert solver.iterations(library) > AFTER and solver.goes_on and solver.slow[0] == -2
    solver.iterations(library)
    assert not solver.goes_on and solver.slow[0] == -2
