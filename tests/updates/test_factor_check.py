# SPDX-License-Identifier: MIT
"""Factors that are no good are refused before they are used, counted and told once; the one in use stays."""

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from precond_worker.factorization.registry import make_factorization
from protocol.factor import Factor
from protocol.method import Method
from sim_server.simulation import Simulation
from sim_server.updates import checked_body
from sim_server.updates.driver import Driver
from sim_server.updates.factor_check import FactorCheck
from sim_server.updates.factor_source import Inline, Job
from tests.scenes import bar, simulation
from tests.solver.solves import bent, system


def check_of(sim: Simulation, alone: bool = False) -> tuple[FactorCheck, NDArray]:
    body = sim.world.bodies[0]
    pattern = sim.system.body_pattern(body.first, body.last)
    matrix = np.ascontiguousarray(sim.system.body_values(body.first, body.last))
    return FactorCheck({body.name: pattern}, alone), matrix


def made(sim: Simulation, method: Method | None = None, dtype: type = np.float32) -> Factor:
    body = sim.world.bodies[0]
    analysis = make_factorization(*sim.system.body_pattern(body.first, body.last), method)
    values = analysis.factorize(sim.system.body_values(body.first, body.last), dtype)
    return Factor(body.name, 1, 0, True, analysis.pattern, values, "w", 0.1)


