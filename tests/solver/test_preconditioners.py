# SPDX-License-Identifier: MIT
"""Every preconditioner as an operator: formed by applying it to unit vectors, compared with its formula in NumPy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from precond_worker.factorization.registry import make_factorization
from protocol.method import Method
from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from tests.scenes import bar, rotation, simulation
from tests.solver.solves import applied, bent, solve, system, true_residual

INCOMPLETE = Method("incomplete_cholesky", drop_tolerance=0.02)
WORKERS = {
    "cholesky": Method(),
    "incomplete_cholesky": INCOMPLETE,
    "incomplete, little kept": Method("incomplete_cholesky", drop_tolerance=0.3),
    "incomplete, bounded": Method("incomplete_cholesky", fill=0.5),
    "ssor": Method("ssor", omega=1.0),
    "ssor 1.4": Method("ssor", omega=1.4),
}
IN_LOOP = [Kind.NONE, Kind.JACOBI, Kind.BLOCK_JACOBI, Kind.SSOR]


def posted(sim: Simulation, method: Method, source: Simulation | None = None, dtype: type = np.float64) -> None:
    """A factor of the matrix of `source` (the same simulation by default), put into the mailbox."""
    pattern, values = made(source or sim, method, dtype)
    sim.engine.post_factor(0, pattern, values, 0)


def made(sim: Simulation, method: Method, dtype: type = np.float64):
    b = sim.world.bodies[0]
    analysis = make_factorization(*sim.system.body_pattern(b.first, b.last), method)
    values = analysis.factorize(sim.system.body_values(b.first, b.last), dtype)
    analysis.pattern.check()
    return analysis.pattern, values


def operator(apply, n: int) -> NDArray:
    return np.column_stack([apply(e) for e in np.eye(n)])


def symmetric_positive_definite(P: NDArray) -> None:
    assert np.abs(P - P.T).max() < 1e-10 * np.abs(P).max()
    assert np.linalg.eigvalsh(0.5 * (P + P.T))[0] > 0


def ssor(A: NDArray, omega: float) -> NDArray:
    """P of the block SSOR preconditioner (Saad, 2nd edition, section 10.2)."""
    n = len(A)
    own = np.arange(n) // 3
    D = np.where(own[:, None] == own, A, 0) / omega
    lower = np.where(own[:, None] > own, A, 0)
    return (D + lower) @ np.linalg.inv(D) @ (D + lower).T * omega / (2 - omega)


def by_loop(sim: Simulation, kind: Kind, b: NDArray) -> NDArray:
    """P^-1 b as the loop applies it, up to a factor: the direction of the first iteration, started from zero."""
    sim.system.b_material[:] = b.reshape(-1, 3)
    y, record = solve(sim, kind=kind, max_iterations=1, warm_start=0, tolerance=1e-15)
    assert record["iterations"] == 1
    return y


@pytest.mark.parametrize("method", WORKERS.values(), ids=WORKERS.keys())
def test_what_a_worker_sends_is_symmetric_positive_definite(method):
    sim = bent()
    A, _ = system(sim)
    symmetric_positive_definite(operator(applied(*made(sim, method)), A.shape[0]))


def loop_operator(sim: Simulation, kind: Kind) -> NDArray:
    """P^-1 of the loop up to one positive factor. A column z_j comes as s_j z_j; what the sum of two unit vectors gives
    is a combination of both columns, and tells s_j / s_0."""
    unit = np.eye(3 * sim.world.nodes)
    found = np.column_stack([by_loop(sim, kind, e) for e in unit])
    for j in range(1, len(unit)):
        pair = found[:, [0, j]]
        together = by_loop(sim, kind, unit[0] + unit[j])
        of, left, _, _ = np.linalg.lstsq(pair, together, rcond=None)
        assert left[0] < 1e-20 * (together @ together)
        found[:, j] *= of[1] / of[0]
    return found


def small(turn: NDArray | None = None) -> Simulation:
    """A bar of few nodes off its rest, held at one end; turned as a whole."""
    sim = simulation(bar((3, 1, 1), (1.5, 0.5, 0.5), young=1e6, fixed="X < 0.01"), preconditioner="none", warp=True)
    sim.world.x += 0.03 * np.random.default_rng(4).normal(size=sim.world.x.shape)
    if turn is not None:
        sim.world.x[:] = sim.world.x @ turn.T + [1, 0, -2]
    sim.engine.assemble()
    return sim


@pytest.mark.parametrize("kind", IN_LOOP, ids=[k.name for k in IN_LOOP])
def test_what_the_loop_applies_is_symmetric_positive_definite_and_its_formula(kind):
    sim = small()
    sim.engine.settings(0).omega = 1.3
    A = system(sim)[0].toarray()
    n = len(A)
    own = np.arange(n) // 3
    formula = {
        Kind.NONE: np.eye(n), Kind.JACOBI: np.diag(np.diag(A)),
        Kind.BLOCK_JACOBI: np.where(own[:, None] == own, A, 0), Kind.SSOR: ssor(A, 1.3),
    }[kind]  # fmt: skip
    found, expected = loop_operator(sim, kind), np.linalg.inv(formula)
    symmetric_positive_definite(found)
    scale = np.vdot(found, expected) / np.vdot(found, found)
    assert scale > 0
    assert np.abs(scale * found - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("kind", [Kind.JACOBI, Kind.BLOCK_JACOBI, Kind.SSOR], ids=lambda k: k.name)
def test_what_the_loop_applies_turns_with_the_body(kind):
    """In the material frame the operator is the same, up to rounding."""
    here, turned = (loop_operator(small(R), kind) for R in (None, rotation((1, 2, -1), 2.0)))
    here, turned = here / np.abs(here).max(), turned / np.abs(turned).max()
    assert np.abs(here - turned).max() < 1e-9


@pytest.mark.parametrize("omega", [0.6, 1.0, 1.4])
def test_the_ssor_factor_is_the_formula(omega):
    sim = bent()
    A, _ = system(sim)
    inverse = operator(applied(*made(sim, Method("ssor", omega=omega))), A.shape[0])
    expected = np.linalg.inv(ssor(A.toarray(), omega))
    assert np.abs(inverse - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("omega", [0.6, 1.0, 1.4])
def test_the_sweeps_of_the_loop_are_the_formula(omega):
    """One step of conjugate gradients from zero: x = (z'r / z'Az) z with z = P^-1 b."""
    sim = bent()
    sim.engine.settings(0).omega = omega
    A, _ = system(sim)
    P, random = ssor(A.toarray(), omega), np.random.default_rng(1)
    for _ in range(3):
        b = random.normal(size=A.shape[0])
        z = np.linalg.solve(P, b)
        expected = (z @ b) / (z @ (A @ z)) * z
        found = by_loop(sim, Kind.SSOR, b)
        assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("omega", [0.8, 1.0, 1.5])
def test_sweeps_and_factor_of_the_same_matrix_take_the_same_iterations(omega):
    sim = bent(tolerance=1e-6)
    sim.engine.settings(0).omega = omega
    sweeps = solve(sim, kind=Kind.SSOR)[1]
    posted(sim, Method("ssor", omega=omega))
    factor = solve(sim, kind=Kind.CHOLESKY)[1]
    assert sweeps["kind"] == Kind.SSOR and sweeps["factor_step"] == -1
    assert factor["kind"] == Kind.CHOLESKY and factor["factor_step"] == 0
    assert abs(int(sweeps["iterations"]) - int(factor["iterations"])) <= 1
    assert sweeps["status"] == factor["status"] == 0


def test_nothing_dropped_is_cholesky():
    sim = bent()
    A, _ = system(sim)
    r = np.random.default_rng(2).normal(size=A.shape[0])
    for method in (Method(), Method("incomplete_cholesky")):
        z = applied(*made(sim, method))(r)
        assert np.linalg.norm(A @ z - r) < 1e-10 * np.linalg.norm(r)
        posted(sim, method)
        assert solve(sim, kind=Kind.CHOLESKY, tolerance=1e-6)[1]["iterations"] == 1


def test_the_better_one_takes_fewer_iterations():
    sim = bent(tolerance=1e-6)
    count = {kind.name: int(solve(sim, kind=kind)[1]["iterations"]) for kind in IN_LOOP}
    for name, method in WORKERS.items():
        posted(sim, method)
        y, record = solve(sim, kind=Kind.CHOLESKY)
        assert record["status"] == 0 and true_residual(sim, y) <= 1e-6
        count[name] = int(record["iterations"])
    assert count["cholesky"] == 1 < count["incomplete_cholesky"] < count["incomplete, little kept"]
    assert count["incomplete_cholesky"] < count["SSOR"] < count["BLOCK_JACOBI"] < count["NONE"]


def free_bar(update: str, **solver) -> Simulation:
    """A bar that nothing holds, set up to be turned."""
    sim = simulation(
        bar((5, 2, 2), (2.5, 1, 1), young=1e7, poisson=0.4), tolerance=1e-8, warm_start=False, max_iterations=2000,
        factor_precision="float64", update=update, **solver,
    )  # fmt: skip
    sim.world.v[:] = np.random.default_rng(0).normal(size=sim.world.v.shape)
    sim.engine.assemble()
    return sim


@pytest.mark.parametrize("kind", [*IN_LOOP, *WORKERS.values()], ids=[*(k.name for k in IN_LOOP), *WORKERS.keys()])
def test_a_turned_body_takes_as_many_iterations(kind):
    """In the material frame, whatever is applied: the matrix is the same there, and so is that of the factor."""
    sim = free_bar("never", preconditioner="cholesky")
    uncertain = [Kind.NONE, Kind.JACOBI, *(WORKERS[name] for name in WORKERS if "incomplete" in name)]
    rounding = kind in uncertain  # it grows to some 10 % of the residual
    if isinstance(kind, Method):
        posted(sim, kind)
        kind = Kind.CHOLESKY
    counts = [int(solve(sim, kind=kind)[1]["iterations"])]
    for axis, angle in (((1, 0, 0), 0.3), ((1, 2, -1), 2.0)):
        R = rotation(axis, angle)
        sim.world.x[:], sim.world.v[:] = sim.world.x @ R.T + [1, -2, 3], sim.world.v @ R.T
        sim.engine.assemble()
        counts.append(int(solve(sim, kind=kind)[1]["iterations"]))
    assert max(counts) - min(counts) <= rounding


@pytest.mark.parametrize(
    "change", [{"dt": 0.03}, {"young": 3e7}, {"damping": (2.0, 0.02)}], ids=["dt", "young", "damping"]
)
def test_a_factor_still_helps_after_a_change_of_parameters(change):
    def of(dt: float = 0.02, young: float = 1e7, damping: tuple = (0.1, 0.0)) -> Simulation:
        sim = simulation(
            bar((5, 2, 2), (2.5, 1, 1), young=young, fixed="X < 0.01", damping=damping), dt=dt, gravity=(0, -9.81, 0),
            preconditioner="cholesky", tolerance=1e-6, warm_start=False, max_iterations=2000,
        )  # fmt: skip
        sim.world.v[:] = np.random.default_rng(0).normal(size=sim.world.v.shape) * sim.world.free[:, None]
        sim.engine.assemble()
        return sim

    before, after = of(), of(**change)
    plain = int(solve(after, kind=Kind.BLOCK_JACOBI)[1]["iterations"])
    for name, share in (("cholesky", 0.5), ("incomplete_cholesky", 0.5), ("ssor", 0.7)):
        posted(after, WORKERS[name], source=before)
        _, record = solve(after, kind=Kind.CHOLESKY)
        assert record["fallbacks"] == 0 and record["status"] == 0
        assert record["iterations"] < share * plain, name
