# SPDX-License-Identifier: MIT
"""Where solves start: extrapolated solutions (mechanics/guess.py)."""

from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from sim_server import simulation as simulations
from sim_server.checkpoint.content import capture
from sim_server.mechanics.guess import Guess
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.resets.going_on import resumed
from tests.scenes import bar, factor_of, simulation

NODES = 45


def guesses(solutions: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is guessed after each of the solutions (count, nodes, 3)."""
    sim = simulation(bar())
    guess = Guess(sim.world, sim.system.dv)
    launch, found = guess.extrapolate(), []
    for solution in solutions:
        sim.system.dv[:] = solution
        launch()
        found.append(guess.next.copy())
    return np.array(found)


@pytest.mark.parametrize("degree", range(5))
def test_polynomials_of_up_to_the_fourth_degree_go_on(degree):
    random = np.random.default_rng(degree)
    curves = [Polynomial(random.normal(size=degree + 1)) for _ in range(3 * NODES)]
    values = np.array([[curve(t) for curve in curves] for t in 0.1 * np.arange(9)]).reshape(-1, NODES, 3)
    np.testing.assert_allclose(guesses(values)[6:-1], values[7:], atol=1e-9)


def test_what_is_noise_stays_near_the_last_solutions():
    """Extrapolation of the fourth degree through noise is wrong by 16 times as much as it."""
    noise = np.random.default_rng(1).normal(size=(200, NODES, 3))
    found = guesses(noise)[10:-1] - noise[11:]
    assert np.sqrt((found**2).mean()) < 1.25 * np.sqrt(((noise[1:] - noise[:-1]) ** 2).mean())


def test_a_jump_is_off_by_less_than_it_once():
    jump = np.zeros((12, NODES, 3))
    jump[6:] = 1
    off = np.abs(guesses(jump) - 1).max(axis=(1, 2))
    assert off[6] < 0.9 and (off[7:] < 1e-9).all()


def test_what_stays_the_same_is_guessed_to_the_bit_and_nothing_infinite_stays():
    same = np.random.default_rng(2).normal(size=(1, NODES, 3))
    assert (guesses(np.repeat(same, 9, axis=0))[6:] == same).all()
    assert (guesses(np.zeros((3, NODES, 3))) == 0).all()
    bad = np.repeat(same, 9, axis=0)
    bad[2, 0, 0] = np.nan
    found = guesses(bad)
    assert np.isfinite(found[3:]).all() and (found[7:] == same).all()
    assert np.isfinite(guesses(1e-200 * same)).all() and np.isfinite(guesses(1e100 * same)).all()


def swinging(**table: Any) -> Simulation:
    beam = bar((8, 2, 2), fixed="X < 0.01", young=3e5, poisson=0.45)
    return simulation(beam, gravity=(0, -9.81, 0), preconditioner="cholesky", update="never", **table)


def run(sim: Simulation, steps: int = 48, every: int = 24) -> NDArray[Any]:
    """Records of steps with factors of up to so many steps before."""
    for step in range(0, steps, every):
        sim.engine.assemble()
        sim.engine.post_factor(0, *factor_of(sim), step=step)
        sim.engine.run(every)
    return np.asarray(sim.engine.records())


def test_iterations_are_saved_and_answers_are_the_same(monkeypatch):
    sim = swinging()
    found = run(sim)
    monkeypatch.setattr(simulations, "make_guess", lambda *given: None)
    other = swinging()
    expected = run(other)
    assert (found["status"] == 0).all() and (expected["status"] == 0).all()
    assert found["iterations"].sum() < 0.8 * expected["iterations"].sum()
    np.testing.assert_allclose(sim.world.x, other.world.x, atol=2e-5)


def test_a_run_goes_on_to_the_bit_from_a_checkpoint():
    sim = swinging()
    driver = Driver(sim)
    driver.advance(7)
    data = capture(sim, driver, "test")
    assert sum(name.endswith((".guess", ".differences")) for name in data.arrays) == 2
    expected, other = driver.advance(5), swinging()
    found = resumed(data.to_bytes(), other).advance(5)
    np.testing.assert_array_equal(found["iterations"], expected["iterations"])
    np.testing.assert_array_equal(other.world.x, sim.world.x)


def test_a_checkpoint_from_before_it_goes_on():
    sim = swinging()
    driver = Driver(sim)
    driver.advance(7)
    data = capture(sim, driver, "test")
    for name in [name for name in data.arrays if name.endswith((".guess", ".differences"))]:
        del data.arrays[name]
    expected, other = driver.advance(9), swinging()
    assert (resumed(data.to_bytes(), other).advance(9)["status"] == 0).all() and len(expected) == 9
    np.testing.assert_allclose(other.world.x, sim.world.x, atol=2e-5)


@pytest.mark.parametrize(
    ("table", "wanted"),
    [({}, True), ({"warm_start": False}, False), ({"on_runaway": "halve"}, True),
     ({"integrator": {"scheme": "ros2"}}, False), ({"integrator": {"linearizations": 4}}, False),
     ({"integrator": {"scheme": "newmark"}}, False)],
)  # fmt: skip
def test_scenes_that_have_it(table, wanted):
    sim = swinging(**table)
    assert (sim.system.guess is not None) is wanted
    assert any(x.name == "guess.extrapolate" for x in sim.step_launches) is wanted
