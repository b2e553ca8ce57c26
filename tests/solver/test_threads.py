# SPDX-License-Identifier: MIT
"""Steps on several threads (backends/cpu/native/team.h, factor_plan.h): the same bits as on one."""

import os
import threading
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from protocol.factor import FactorPattern
from sim_server.backends.cpu import processors
from sim_server.backends.cpu.factors import SHARED_SIZE, NativeFactor, NativePattern
from sim_server.simulation import Simulation
from tests.scenes import bar, factor_of, simulation

THREADS = (1, 2, 3, 4)  # also more than there are processors
CELLS = (14, 6, 6)
QUOTA, PERIOD = "cpu.cfs_quota_us", "cpu.cfs_period_us"


def factor(dtype: Any = np.float32, *objects: dict) -> tuple[FactorPattern, NDArray[Any]]:
    """Of a bar that is large enough to be shared, or of others."""
    sim = simulation(*(objects or (bar(CELLS, fixed="X < 0.01"),)), gravity=(0, -9.81, 0))
    sim.engine.assemble()
    return factor_of(sim, dtype=dtype)


def applied(pattern: NativePattern, values: NDArray[Any], r: NDArray[np.float64], threads: int) -> NDArray[np.float64]:
    return NativeFactor(pattern, np.ascontiguousarray(values)).apply(r, threads)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shared_solves_are_those_of_one_thread(dtype):
    pattern, values = factor(dtype)
    assert pattern.size > SHARED_SIZE
    r = np.random.default_rng(0).normal(size=pattern.size)
    expected = NativeFactor(pattern, values).apply(r)
    found = []
    for threads in THREADS:
        native = NativePattern(pattern, threads)
        assert native.is_shared
        found += [applied(native, values, r, given) for given in (threads, 1, threads)]
    assert all(z.tobytes() == found[0].tobytes() for z in found)
    bound = 1e-10 if dtype == np.float64 else 1e-5
    assert np.linalg.norm(found[0] - expected) < bound * np.linalg.norm(expected)


def test_a_pattern_serves_factors_of_both_types_in_turns():
    pattern, wide = factor(np.float64)
    native, r = NativePattern(pattern, 2), np.random.default_rng(1).normal(size=pattern.size)
    first, narrow = applied(native, wide, r, 2), applied(native, wide.astype(np.float32), r, 2)
    assert applied(native, wide, r, 2).tobytes() == first.tobytes()
    assert 0 < np.abs(narrow - first).max() < 1e-3 * np.abs(first).max()


