# SPDX-License-Identifier: MIT
"""One step of the Rosenbrock-W method against its formulas with K and dense matrices."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from tests.reference import rosenbrock
from tests.scenes import bar, factor_of, rotation, simulation, solid

DAMPING = [(0.0, 0.0), (0.7, 0.0), (0.0, 0.03), (0.7, 0.03)]


def bodies(damping: tuple[float, float], tangent: str = "usual", **table) -> Simulation:
    """A held bar and a free one of another size and stiffness, moving; no bound of the error."""
    held = bar((3, 1, 1), (3, 1, 1), name="held", fixed="X < 0.01", young=2e5, damping=damping, tangent=tangent)
    free = bar((2, 2, 1), (1, 0.8, 0.5), name="free", young=1e5, poisson=0.45, tangent=tangent)
    table = {"integrator": {"scheme": "ros2", **table.pop("integrator", {})}, **table}
    table["integrator"]["error_bound"] = 1e9
    sim = simulation(held, free, gravity=(0, -9.81, 1), preconditioner="cholesky", on_runaway="go_on", **table)
    bend(sim, 0.1, 0.3)
    return sim


def bend(sim: Simulation, bent: float, angle: float) -> None:
    """Bends the held bar; bends and turns the free one; sets velocities of metres a second."""
    w = sim.world
    first, second = (b.nodes for b in w.bodies)
    X = w.rest[first]
    w.x[first] = X + bent * X[:, :1] ** 2 * np.array([-0.1, 1.0, 0.3])
    X = w.rest[second]
    w.x[second] = (X + 3 * bent * X[:, :1] ** 2 * [0.3, 0.0, 1.0]) @ rotation([1, 2, 3], angle).T + [0, 3, 0]
    w.v[:] = w.free[:, None] * np.sin(np.outer(w.x.sum(axis=1), [1.0, 2.0, 3.0]) + angle)


def error(found: NDArray, expected: NDArray, start: NDArray) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected - start).max())


def compare(sim: Simulation, stiffness: list[NDArray | None], tolerance: float) -> None:
    """Makes a step and compares it with the reference's, body by body."""
    w = sim.world
    before, x, v = [solid(sim, b.index) for b in w.bodies], w.x.copy(), w.v.copy()
    sim.engine.run(1)
    for body, start, K in zip(w.bodies, before, stiffness, strict=True):
        expected = rosenbrock.step(start, K)
        assert error(w.x[body.nodes], expected[0], x[body.nodes]) < tolerance
        assert error(w.v[body.nodes], expected[1], v[body.nodes]) < tolerance
        estimate = sim.integrator.estimate[body.nodes]
        np.testing.assert_allclose(estimate, expected[2], atol=tolerance * np.abs(expected[2]).max())


@pytest.mark.parametrize("tangent", ["usual", "exact"])
@pytest.mark.parametrize("damping", DAMPING)
def test_a_step_with_its_own_matrix_is_that_of_the_form_with_the_stiffness(damping, tangent):
    sim = bodies(damping, tangent, integrator={"solve": "iterate"}, tolerance=1e-13, max_iterations=3000)
    for _ in range(2):  # the second begins with what the first has left
        compare(sim, [None, None], 1e-9)
    records = sim.engine.records()
    assert (records["form"] == FORMS["ITERATE"]).all()
    assert records["estimate"][-2:] == pytest.approx([sim.integrator.estimate[b.nodes].max() for b in sim.world.bodies])


@pytest.mark.parametrize("precision, tolerance", [("float64", 1e-9), ("float32", 3e-5)])
@pytest.mark.parametrize("tangent", ["usual", "exact"])
@pytest.mark.parametrize("damping", DAMPING)
def test_a_step_with_the_factor_of_an_older_matrix_is_that_of_the_older_stiffness_warped(
    damping, tangent, precision, tolerance
):
    """The residual of the first stage is checked in the first of the two steps, and A is assembled only there."""
    sim = bodies(damping, tangent, factor_precision=precision)
    bend(sim, 0.02, 0.0)
    sim.engine.assemble()
    then, older = sim.system.rotation.copy(), [solid(sim, b.index).tangent() for b in sim.world.bodies]
    for body in sim.world.bodies:
        sim.engine.post_factor(body.index, *factor_of(sim, body.index, np.dtype(precision)), 0)
    bend(sim, 0.1, 0.6)
    for _ in range(2):
        sim.engine.assemble()  # leaves the rotations of the state
        now = sim.system.rotation.copy()
        warped = [
            rosenbrock.warped(K, then[b.nodes], now[b.nodes]) for b, K in zip(sim.world.bodies, older, strict=True)
        ]
        compare(sim, list(warped), tolerance)
    records = sim.engine.records()
    assert (records["form"] == FORMS["FACTOR"]).all() and (records["iterations"] == 0).all()
    assert np.abs(now - then).max() > 0.3


def test_it_differs_from_that_of_the_new_stiffness_and_of_the_older_one_as_it_was():
    """What the comparison above can see."""
    sim = bodies((0.0, 0.03))
    bend(sim, 0.02, 0.0)
    sim.engine.assemble()
    then, older = sim.system.rotation.copy(), [solid(sim, b.index).tangent() for b in sim.world.bodies]
    bend(sim, 0.1, 0.6)
    sim.engine.assemble()
    for body, K in zip(sim.world.bodies, older, strict=True):
        now = solid(sim, body.index)
        stiffness = rosenbrock.warped(K, then[body.nodes], sim.system.rotation[body.nodes])
        x = [rosenbrock.step(now, k)[0] for k in (stiffness, K, None)]
        assert min(error(x[0], x[1], now.x), error(x[0], x[2], now.x)) > 1e-3
