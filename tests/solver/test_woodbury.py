# SPDX-License-Identifier: MIT
"""Grabs that a factor's matrix did not have: the Woodbury correction of the factor (backends/cpu/native/woodbury.h)."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.cpu import corrections
from sim_server.backends.cpu.factors import NativeFactor
from sim_server.effects.touch import Interaction, Touch
from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, factor_of, rotation, simulation

END = np.array([2.0, 1.0, 0.5])
FREE = {"max_force": 1e30}
EXACT = {"preconditioner": "cholesky", "factor_precision": "float64", "tolerance": 1e-10, "update": "never"}


def touched(woodbury: int = 32, table: dict[str, Any] | None = None, **solver: Any) -> tuple[Simulation, Touch]:
    """A bar at rest, held at one end, and its touch."""
    beam = bar((4, 2, 2), young=1e6, fixed="X < 0.01", touch=FREE, **(table or {}))
    sim = simulation(beam, **({"woodbury": woodbury} | solver))
    touch = sim.effects["touch"]
    assert isinstance(touch, Touch)
    sim.engine.assemble()
    return sim, touch


def spring(sim: Simulation, stiffness: float) -> float:
    """N/m of a spring that adds so many times a free corner's own block to A."""
    return (
        stiffness * float((sim.system.diagonal + sim.system.block[:, [0, 3, 5]].sum(axis=1) / 3)[-1]) / sim.world.dt**2
    )


def grab(sim: Simulation, touch: Touch, stiffness: float, radius: float = 0.0, by: tuple = (0, 0.01, 0)) -> Interaction:
    """Grabs nodes at the end. stiffness: per node, in units of its own block; by: from the end to the target [m]."""
    at = tuple(END)
    target = tuple(END + by)
    distance = np.linalg.norm(sim.world.x - END, axis=1)
    nodes = max(1, int((distance <= radius).sum()))
    return touch.grab("anna", "bar", at, radius, target, nodes * spring(sim, stiffness), 0.0, np.inf)  # type: ignore[arg-type]


def with_factor(sim: Simulation, dtype: Any = np.float64) -> None:
    """A step whose factor is of its own matrix."""
    step = sim.engine.step
    sim.engine.assemble()
    pattern, values = factor_of(sim, dtype=dtype)
    sim.engine.post_factor(0, pattern, values, step)
    sim.engine.solve()
    sim.world.x[:], sim.world.v[:], sim.system.dv[:] = sim.world.rest, 0, 0
    sim.engine.records()


def operator(sim: Simulation) -> NDArray[np.float64]:
    """P^-1 as the next solve has it, (n, n)."""
    sim.engine.assemble()
    n = 3 * sim.world.nodes
    return np.array([sim.engine.precondition(0, e) for e in np.eye(n)]).T


def iterations(sim: Simulation) -> int:
    sim.engine.run(1)
    record = sim.engine.records()[-1]
    assert record["status"] == 0
    return int(record["iterations"])


@pytest.mark.parametrize("stiffness", [1.0, 1e2, 1e4])
@pytest.mark.parametrize("radius", [0.0, 0.6])
def test_the_factor_of_the_matrix_before_is_corrected_to_the_inverse_of_the_one_after(stiffness, radius):
    sim, touch = touched(**EXACT)
    with_factor(sim)
    grabbed = grab(sim, touch, stiffness, radius)
    inverse, A = operator(sim), sim.matrix().toarray()
    assert sim.engine.corrected(0) == len(grabbed.nodes)
    np.testing.assert_allclose(inverse, np.linalg.inv(A), rtol=0, atol=1e-9 * np.abs(inverse).max())
    assert iterations(sim) <= 2

    stale, touch = touched(woodbury=0, **EXACT)
    with_factor(stale)
    grab(stale, touch, stiffness, radius)
    assert iterations(stale) >= 3


