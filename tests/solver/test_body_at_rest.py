# SPDX-License-Identifier: MIT
"""A body at rest, whose right-hand side is rounding, is not solved for: it stays where it is until it is moved."""

import numpy as np
import pytest

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, scene, simulation

SCHEMES = {
    "backward Euler": {},
    "bdf2": {"scheme": "bdf2", "linearizations": 3},
    "newmark": {"scheme": "newmark", "linearizations": 2},
    "generalized_alpha": {"scheme": "generalized_alpha", "linearizations": 2},
    "quasi-static": {"scheme": "quasi_static", "linearizations": 10},
}
DAMPED = (20.0, 0.02)


def hanging(dt: float = 0.02, young: float = 1e6, damping: tuple[float, float] = DAMPED, far: float = 0, **table):
    """A beam under gravity that comes to rest soon."""
    pose = {"translate": [far, 0, 0]}
    beam = bar((4, 2, 2), young=young, fixed="X < 0.01", damping=damping, pose=pose, touch=True)
    return simulation(beam, dt=dt, gravity=(0, -9.81, 0), **({"preconditioner": "block_jacobi"} | table))


def never_at_rest(sim: Simulation) -> Simulation:
    """The same body with no bound for rounding, so that it is always solved."""
    sim.system.inverse_time[:] = 0
    return sim


@pytest.mark.parametrize("far", [0.0, 1e6])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_costs_no_iteration_and_does_not_drift(scheme, far):
    sim = hanging(integrator=SCHEMES[scheme], far=far)
    Driver(sim).advance(600)
    x = sim.world.x.copy()
    records = Driver(sim).advance(400)
    assert not records["iterations"].any()
    assert not records["status"].any()
    assert records["at_rest"].all()
    if scheme == "newmark":  # x is a sum of what the scheme carries on, below its rounding
        assert abs(sim.world.x - x).max() <= 4 * np.spacing(max(far, 2.0))
    else:
        assert np.array_equal(sim.world.x, x)


OTHERWISE = [{"update": "lockstep-3", "preconditioner": "cholesky"}, {"warm_start": False}, {"dt": 4e-3}]


@pytest.mark.parametrize("table", OTHERWISE)
def test_with_an_old_factor_without_warm_start_and_at_small_steps(table):
    sim = hanging(**table)
    driver = Driver(sim)
    driver.advance(int(12 / sim.world.dt))
    x = sim.world.x.copy()
    records = driver.advance(400)
    assert not records["iterations"].any()
    assert (records["residual"] == 1).all()  # of rounding, by no iteration: told as it is
    assert np.array_equal(sim.world.x, x)


def test_a_push_wakes_it_in_the_step_in_which_it_comes():
    sim = hanging()
    driver = Driver(sim)
    driver.advance(600)
    touch = sim.effects["touch"]
    touch.push("test", "bar", (2.0, 0.5, 0.5), 0.3, (0.0, 1e-3, 0.0), 0.1)
    records = driver.advance(5)
    assert (records["iterations"] > 0).all() and not records["at_rest"].any()
    assert abs(sim.world.v).max() > 1e-9


CREEPING = {
    "far away": {"far": 1e6},
    "soft": {"young": 1.0, "damping": (400.0, 0.0)},
    "soft and far away": {"young": 100.0, "damping": (400.0, 0.0), "far": 1e6},
    "small steps": {"dt": 1e-4},
}


@pytest.mark.parametrize("case", CREEPING)
def test_slow_motion_goes_on(case):
    """3000 steps of a motion that creeps towards its rest are those of the same body without the floor."""
    motions = []
    for change in (lambda sim: sim, never_at_rest):
        sim = change(hanging(**({"damping": (100.0, 0.0)} | CREEPING[case])))
        driver = Driver(sim)
        motions.append([])
        for _ in range(30):
            driver.advance(100)
            motions[-1].append(sim.world.x.copy())
    with_floor, without = np.array(motions)
    way = abs(without[-1] - without[0]).max()
    assert way > 1e-3
    rounding = 4 * np.spacing(abs(without).max())
    assert abs(with_floor - without).max() < 1e-6 * way + rounding


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_a_free_body_that_drifts_slowly_goes_on(far):
    """Nothing holds it, no force but its damping acts: the smallest motion that there is, 1e-6 m/s and less."""
    beams = []
    for change in (lambda sim: sim, never_at_rest):
        pose = {"translate": [far, 0, 0]}
        sim = change(simulation(bar(young=1e9, damping=(0.1, 0.0), pose=pose), preconditioner="block_jacobi"))
        sim.world.v[:] = [1e-6, -2e-6, 0]
        Driver(sim).advance(1000)
        beams.append((sim.world.x.copy(), sim.world.v.copy()))
    (x, v), (expected_x, expected_v) = beams
    expected = np.array([1e-6, -2e-6, 0]) / (1 + 0.02 * 0.1) ** 1000
    assert abs(v.mean(axis=0) - expected).max() < 1e-9
    assert abs(x - expected_x).max() < 1e-9 + 1e3 * np.spacing(far)
    assert abs(v - expected_v).max() < 1e-9 + 1e-3 * far * 2.2e-16 / 0.02 * 1e3


def test_what_rests_in_a_scene_waits_for_what_moves():
    """Each body by itself."""
    objects = [
        bar((4, 2, 2), young=1e6, fixed="X < 0.01", damping=damping, name=name)
        for name, damping in (("still", DAMPED), ("swinging", (0.0, 0.0)))
    ]
    sim = simulation(*objects, gravity=(0, -9.81, 0), preconditioner="block_jacobi")
    records = Driver(sim).advance(600)[-200:]
    assert not records["iterations"][records["body"] == 0].any()
    assert (records["iterations"][records["body"] == 1] > 0).all()


def test_the_extent_is_that_of_the_body_before_its_pose():
    """Wherever it is placed."""
    table = bar((4, 2, 2), (2, 1, 1), pose={"translate": [1e3, 0, 0]})
    sim = Simulation(scene(table))
    assert sim.system.extent == pytest.approx(np.full(sim.world.nodes, np.sqrt(6)))
