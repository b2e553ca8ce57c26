# SPDX-License-Identifier: MIT
"""The way back: steps whose estimated error exceeds its bound are made by backward Euler, body by body."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation


def swinging(
    dt: float = 0.02, damping: tuple[float, float] = (0.1, 0.0), tangent: str = "auto", **table: Any
) -> Simulation:
    """A bar held at one end, let go from horizontal."""
    touch = {"max_force": 1e6}
    held = bar((4, 2, 2), (2, 1, 1), young=2e5, fixed="X < 0.01", damping=damping, tangent=tangent, touch=touch)
    return simulation(held, gravity=(0, -9.81, 0), dt=dt, preconditioner="block_jacobi", max_iterations=2000, **table)


def ros2(**options: Any) -> dict[str, Any]:
    return {"scheme": "ros2", **options}


@pytest.mark.parametrize("tangent", ["usual", "exact"])
@pytest.mark.parametrize("damping", [(0.0, 0.0), (0.5, 0.02)])
def test_with_a_tiny_bound_it_is_backward_euler_bit_for_bit(damping, tangent):
    """Whose solves start from zero: the solution of the step before, by another scheme, is no good start. A grab begins
    on the way. By default the two have different tangents."""
    back = swinging(damping=damping, tangent=tangent, integrator=ros2(error_bound=1e-300))
    euler = swinging(damping=damping, tangent=tangent, warm_start=False)
    for step in range(20):
        for sim in (back, euler):
            if step == 10:
                sim.touch.grab("client", "bar", (2, 0.5, 0.5), 0.6, (2, 1, 1), 1e5, 0, 10)
            sim.engine.run(1)
        assert np.array_equal(back.world.x, euler.world.x) and np.array_equal(back.world.v, euler.world.v)
    records, of_euler = back.engine.records(), euler.engine.records()
    assert (records["form"] == FORMS["EULER"]).all() and (of_euler["form"] == FORMS["ONE_SOLVE"]).all()
    assert (records["status"] == 0).all() and (records["estimate"] > 0).all() and np.isnan(of_euler["estimate"]).all()
    assert (records["iterations"] > of_euler["iterations"]).all()  # with those of the attempt


def test_with_a_huge_bound_it_never_goes_back():
    for bound, expected in ((1e3, "ITERATE"), (None, "EULER")):
        sim = swinging(integrator=ros2() if bound is None else ros2(error_bound=bound), on_runaway="go_on")
        sim.world.x[:, 0] *= 3
        sim.engine.run(1)
        records = sim.engine.records()
        assert records["form"][0] == FORMS[expected] and records["estimate"][0] > 0.05
        assert sim.integrator.bound[0] == (0.1 * 0.5 if bound is None else bound)


def test_the_bound_is_that_of_the_record():
    """Just above and just below the estimate of a step."""
    sim = swinging(integrator=ros2())
    sim.engine.run(3)
    estimate = sim.engine.records()["estimate"][2]
    for bound, form in ((estimate * (1 + 1e-9), "ITERATE"), (estimate * (1 - 1e-9), "EULER")):
        sim = swinging(integrator=ros2(error_bound=bound))
        sim.engine.run(3)
        assert sim.engine.records()["form"][2] == FORMS[form]


def test_the_estimate_is_of_second_order():
    """That of the method of first order within: h |k_1 + k_2| / 2."""
    estimates = []
    for dt in (0.008, 0.004, 0.002):
        sim = swinging(dt=0.001, tolerance=1e-10, integrator=ros2())
        sim.engine.run(200)
        later = swinging(dt=dt, tolerance=1e-10, integrator=ros2())
        later.world.x[:], later.world.v[:] = sim.world.x, sim.world.v
        later.engine.run(1)
        estimates.append(float(later.engine.records()["estimate"][0]))
    assert np.log2(np.array(estimates[:-1]) / estimates[1:]) == pytest.approx([2, 2], abs=0.2), estimates


def parts(names: str, threads: int, update: str) -> tuple[Simulation, NDArray]:
    """20 steps of the bodies named: a, grabbed, and b swing, w is let go from three times its length, r rests."""
    given = {
        "a": bar((4, 2, 2), (2, 1, 1), name="a", young=2e5, fixed="X < 0.01", touch={"max_force": 1e6}),
        "w": bar((3, 1, 1), (3, 1, 1), name="w", young=1e6, poisson=0.45, fixed="X < 0.01"),
        "r": bar((2, 1, 1), (2, 1, 1), name="r", young=1e6),
        "b": bar((3, 2, 1), (3, 1, 1), name="b", young=1e6, fixed="X < 0.01", damping=(0.0, 0.01)),
    }  # fmt: skip
    sim = simulation(
        *(given[k] for k in names), preconditioner="cholesky", update=update, threads=threads, integrator=ros2()
    )
    w = sim.world
    for body in w.bodies:
        own = w.rest[body.nodes]
        if body.name == "w":
            w.x[body.nodes] = own * [3, 1, 1]
        elif body.name != "r":
            w.v[body.nodes] = np.array([0, 2.0, 1.0]) * own[:, :1] * w.free[body.nodes, None]
    if "a" in names:
        sim.touch.grab("client", "a", (2, 0.5, 0.5), 0.6, (2, 1, 1), 1e5, 0, 10)
    return sim, Driver(sim).advance(20)


@pytest.mark.parametrize("update", ["lockstep-3", "every-5"])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_body_that_goes_back_leaves_the_others_as_they_are(threads, update):
    together, records = parts("awrb", threads, update)
    forms = records["form"].reshape(20, 4).T
    assert (forms[1] == FORMS["EULER"]).sum() >= 3 and (forms[1] != FORMS["EULER"]).sum() >= 3
    assert not (forms[[0, 2, 3]] == FORMS["EULER"]).any() and (forms[[0, 3]] == FORMS["FACTOR"]).sum() >= 30
    assert (records["status"] == 0).all()
    for body in together.world.bodies:
        alone, own = parts(body.name, 1, update)
        assert np.array_equal(together.world.x[body.nodes], alone.world.x), body.name
        assert np.array_equal(together.world.v[body.nodes], alone.world.v), body.name
        of_body = records[records["body"] == body.index]
        for column in ("iterations", "form", "estimate", "residual", "factor_step", "fallbacks"):
            assert np.array_equal(of_body[column], own[column], equal_nan=True), (body.name, column)