@pytest.mark.parametrize("stiffness", [1.0, 1e2])
def test_what_is_let_go_leaves_the_factor_again(stiffness):
    sim, touch = touched(**EXACT)
    sim.engine.run(1)
    held = grab(sim, touch, stiffness, 0.6)
    with_factor(sim)
    operator(sim)
    assert sim.engine.corrected(0) == 0, "the factor has the springs"
    touch.release("anna", held.id)
    sim.world.v[-1] = [0, 0, 1]
    inverse, A = operator(sim), sim.matrix().toarray()
    assert sim.engine.corrected(0) == len(held.nodes)
    np.testing.assert_allclose(inverse, np.linalg.inv(A), rtol=0, atol=1e-8 * np.abs(inverse).max())
    assert iterations(sim) <= 2


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("method", ["cholesky", "incomplete_cholesky", "ssor_factor"])
def test_any_factor_is_corrected_by_the_change_and_stays_positive_definite(method, dtype):
    """Also where it is of another matrix, and where springs come, go and stay at the same time."""
    precision = np.dtype(dtype).name
    sim, touch = touched(preconditioner=method, factor_precision=precision, update="lockstep-40")
    driver, posted = Driver(sim), []
    driver.on_adopt.append(posted.append)
    stays, goes = grab(sim, touch, 3.0), touch.grab("anna", "bar", (2, 0, 0), 0, (2, 0, 0.1), spring(sim, 2.0), 0, 1e9)
    driver.step_with_fresh_factors()
    driver.advance(2)
    touch.release("anna", goes.id)
    came = touch.grab("anna", "bar", (1, 1, 1), 0, (1, 1, 0.9), spring(sim, 50.0), 0, 1e9)
    inverse = operator(sim)
    assert sim.engine.corrected(0) == 2

    factor = NativeFactor(posted[0].pattern, posted[0].values)
    P = np.linalg.inv(np.array([factor.apply(e) for e in np.eye(len(inverse))]).T)
    for held, sign in ((goes, -1), (came, 1)):
        for c in range(3):
            P[3 * held.nodes[0] + c, 3 * held.nodes[0] + c] += sign * sim.world.dt**2 * held.stiffness
    accuracy = 1e-9 if dtype is np.float64 else 1e-4
    np.testing.assert_allclose(inverse, np.linalg.inv(P), rtol=0, atol=accuracy * np.abs(inverse).max())
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=accuracy * np.abs(inverse).max())
    assert np.linalg.eigvalsh((inverse + inverse.T) / 2).min() > 0
    assert stays.nodes[0] not in (goes.nodes[0], came.nodes[0])


def test_the_next_factor_takes_the_place_of_the_correction():
    """Corrected exactly while the factor is of a step before the change; so for the grab and for its end."""
    sim, touch = touched(preconditioner="cholesky", update="lockstep-3", warp=True)
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    driver.advance(4)
    changed, held = sim.engine.step, grab(sim, touch, 10.0, 0.6)
    for phase in range(2):
        corrected = []
        for _ in range(9):
            record = driver.advance(1)[0]
            assert record["status"] == 0
            corrected.append(sim.engine.corrected(0))
            assert corrected[-1] == (len(held.nodes) if record["factor_step"] < changed else 0)
        assert 3 <= corrected.count(len(held.nodes)) <= 5
        if phase == 0:
            changed = sim.engine.step
            touch.release("anna", held.id)


def in_motion(rotate: tuple[float, float, float], **solver: Any) -> tuple[Simulation, list[int]]:
    """A soft bar, spinning and swinging, is grabbed, drawn and let go; iterations of each step. No gravity."""
    R = np.eye(3)
    for axis, angle in zip(np.eye(3), np.deg2rad(rotate), strict=True):
        R = rotation(axis, angle) @ R
    table = {"pose": {"rotate": list(rotate), "translate": [0, 0, 0]}}
    options = {"preconditioner": "cholesky", "update": "lockstep-4", "warp": True} | solver
    sim, touch = touched(table=table, **options)
    w, driver = sim.world, Driver(sim)
    w.v[:] = (w.rest[:, :1] ** 2 * np.array([0.0, 2.0, 1.0])) @ R.T
    counts = [int(driver.advance(1)["iterations"][0]) for _ in range(9)]
    at = w.x[-1] + R @ [1e-3, 2e-3, 1e-3]
    held = touch.grab("anna", "bar", tuple(at), 0.6, tuple(at + R @ [0.1, 0.2, 0]), 4 * spring(sim, 5.0), 0, 1e9)
    counts += [int(driver.advance(1)["iterations"][0]) for _ in range(12)]
    touch.release("anna", held.id)
    return sim, counts + [int(r["iterations"]) for r in driver.advance(12)]


def test_any_pose_takes_as_many_iterations():
    (_, straight), (_, posed) = in_motion((0, 0, 0)), in_motion((40, -20, 70))
    assert np.abs(np.subtract(straight, posed)).max() <= 1
    assert abs(sum(straight) - sum(posed)) <= 3


def test_answers_are_the_same_and_come_sooner():
    (plain, without), (sim, counts) = (
        in_motion((0, 0, 0), woodbury=0, tolerance=1e-9),
        in_motion((0, 0, 0), tolerance=1e-9),
    )
    assert counts[:9] == without[:9]
    assert sum(counts[9:]) < 0.8 * sum(without[9:])
    np.testing.assert_allclose(sim.world.x, plain.world.x, rtol=0, atol=1e-7)
    again, same = in_motion((0, 0, 0), tolerance=1e-9)
    assert same == counts and np.array_equal(again.world.x, sim.world.x)


@pytest.mark.parametrize("solver", [{"preconditioner": "auto"}, {"warp": False}])
def test_beside_what_else_the_solver_does(solver):
    (plain, _), (sim, _) = in_motion((0, 0, 0), woodbury=0, tolerance=1e-9, **solver), in_motion(
        (0, 0, 0), tolerance=1e-9, **solver
    )  # fmt: skip
    np.testing.assert_allclose(sim.world.x, plain.world.x, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("woodbury", "stiffness"), [(3, 1.0), (32, 0.001)])