def changed(factor: Factor, how: str) -> Factor:
    values, random = factor.values.copy(), np.random.default_rng(3)
    own = factor.pattern.diagonal
    if how == "nan":
        values[len(values) // 2] = np.nan
    elif how == "infinite":
        values[len(values) // 3] = np.inf
    elif how == "zero pivot":
        values[own[-1]] = 0
    elif how == "identity":
        values[:] = 0
        values[own] = 1
    elif how == "random":
        values[:] = random.normal(size=len(values))
        values[own] = np.abs(values[own])
    elif how == "shuffled":
        random.shuffle(values)
        values[own] = np.abs(values[own])
    elif how == "some flipped":
        values[random.random(len(values)) < 0.02] *= -1000
    elif how == "one pivot tiny":
        values[own[-1]] *= 1e-12
    return dataclasses.replace(factor, values=values)


GOOD = [
    Method(), Method("incomplete_cholesky"), Method("incomplete_cholesky", drop_tolerance=0.005),
    Method("incomplete_cholesky", drop_tolerance=0.1), Method("ssor"), Method("ssor", omega=1.5),
]  # fmt: skip
BAD = ["nan", "infinite", "zero pivot", "identity", "random", "shuffled", "some flipped", "one pivot tiny"]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("method", GOOD, ids=lambda m: f"{m.name} {m.drop_tolerance} {m.omega}")
@pytest.mark.parametrize("seed", [0, 1])
def test_good_ones_pass(method, dtype, seed):
    sim = bent(seed)
    check, matrix = check_of(sim)
    factor = made(sim, method, dtype)
    for scale in (1.0, 1e6, 1e-6):  # the scale of a preconditioner does not matter
        scaled = dataclasses.replace(factor, values=factor.values * dtype(scale))
        assert check.reject_reasons([(scaled, matrix)])[0] == ""
    assert check.reject_reasons([(factor, None)])[0] == ""


@pytest.mark.parametrize("how", BAD)
@pytest.mark.parametrize("method", GOOD[:1] + GOOD[2:3], ids=lambda m: m.name)
def test_bad_ones_do_not(how, method):
    sim = bent()
    check, matrix = check_of(sim)
    words = check.reject_reasons([(changed(made(sim, method), how), matrix)])[0]
    assert "not positive definite or not finite" in words or "worse than block Jacobi" in words
    if how == "identity":
        assert "worse than block Jacobi" in words
    if how in ("nan", "infinite", "zero pivot"):
        assert "not finite" in words
        assert "not finite" in check.reject_reasons([(changed(made(sim, method), how), None)])[0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_that_is_to_take_the_place_of_the_matrix_is_its_factor(dtype):
    """What may precondition may not do alone: a scale, a wrong sign, what an incomplete factor leaves out."""
    sim = bent()
    check, matrix = check_of(sim, alone=True)
    good = made(sim, dtype=dtype)
    assert check.reject_reasons([(good, matrix)])[0] == ""
    assert check.probe(good, matrix).residual < (1e-3 if dtype == np.float32 else 1e-9)
    flipped = good.values.copy()
    flipped[good.pattern.diagonal[-3]] *= -1
    wrong = [dataclasses.replace(good, values=v) for v in (good.values * dtype(1.1), flipped)]
    for factor in (*wrong, made(sim, GOOD[3], dtype)):
        words = check.reject_reasons([(factor, matrix)])[0]
        assert "not that of its matrix: it leaves" in words and "at most 0.05" in words
    regularized = dataclasses.replace(good, values=good.values * dtype(1.1), remedy="shifted")
    assert check.reject_reasons([(regularized, matrix)])[0] == "", "it cannot be"


def several(sim: Simulation, matrix: NDArray) -> list[tuple[Factor, NDArray | None]]:
    """Good and bad factors of several patterns and types, with and without their matrix."""
    good = [made(sim), made(sim, dtype=np.float64), made(sim, GOOD[3]), made(sim, GOOD[2])]
    bad = [changed(factor, how) for how in BAD for factor in good[:3]]
    cut = dataclasses.replace(good[0], values=good[0].values[:-1])
    found: list[tuple[Factor, NDArray | None]] = []
    mixed = [good[0], bad[0], good[0], bad[9], bad[12]]  # of one pattern, which are applied together
    for k, factor in enumerate([*mixed, cut] + [good[1]] * 5 + good + bad[:13] + [good[0]] * 6 + bad[13:] + mixed):
        found.append((factor, None if k % 5 == 3 else matrix))
    return found


@pytest.mark.parametrize(("alone", "helping"), [(False, 0), (False, 3), (True, 3)])
def test_each_of_many_is_judged_as_if_it_came_alone(alone, helping, monkeypatch):
    """To the bit, whatever the number of threads that share them."""
    monkeypatch.setattr(checked_body, "helping_threads", lambda: helping)
    sim = bent()
    check, matrix = check_of(sim, alone)
    many = several(sim, matrix)
    reasons = check.reject_reasons(many)
    assert 10 < sum(map(bool, reasons)) < len(many) - 10
    for each, reason in zip(many, reasons, strict=True):
        assert check_of(sim, alone)[0].reject_reasons([each]) == [reason]
    fitting = [each for each in many if not check.wrong_size(each[0])]
    together, one = check.probe_all(fitting), [check_of(sim)[0].probe(*each) for each in fitting]
    assert np.array(together).tobytes() == np.array(one).tobytes()


class OnDevice:
    """Values that lie on a device."""

    def __init__(self, values: NDArray):
        self._host, self.dtype, self.nbytes, self.read = values, values.dtype, values.nbytes, 0

    def __len__(self) -> int:
        return len(self._host)

    def __array__(self, dtype: type | None = None, copy: bool | None = None) -> NDArray:
        self.read += 1
        return self._host


def test_one_that_somebody_applies_is_judged_by_that_and_its_values_are_not_read():
    sim = bent(1)
    check, matrix = check_of(sim)
    factor = made(sim)
    values = OnDevice(factor.values)
    there, r = dataclasses.replace(factor, values=values), check.vector(factor.object, 1)
    z = np.linalg.solve(sim.matrix().toarray(), r)
    alone, beside = check.probe(factor, matrix), check.probe_all([(there, matrix)], lambda: z)[0]
    np.testing.assert_allclose(beside[:3], alone[:3], rtol=1e-4)
    assert beside.residual < 1e-9 and values.read == 0
    assert check.reject_reasons([(there, matrix)], lambda: z) == [""]
    assert "positive definite" in check.reject_reasons([(there, matrix)], lambda: -z)[0] and values.read == 0
    assert check.probe_all([(there, matrix)], lambda: None)[0] == alone and values.read == 1, "nobody could apply it"


def test_of_another_size():
    sim, other = bent(), simulation(bar((3, 2, 2), name="bar"))
    other.engine.assemble()
    check, matrix = check_of(sim)
    assert "its size is 108, that of the object 162" in check.reject_reasons([(made(other), matrix)])[0]
    factor = made(sim)
    cut = dataclasses.replace(factor, values=factor.values[:-1])
    assert f"it has {len(cut.values)} values" in check.reject_reasons([(cut, matrix)])[0]


def test_the_energy_that_an_iteration_takes_off():
    """The figures in the reason are those of one step of conjugate gradients in NumPy."""
    sim = bent()
    check, matrix = check_of(sim)
    A = system(sim)[0].toarray()
    r = np.random.default_rng(0).standard_normal(len(A))
    own = np.arange(len(A)) // 3
    blocks = np.where(own[:, None] == own, A, 0)

    def taken_off(P: NDArray) -> float:
        z = np.linalg.solve(P, r)
        e = np.linalg.solve(A, r)
        x = (z @ r) / (z @ A @ z) * z
        return float(e @ A @ e - (e - x) @ A @ (e - x))

    for factor, P in ((made(sim, dtype=np.float64), A), (changed(made(sim), "identity"), np.eye(len(A)))):
        zr, reached, block_jacobi, _ = check.probe(factor, matrix)
        assert zr == pytest.approx(r @ np.linalg.solve(P, r), rel=1e-6)
        assert reached == pytest.approx(taken_off(P), rel=1e-6)
        assert block_jacobi == pytest.approx(taken_off(blocks), rel=1e-9)


class Tampering(Inline):
    """Makes factors, some of which are spoilt on the way."""

    bad: dict[int, str]

    def poll(self):
        return [changed(f, self.bad[f.step]) if f.step in self.bad else f for f in super().poll()]


def driven(update: str, bad: dict[int, str]) -> Driver:
    sim = simulation(
        bar((4, 2, 2), young=1e6, fixed="X < 0.01"), gravity=(0, -9.81, 0), preconditioner="cholesky", update=update,
        max_iterations=2000,
    )  # fmt: skip
    source = Tampering({b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies})
    source.bad = bad
    driver = Driver(sim, source)
    driver.inline = source
    return driver


def test_a_bad_one_is_refused_and_the_old_one_stays(caplog):
    driver = driven("lockstep-2", {2: "identity", 6: "nan", 8: "identity"})
    adopted: list[int] = []
    driver.on_adopt.append(lambda factor: adopted.append(factor.step))
    with caplog.at_level(logging.WARNING):
        records = driver.advance(15)
    assert records["factor_step"].tolist() == [-1, -1, 0, 0, 0, 0, 4, 4, 4, 4, 4, 4, 10, 10, 12]
    assert adopted == [0, 4, 10, 12]
    assert (records["status"] == 0).all() and (records["fallbacks"] == 0).all()
    state = driver.bodies[0]
    assert (state.factors.used, state.failures.refused) == (4, 3)
    assert "worse than block Jacobi" in state.failures.reason
    told = [r.getMessage() for r in caplog.records]
    assert len(told) == 2, "each cause once"
    assert "object 'bar': no factor: that of in process is not used: worse than block Jacobi" in told[0]
    assert "not positive definite or not finite (z.r = nan" in told[1]


@pytest.mark.parametrize("update", ["never", "every-1", "async"])
def test_with_none_but_bad_ones_it_is_block_jacobi(update):
    plain = simulation(
        bar((4, 2, 2), young=1e6, fixed="X < 0.01"), gravity=(0, -9.81, 0), preconditioner="block_jacobi",
        max_iterations=2000,
    )  # fmt: skip
    plain.engine.run(10)
    driver = driven(update, dict.fromkeys(range(20), "random"))
    records = driver.advance(10)
    assert (records["factor_step"] == -1).all()
    assert driver.bodies[0].failures.refused >= 1 and driver.bodies[0].factors.used == 0
    assert np.array_equal(driver.simulation.world.x, plain.world.x)


def test_the_copy_of_a_matrix_is_kept_until_its_factor_came(monkeypatch):
    """It is what the factor is judged by; then its memory serves again, so that none is added in the long run."""
    driver = driven("async", {})
    seen: list[tuple[int, bool]] = []
    places: set[int] = set()
    reject_reasons = driver.check.reject_reasons

    def looked(checked: Sequence[tuple[Factor, NDArray | None]], *applied: None) -> list[str]:
        for factor, matrix in checked:
            values = matrix if matrix is not None else np.zeros(1)
            fresh = made_of(driver, values) if matrix is not None else None
            places.add(values.ctypes.data)
            seen.append((factor.step, fresh is not None and np.array_equal(fresh, factor.values)))
        return reject_reasons(checked, *applied)

    monkeypatch.setattr(driver.check, "reject_reasons", looked)
    driver.advance(20)
    assert len(seen) > 5 and all(same for _, same in seen)
    assert len(places) <= 2


def made_of(driver: Driver, values: NDArray) -> NDArray:
    body = driver.simulation.world.bodies[0]
    analysis = make_factorization(*driver.simulation.system.body_pattern(body.first, body.last))
    return analysis.factorize(values, np.float32)


def test_a_job_that_fails_again_and_again_is_told_once(caplog):
    driver = driven("async", {})
    submit = driver.inline.submit
    driver.inline.submit = lambda job: submit(Job(job.object, 1, job.step, True, np.nan * job.values))  # type: ignore[method-assign]
    with caplog.at_level(logging.WARNING):
        driver.advance(40)
    assert driver.bodies[0].failures.refused > 2
    assert len(caplog.records) == 1
