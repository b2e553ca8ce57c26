# SPDX-License-Identifier: MIT
"""Bodies with more energy than their budget: detected in the step in which it occurs, reported, frozen or continued."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.backends.cpu.device import module
from sim_server.service.telemetry import Telemetry
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

WILD = {"neo_hookean": {"young": 1e6, "poisson": 0.45, "inversion": "regularize"}, "fixed": {"where": "X < 0.01"}}
"""Released from three times its length it flies apart within five steps: one linearization overshoots, the line is held
by no barrier."""


def wild(name: str = "wild") -> dict:
    return bar((4, 2, 2), (2, 0.5, 0.5), name=name, young=None, effects=WILD)


def released(*objects: dict, names: tuple[str, ...] = ("wild",), **table) -> Simulation:
    """The named ones from three times their length."""
    settings = {"preconditioner": "block_jacobi", "projection": "clamp", "max_iterations": 3000}
    sim = simulation(*objects, **(settings | table))
    for name in names:
        nodes = sim.world.body(name).nodes
        sim.world.x[nodes] = sim.world.rest[nodes] * [3, 1, 1]
    return sim


def criterion(sim: Simulation, start: float, size: float, x: NDArray) -> bool:
    """The criterion of kernels/energy_balance.cuh for one body without gravity, pushes or grabs."""
    w = sim.world
    kinetic = 0.5 * (w.mass[:, None] * w.v**2).sum()
    floor = 0.5 * w.mass.sum() * (1e-3 * size / w.dt) ** 2
    return not kinetic <= 2 * start + floor or np.ptp(w.x - x, axis=0).max() > 4 * size


def test_it_is_seen_in_the_step_in_which_it_happens():
    free, frozen = (released(wild(), on_runaway=choice) for choice in ("go_on", "freeze"))
    start, size = free.potential_energy(), float(np.linalg.norm([6, 0.5, 0.5]))
    assert start > 0
    seen: list[bool] = []
    for _ in range(30):
        x = free.world.x.copy()
        free.engine.run(1)
        frozen.engine.run(1)
        seen.append(criterion(free, start, size, x))
        status = free.engine.records()["status"][0], frozen.engine.records()["status"][0]
        assert (status[0] == pb.RUNAWAY) == seen[-1]
        assert (status[1] == pb.RUNAWAY) == any(seen)
        if any(seen):
            break
        np.testing.assert_array_equal(free.world.x, frozen.world.x)
    assert any(seen) and 2 < len(seen) < 20
    np.testing.assert_array_equal(frozen.world.x, x)  # as the step before left it
    assert not frozen.world.v.any() and np.abs(free.world.v).max() > 10
    frozen.engine.loop.energy_every = 1
    frozen.engine.run(10)
    records = frozen.engine.records()
    np.testing.assert_array_equal(frozen.world.x, x)
    assert (records["status"] == pb.RUNAWAY).all() and not records["iterations"].any() and not records["kinetic"].any()
    assert records["elastic"] == pytest.approx(np.full(10, frozen.potential_energy()), rel=1e-12)
    free.engine.run(10)
    assert np.abs(free.world.x).max() > 1e3  # that is what became of it


@pytest.mark.parametrize("threads", [1, 2])
def test_neighbours_are_not_disturbed(threads):
    others = [bar(name=name, young=2e4, fixed="X < 0.01", touch={"max_force": 1e3}) for name in ("before", "behind")]
    both = released(others[0], wild(), others[1], gravity=(0, -9.81, 0), threads=threads)
    alone = released(*others, names=(), gravity=(0, -9.81, 0))
    both.engine.run(40)
    alone.engine.run(40)
    status = both.engine.records()["status"].reshape(-1, 3)
    assert (status[:, [0, 2]] == pb.CONVERGED).all() and (status[-20:, 1] == pb.RUNAWAY).all()
    for name in ("before", "behind"):
        a, b = both.world.body(name).nodes, alone.world.body(name).nodes
        assert both.world.x[a].tobytes() == alone.world.x[b].tobytes()
        assert both.world.v[a].tobytes() == alone.world.v[b].tobytes()


SCHEMES = {
    "backward Euler": {},
    "Newton": {"linearizations": 4},
    "newmark": {"scheme": "newmark", "linearizations": 3},
    "bdf2": {"scheme": "bdf2", "linearizations": 3},
    "generalized_alpha": {"scheme": "generalized_alpha", "linearizations": 3},
    "ros2": {"scheme": "ros2", "error_bound": 1e9},  # what drives the body is no part of its backward Euler step
}


def driven(integrator: dict, gravity: tuple[float, float, float], **table) -> Simulation:
    """A bar, and another in whose gravity the scene knows nothing of 1e4 m/s2."""
    objects = [bar(name=name, young=1e5, fixed="X < 0.01") for name in ("wild", "calm")]
    sim = simulation(*objects, gravity=gravity, integrator=integrator, preconditioner="block_jacobi", **table)
    w, index = sim.world, [launch.name for launch in sim.engine.launches].index("gravity.gravity")
    mass = np.where(np.arange(w.nodes) < w.bodies[0].last, w.mass, 0.0)
    up = module("effects/gravity.cu").bind(
        "gravity", w.nodes, mass=mass, g=np.array([0.0, 1e4, 0.0]), h=w.force_coefficient, b=sim.system.b
    )
    sim.drive = lambda: sim.engine.replace(index, up)  # type: ignore[attr-defined]
    return sim


@pytest.mark.parametrize("integrator", SCHEMES.values(), ids=SCHEMES)
def test_a_frozen_body_stays_where_it_is_in_every_scheme(integrator):
    """Driven by what the scene does not know of."""
    sim = driven(integrator, (0, -1.0, 0))
    sim.engine.run(5)
    assert (sim.engine.records()["status"] != pb.RUNAWAY).all()
    sim.drive()
    mine, before, statuses = sim.world.bodies[0].nodes, [], []
    for _ in range(12):
        before.append(sim.world.x[mine].copy())
        sim.engine.run(1)
        statuses.append(int(sim.engine.records()["status"][0]))
    assert pb.RUNAWAY in statuses[:3]
    first = statuses.index(pb.RUNAWAY)
    assert set(statuses[first:]) == {pb.RUNAWAY}
    np.testing.assert_array_equal(sim.world.x[mine], before[first])
    assert not sim.world.v[mine].any() and not sim.world.predictor[mine].any() and np.isfinite(sim.world.x).all()


def test_what_is_thrown_or_spun_is_no_runaway():
    sim = simulation(bar(name="thrown", young=1e6), bar(name="spun", young=1e6), preconditioner="block_jacobi")
    thrown, spun = (sim.world.body(name).nodes for name in ("thrown", "spun"))
    sim.world.v[thrown] = [3e3, 1e3, 0]
    sim.world.v[spun] = np.cross([0, 0, 800.0], sim.world.x[spun] - sim.world.x[spun].mean(axis=0))
    sim.engine.run(20)
    records = sim.engine.records()
    assert (records["status"] != pb.RUNAWAY).all() and np.abs(sim.world.x[thrown]).max() > 1e3
    assert records["stride"].max() > 5


def test_without_inertia_a_step_longer_than_the_body_is_one():
    """So soft that one linearization from the unloaded state overshoots, and the next ones more."""
    effects = {"stable_neo_hookean": {"young": 1.4e5, "poisson": 0.4}, "fixed": {"where": "X < 0.01"}}
    soft = bar((6, 2, 2), (3, 0.5, 0.5), young=None, effects=effects)
    table = {"gravity": (0, -9.81, 0), "integrator": {"scheme": "quasi_static"}, "preconditioner": "block_jacobi"}
    sim = simulation(soft, projection="clamp", max_iterations=5000, **table)
    size = float(np.linalg.norm([3, 0.5, 0.5]))
    for _ in range(40):
        sim.engine.run(1)
        record = sim.engine.records()[0]
        assert record["kinetic"] == 0
        if record["status"] == pb.RUNAWAY:
            break
        assert record["stride"] <= 4 * size
    assert record["status"] == pb.RUNAWAY and record["stride"] > 4 * size
    x = sim.world.x.copy()
    sim.engine.run(3)
    np.testing.assert_array_equal(sim.world.x, x)


def lines_and_status(on_runaway: str) -> tuple[list[str], pb.Status, Driver]:
    """Returns the notices of a run, in batches of seven steps."""
    sim, found, lines = released(wild(), on_runaway=on_runaway), [], []
    driver = Driver(sim)
    telemetry = Telemetry(driver, SimpleNamespace(publish_status=found.append), None, patient=False)  # type: ignore[arg-type]
    sim.engine.loop.energy_every = 2
    for _ in range(5):
        records = driver.advance(7)
        lines += [*telemetry.warnings.count_unconverged(records), *telemetry.warnings.count_runaways(records)]
        telemetry.summary.update(records)
    telemetry.publish_status("running")
    return lines, found[0], driver


def test_it_is_told_once_with_object_and_cause_and_counted():
    lines, status, driver = lines_and_status("freeze")
    away = [line for line in lines if "runaway" in line]
    assert len(away) == 1
    assert away[0].startswith("object 'wild', step ") and "it is frozen" in away[0] and "kinetic energy" in away[0]
    found = status.objects[0]
    assert found.last.status == pb.RUNAWAY and 20 < found.runaway_steps < 35
    assert found.total_energy == pytest.approx(driver.simulation.potential_energy(), rel=1e-12)
    went_on, status, _ = lines_and_status("go_on")
    assert len([line for line in went_on if "runaway" in line and "it goes on" in line]) == 1


def test_no_factor_is_asked_for_a_frozen_body(caplog):
    objects = [wild(), bar(name="calm", young=2e4, fixed="X < 0.01")]
    for update in ("lockstep-3", "every-2", "async"):
        sim = released(*objects, preconditioner="cholesky", update=update, gravity=(0, -9.81, 0))
        driver = Driver(sim, counted=True)
        driver.advance(25)
        calm, away = driver.by_name["calm"], driver.by_name["wild"]
        assert away.frozen and not calm.frozen
        used, asked = away.factors.used, calm.factors.used
        with caplog.at_level(logging.WARNING):
            caplog.clear()
            records = driver.advance(12)
            assert not caplog.records
        assert away.factors.used == used and calm.factors.used > asked
        assert (records["factor_step"][records["body"] == away.body.index] == -1).all()


def test_a_log_of_a_version_that_did_not_look_is_repeated_without():
    sim = Simulation(released(wild()).scene, watched=False)
    sim.world.x[:] = sim.world.rest * [3, 1, 1]
    sim.engine.run(12)
    assert (sim.engine.records()["status"] != pb.RUNAWAY).all() and not np.abs(sim.world.x).max() < 1e3