def test_more_nodes_than_allowed_and_weak_springs_are_left_to_the_iteration(woodbury, stiffness):
    sims = [touched(woodbury=w, **EXACT) for w in (0, woodbury)]
    counts = []
    for sim, touch in sims:
        with_factor(sim)
        assert len(grab(sim, touch, stiffness, 0.6).nodes) > 3
        counts.append(iterations(sim))
        assert sim.engine.corrected(0) == 0
    assert counts[0] == counts[1] > 2


def test_a_spring_at_its_limit_is_no_change_and_counts_again_once_it_gives_way():
    sim, touch = touched(**EXACT)
    with_factor(sim)
    stiff = spring(sim, 10.0)
    held = touch.grab("anna", "bar", tuple(END), 0.0, tuple(END + np.array((0, 0.5, 0))), stiff, 1e-3 * stiff, 1e9)
    for target, corrected in ((0.5, 0), (0.0, 1), (0.5, 0), (0.0, 1)):
        sim.world.x[:], sim.world.v[:], sim.system.dv[:] = sim.world.rest, 0, 0
        touch.move("anna", held.id, tuple(END + np.array((0, target, 0))))
        sim.world.v[-1] = [0, 0, 1e-3]
        assert iterations(sim) <= 2
        assert sim.engine.corrected(0) == corrected


def test_changes_too_long_ago_are_not_guessed(monkeypatch):
    """A factor from before what is remembered is used as it is; the next one is corrected again."""
    monkeypatch.setattr(corrections, "HISTORY", 3)
    sim, touch = touched(**EXACT)
    factors = []
    held = None
    for _ in range(5):  # changes of steps 1 to 4
        sim.engine.assemble()
        factors.append(factor_of(sim))
        sim.engine.solve()
        if held is None:
            held = grab(sim, touch, 5.0)
        else:
            touch.release("anna", held.id)
            held = None
    touch.release("anna", held.id)  # never taken up
    for made, corrected in ((0, 0), (3, 1)):
        sim.engine.post_factor(0, *factors[made], made)
        assert iterations(sim) > 0
        assert sim.engine.factor_step(0) == made and sim.engine.corrected(0) == corrected


def test_several_linearizations_of_another_scheme():
    counts = []
    for woodbury in (0, 32):
        sim, touch = touched(
            woodbury, preconditioner="cholesky", update="never", integrator={"scheme": "bdf2", "linearizations": 5}
        )
        driver = Driver(sim)
        driver.advance(2)
        grab(sim, touch, 50.0, 0.6, by=(0, 0.05, 0))
        records = driver.advance(5)
        assert (records["status"] == 0).all() and (records["linearizations"] > 1).any()
        counts.append(int(records["iterations"].sum()))
    assert counts[1] < 0.7 * counts[0]


def test_without_factors_and_with_the_option_off_nothing_is_corrected():
    corrected = []
    for woodbury, preconditioner in ((32, "cholesky"), (0, "cholesky"), (32, "block_jacobi")):
        sim, touch = touched(woodbury, preconditioner=preconditioner, update="never")
        driver = Driver(sim)
        driver.advance(2)
        grab(sim, touch, 10.0)
        assert driver.advance(3)["iterations"].sum() > 2
        corrected.append(sim.engine.corrected(0))
    assert corrected[0] > 0 and corrected[1:] == [0, 0]


def test_a_gpu_leaves_it_out():
    """No word of refusal, as it is on by default; what a scene asks for in vain is refused."""
    default = touched()[0].scene.solver
    assert default.woodbury > 0
    default.check_device("gpu")
    for option, value in (("preconditioner", "ssor"), ("factor_precision", "float64")):
        with pytest.raises(InputError, match=f"solver.{option}"):
            default.model_copy(update={option: value}).check_device("gpu")


def test_factors_posted_again_at_the_same_steps_are_corrected_alike():
    """Gives factors as a replay does, which requests no matrices."""
    options: dict[str, Any] = {"preconditioner": "cholesky", "update": "lockstep-3", "warp": True}
    sims = [touched(**options) for _ in range(2)]
    (sim, _), (other, _) = sims
    driver, posted, records = Driver(sim), {}, []
    driver.on_adopt.append(lambda factor: posted.setdefault(sim.engine.step, factor))
    for step in range(14):
        if step == 5:
            for each, its in sims:
                each.world.x[:] = sim.world.x
                its.grab(
                    "anna", "bar", tuple(END), 0.6, tuple(END + np.array((0, 0.1, 0))), 20 * spring(sim, 1.0), 0, 1e9
                )
        (record,) = driver.advance(1)
        if step in posted:
            other.engine.post_factor(0, posted[step].pattern, posted[step].values, posted[step].step)
        other.engine.run(1)
        records.append((record["iterations"], sim.engine.corrected(0)))
        assert records[-1] == (other.engine.records()[0]["iterations"], other.engine.corrected(0))
        assert np.array_equal(sim.world.x, other.world.x)
    assert len(posted) > 3 and {corrected for _, corrected in records} > {0}