def forest(trees: int) -> tuple[FactorPattern, NDArray[Any]]:
    """A factor of a matrix of parts that do not touch each other: so many chains of nodes, with a shortcut each."""
    length = 120
    n, rng = trees * length, np.random.default_rng(trees)
    near = [(k, k + 1) for k in range(n - 1) if (k + 1) % length]
    pairs = near + [(t * length, t * length + length // 2) for t in range(trees)]
    dense = {(i, i): 8 * np.eye(3) for i in range(n)}
    for i, j in pairs:
        block = rng.uniform(-1, 1, (3, 3)) / 2
        dense[i, j], dense[j, i] = block, block.T
    keys = sorted(dense)
    start = np.searchsorted([i for i, _ in keys], np.arange(n + 1)).astype(np.int32)
    analysis = Analysis(start, np.array([j for _, j in keys], np.int32))
    return analysis.pattern, analysis.factorize(np.array([dense[k] for k in keys]), np.float64)


@pytest.mark.parametrize("trees", [2, 5])
def test_a_body_of_several_parts_is_shared_too(trees):
    pattern, values = forest(trees)
    r = np.random.default_rng(2).normal(size=pattern.size)
    expected = NativeFactor(pattern, values).apply(r)
    found = [applied(NativePattern(pattern, threads), values, r, threads) for threads in THREADS]
    assert all(z.tobytes() == found[0].tobytes() for z in found)
    np.testing.assert_allclose(found[0], expected, rtol=1e-12, atol=1e-12)


def dense_pattern(n: int, rows_of_first: list[int]) -> FactorPattern:
    """Two supernodes of n columns each; the first one has these rows below it."""
    columns = np.arange(n)
    rows = np.concatenate([columns, np.array(rows_of_first, int), n + columns])
    return FactorPattern.build(np.arange(2 * n), [0, n, 2 * n], [0, n + len(rows_of_first), len(rows)], rows)


def test_one_supernode_above_another_is_cut_into_panels():
    """Wider than a panel, higher than a chunk; the answer is NumPy's."""
    n = 330
    pattern = dense_pattern(n, list(range(n, 2 * n, 2)))
    assert NativePattern(pattern, 4).is_shared
    rng = np.random.default_rng(3)
    L = np.zeros((2 * n, 2 * n))
    values, at = np.empty(pattern.nonzeros), 0
    for s in range(2):
        rows = pattern.rows[pattern.row_start[s] : pattern.row_start[s + 1]]
        for k in range(n):
            own = rows[k:]
            L[own, s * n + k] = values[at : at + len(own)] = rng.normal(size=len(own)) / n
            L[s * n + k, s * n + k] = values[at] = 1 + rng.uniform()
            at += len(own)
    r = rng.normal(size=2 * n)
    expected = np.linalg.solve(L.T, np.linalg.solve(L, r))
    for threads in THREADS:
        np.testing.assert_allclose(applied(NativePattern(pattern, threads), values, r, threads), expected, rtol=1e-9)


def test_what_is_no_tree_is_solved_by_one_thread():
    """Rows of a supernode that its parent has not, as in incomplete factors."""
    columns, width = np.arange(1500), 3
    rows = [np.concatenate([columns[k : k + width], columns[k + 3 :: 501]]) for k in range(0, 1500, width)]
    start = np.cumsum([0, *map(len, rows)])
    pattern = FactorPattern.build(columns, np.arange(0, 1501, width), start, np.concatenate(rows))
    assert not NativePattern(pattern, 4).is_shared
    values = np.full(pattern.nonzeros, 0.1)
    values[pattern.diagonal] = 2
    r = np.ones(pattern.size)
    shared, alone = applied(NativePattern(pattern, 4), values, r, 4), NativeFactor(pattern, values).apply(r)
    assert shared.tobytes() == alone.tobytes() and np.isfinite(alone).all()


def test_small_factors_are_not_shared():
    pattern, _ = factor(np.float32, bar((3, 3, 3), fixed="X < 0.01"))
    assert pattern.size < SHARED_SIZE and not NativePattern(pattern, 4).is_shared


def run(threads: int, steps: int, *objects: dict, factors: bool = True, **table: Any) -> tuple[bytes, NDArray[Any]]:
    """State and records after so many steps, with a factor of the first matrix for the first body."""
    sim = simulation(*objects, gravity=(0, -9.81, 0), **table)
    sim.engine.loop.threads = threads
    sim.engine.assemble()
    if factors:
        sim.engine.post_factor(0, *factor_of(sim), step=0)
    sim.engine.solve()
    sim.engine.run(steps - 1)
    return sim.world.x.tobytes() + sim.world.v.tobytes(), sim.engine.records()


SCHEMES: dict[str, Any] = {
    "backward Euler": {}, "Newton": {"integrator": {"linearizations": 3}}, "ros2": {"integrator": {"scheme": "ros2"}},
    "block Jacobi": {"preconditioner": "block_jacobi"}, "SSOR": {"preconditioner": "ssor"},
    "float64": {"factor_precision": "float64"},
}  # fmt: skip


@pytest.mark.parametrize("name", SCHEMES)
def test_a_run_has_the_same_bits_on_any_number_of_threads(name):
    table = {"preconditioner": "cholesky", **SCHEMES[name]}
    body = bar(CELLS, fixed="X < 0.01", damping=(0.1, 0.01))
    first, records = run(1, 4, body, **table)
    assert (records["status"] == 0).all() and ("scheme" in table.get("integrator", {})) != records["iterations"].any()
    for threads in (2, 3):
        state, others = run(threads, 4, body, **table)
        assert state == first
        assert (others["iterations"] == records["iterations"]).all()


def test_large_and_small_bodies_side_by_side_have_the_same_bits():
    objects = [bar(CELLS, fixed="X < 0.01", name="large"), *(bar(name=f"small{k}", fixed="X < 0.01") for k in range(5))]
    first, _ = run(1, 4, *objects, preconditioner="cholesky")
    assert all(run(threads, 4, *objects, preconditioner="cholesky")[0] == first for threads in (2, 3))


def test_two_simulations_at_once_leave_each_other_alone():
    """The team of the process serves one loop at a time; the other one goes on alone."""
    body = bar(CELLS, fixed="X < 0.01")
    expected, _ = run(1, 8, body, preconditioner="cholesky")
    found: list[bytes] = []

    def work() -> None:
        found.append(run(3, 8, body, preconditioner="cholesky")[0])

    side_by_side = [threading.Thread(target=work) for _ in range(3)]
    for thread in side_by_side:
        thread.start()
    for thread in side_by_side:
        thread.join()
    assert found == [expected] * 3


def test_a_child_of_a_process_with_threads_has_its_own():
    """A fork copies no threads; the child's first step makes new ones."""
    pattern, values = factor()
    shared, r = NativeFactor(NativePattern(pattern, 2), values), np.ones(pattern.size)
    expected = shared.apply(r, 2)
    child = os.fork()
    if child == 0:
        os._exit(0 if shared.apply(r, 2).tobytes() == expected.tobytes() else 1)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/a/b\n", {"cpu.max": "max 100000", "a/cpu.max": "250000 100000", "a/b/cpu.max": "max 100000"}, 2.5),
        ("0::/a/b\n", {"a/b/cpu.max": "50000 100000", "a/cpu.max": "400000 100000"}, 0.5),
        ("0::/\n", {}, np.inf),
        ("4:memory:/x\n2:cpu,cpuacct:/x\n", {f"cpu/x/{QUOTA}": "300000", f"cpu/x/{PERIOD}": "100000"}, 3),
        ("2:cpu:/x\n", {f"cpu/x/{QUOTA}": "-1", f"cpu/x/{PERIOD}": "100000"}, np.inf),
    ],
)
def test_limits_of_control_groups_are_read(tmp_path, monkeypatch, own, files, expected):
    for name, text in files.items():
        path = tmp_path / "cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "own").write_text(own)
    monkeypatch.setattr(processors, "CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(processors, "OWN_CGROUPS", tmp_path / "own")
    assert processors.quota() == expected


def test_no_more_threads_than_processors(monkeypatch, caplog):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setattr(processors, "quota", lambda: 1.5)
    assert (processors.usable_threads(1), processors.usable_threads(2)) == (1, 2) and not caplog.messages
    assert processors.usable_threads(8) == 2
    assert caplog.messages == ["solver.threads = 8: this process may use 2 processors, so the step has 2 threads"]
    sim: Simulation = simulation(bar(), threads=8)
    assert sim.engine.loop.threads == 2
