# SPDX-License-Identifier: MIT
"""The Rosenbrock-W step on a GPU beside that on the CPU: forms, estimates and motion. Runs where there is a GPU."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.messages_pb2 import SolveStatus
from sim_server.backends.rosenbrock import FORMS
from sim_server.scene import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, factor_of, scene
from tests.state import put

pytestmark = pytest.mark.gpu

ITERATE, FACTOR, EULER = (FORMS[name] for name in ("ITERATE", "FACTOR", "EULER"))
GRAVITY = (0.0, -9.81, 0.0)
EXACT = {"tolerance": 1e-11, "preconditioner": "cholesky", "max_iterations": 4000, "factor_precision": "float32"}
STAGES = {"scheme": "ros2"}
STRICT = STAGES | {"error_bound": 5e-3}
Between = Callable[[Simulation, int], None]


class Run(NamedTuple):
    """x (steps, n, 3) after each step; the records."""

    x: NDArray
    records: NDArray[Any]
    sim: Simulation


def run(device: str, made: Scene, steps: int, between: Between | None = None) -> Run:
    sim = Simulation(made, device)
    driver, x, records = Driver(sim), [], []
    for step in range(steps):
        if between:
            between(sim, step)
        records.append(driver.advance(1))
        x.append(sim.fetch().x.copy())
    return Run(np.array(x), np.concatenate(records), sim)


def both(
    make: Callable[[], Scene], steps: int, between: Between | None = None, near: float = 1e-7, forms: bool = True
) -> tuple[Run, Run]:  # fmt: skip
    """The same forms in each step of each body, and the same motion to `near` [m]."""
    cpu, gpu = (run(device, make(), steps, between) for device in ("cpu", "gpu"))
    told = f"cpu {cpu.records['form'].tolist()}\ngpu {gpu.records['form'].tolist()}"
    for name in ("step", "body", "status", "factor_step", *(["form"] if forms else [])):
        assert cpu.records[name].tolist() == gpu.records[name].tolist(), f"{name}\n{told}"
    assert np.isfinite(gpu.x).all()
    far = np.abs(cpu.x - gpu.x).max(axis=(1, 2))
    assert far.max() < near, f"{far.tolist()}\n{told}"
    size = np.abs(cpu.records["estimate"]).max()
    assert np.abs(cpu.records["estimate"] - gpu.records["estimate"]).max() < 1e-3 * size + near
    return cpu, gpu


def thrown(velocity: tuple[float, float, float], body: int = 0) -> Between:
    """The free nodes of a body begin with a velocity [m/s]."""

    def prepare(sim: Simulation, step: int) -> None:
        if step:
            return
        v, nodes = sim.world.v.copy(), sim.world.bodies[body].nodes
        v[nodes] = sim.world.free[nodes, None] * np.array(velocity)
        put(sim, sim.world.v, v)

    return prepare


def held(**table: Any) -> dict:
    return bar(**{"cells": (5, 2, 2), "size": (2, 0.8, 0.8), "young": 3e4, "fixed": "X < 0.01"} | table)


def of_law(law: str, **table: Any) -> dict:
    made = held(**{"young": None} | table)
    made["effects"][law] = {"young": 3e4, "poisson": 0.35}
    return made


BODIES = {
    "corotational, usual tangent": lambda: held(damping=(0.2, 0.01), tangent="usual"),
    "corotational": held, "corotational, damped by the tangent": lambda: held(damping=(0.2, 0.01)),
    "stable_neo_hookean": lambda: of_law("stable_neo_hookean"),
    "st_venant_kirchhoff": lambda: of_law("st_venant_kirchhoff"),
}  # fmt: skip


@pytest.mark.parametrize("body", BODIES)
def test_by_iterations(body):
    stages, solver = STAGES | {"solve": "iterate"}, EXACT | {"update": "every-3"}
    _, gpu = both(lambda: scene(BODIES[body](), dt=0.02, gravity=GRAVITY, integrator=stages, **solver), 12)
    assert (gpu.records["form"] == ITERATE).all() and (gpu.records["iterations"] > 0).all()
    assert np.abs(gpu.x[-1] - gpu.x[0]).max() > 0.02


@pytest.mark.parametrize("body", BODIES)
def test_by_the_factor_alone(body):
    make = lambda: scene(  # noqa: E731
        BODIES[body](), dt=0.01, gravity=GRAVITY, integrator=STAGES, update="every-8", **EXACT
    )
    _, gpu = both(make, 30, near=1e-5)
    by_factor = gpu.records["form"] == FACTOR
    assert by_factor.sum() > 20 and (gpu.records["residual"][by_factor] < 0.1).all()
    assert (gpu.records["iterations"][by_factor] == 0).all() and (gpu.records["solve"] > 0).all()
    assert (gpu.records["estimate"] > 0).all()


def test_a_violent_start_goes_back():
    make = lambda: scene(held(), dt=0.02, gravity=GRAVITY, integrator=STRICT, update="every-3", **EXACT)  # noqa: E731
    _, gpu = both(make, 10, thrown((-8.0, 20.0, 3.0)), near=1e-4)
    back = gpu.records["form"] == EULER
    assert back.any() and not back.all(), gpu.records["form"].tolist()
    assert (gpu.records["estimate"][back] > 5e-3).all() and (gpu.records["status"] == SolveStatus.CONVERGED).all()


def crowd() -> Scene:
    """Bodies of which one is thrown and one rests."""
    at = [{"name": f"b{k}", "pose": {"translate": [0, 3 * k, 0]}} for k in range(4)]
    return scene(
        bar((2, 1, 1), (1, 0.5, 0.5), young=1e6, **at[0]), held(**at[1]), held(young=1e6, **at[2]),
        of_law("stable_neo_hookean", **at[3]), dt=0.02, integrator=STRICT, update="every-3", **EXACT,
    )  # fmt: skip


def test_bodies_go_back_each_by_itself():
    def stir(sim: Simulation, step: int) -> None:
        if step:
            return
        v = np.zeros_like(sim.world.v)
        for body, speed in zip(sim.world.bodies, [0, 25, 0.5, 1], strict=True):
            v[body.nodes] = sim.world.free[body.nodes, None] * np.array([0.3 * speed, speed, 0.0])
        put(sim, sim.world.v, v)

    _, gpu = both(crowd, 14, stir, near=1e-4)
    forms = gpu.records["form"].reshape(-1, 4)
    assert (forms[0] == [FACTOR, EULER, FACTOR, FACTOR]).all() and (forms[-1, 2:] == FACTOR).all(), forms
    idle = gpu.sim.world.bodies[0].nodes
    assert np.array_equal(gpu.x[-1, idle], gpu.x[0, idle])


@pytest.mark.parametrize("bars", [[(1, 1, 2)] * 150, [(1, 1, 1)] * 140 + [(4, 3, 3)]], ids=["pool", "pool and one"])
def test_small_bodies_of_a_pool(bars):
    objects = [
        bar(cells, (0.5 * cells[0], 0.5, 0.5 * cells[2]), name=f"b{k}", young=1e5 * (1 + 9 * (k % 4)), fixed="X < 0.01",
            pose={"translate": [0, 2 * k, 0]})
        for k, cells in enumerate(bars)
    ]  # fmt: skip
    made = lambda: scene(*objects, dt=0.01, gravity=GRAVITY, integrator=STAGES, update="every-3", **EXACT)  # noqa: E731
    _, gpu = both(made, 8, near=1e-5)
    assert (gpu.records["form"][-len(bars) :] == FACTOR).all()


def test_what_is_not_finite_is_told_and_stays_in_its_body():
    at = [{"name": f"b{k}", "pose": {"translate": [0, 3 * k, 0]}} for k in range(3)]
    make = lambda: scene(*(held(**a) for a in at), dt=0.02, integrator=STAGES, update="every-3", **EXACT)  # noqa: E731

    def spoil(sim: Simulation, step: int) -> None:
        if step == 6:
            v = sim.fetch().v.copy()
            first = sim.world.bodies[1].first
            v[first + np.flatnonzero(sim.world.free[first:])[5], 1] = np.nan
            put(sim, sim.world.v, v)
        elif step == 0:
            thrown((0.0, 0.5, 0.0), 1)(sim, 0)

    cpu, gpu = (run(device, make(), 9, spoil) for device in ("cpu", "gpu"))
    for name in ("status", "bad_node"):
        assert cpu.records[name].tolist() == gpu.records[name].tolist(), name
    assert SolveStatus.NOT_FINITE in gpu.records["status"][gpu.records["body"] == 1]
    assert (gpu.records["status"][gpu.records["body"] != 1] == SolveStatus.CONVERGED).all()
    for k in (0, 2):
        nodes = cpu.sim.world.bodies[k].nodes
        assert np.abs(cpu.x[:, nodes] - gpu.x[:, nodes]).max() < 1e-5


def test_a_grab_iterates_until_the_factor_knows_that_it_has_gone():
    make = lambda: scene(  # noqa: E731
        held(young=3e5, touch={"max_force": 1000.0}),
        dt=0.01,
        gravity=GRAVITY,
        integrator=STAGES,
        update="every-5",
        **EXACT,
    )
    held_by: list[int] = []

    def grab(sim: Simulation, step: int) -> None:
        touch = sim.effects["touch"]
        if step == 10:
            held_by.append(touch.grab("me", "bar", (2.0, 0.8, 0.8), 0.0, (2.0, 1.0, 0.8), 400.0, 500.0, 10.0).id)
        if step == 16:
            touch.release("me", held_by.pop())
        if step == 20:
            touch.push("me", "bar", (2.0, 0.4, 0.4), 0.0, (0.0, 0.0, 40.0), 0.1)

    _, gpu = both(make, 34, grab, near=1e-3, forms=False)
    forms, factor = gpu.records["form"], gpu.records["factor_step"]
    assert (forms[10:16] == ITERATE).all() and (forms[7:10] == FACTOR).all(), forms.tolist()
    ungrabbed = factor[16:] > 15
    assert (forms[16:][~ungrabbed] == ITERATE).all() and (forms[16:][ungrabbed] == FACTOR).all(), forms.tolist()
    assert ungrabbed.any() and not ungrabbed.all()


def with_factor(make: Callable[[], Scene]) -> Simulation:
    """On the GPU, after two steps and with the factor of the second one's matrix."""
    sim = Simulation(make(), "gpu")
    sim.engine.run(1)
    sim.engine.assemble()
    pattern, values = factor_of(sim, dtype=np.float32)
    sim.engine.solve()
    sim.engine.post_factor(0, pattern, values, 1)
    sim.engine.settle_factors()
    return sim


def swinging() -> Scene:
    return scene(held(touch={"max_force": 100.0}), dt=0.01, gravity=GRAVITY, integrator=STAGES, **EXACT)


def test_batches_of_steps_are_the_same_steps():
    one, many = with_factor(swinging), with_factor(swinging)
    assert all(all(row) for row in one.engine.loop.graphs)
    for _ in range(24):
        one.engine.run(1)
    many.engine.run(24)
    records = [sim.engine.records() for sim in (one, many)]
    for name in ("step", "form", "estimate", "iterations", "status"):
        assert np.array_equal(records[0][name], records[1][name]), name
    assert (records[0]["form"][2:] == FACTOR).all()
    assert np.array_equal(one.fetch().x, many.fetch().x) and np.array_equal(one.fetch().v, many.fetch().v)


def test_a_copy_of_the_matrix_of_a_step_leaves_no_trace():
    """Not even in the energies of a body that is being grabbed."""
    asked, other = with_factor(swinging), with_factor(swinging)
    target = np.zeros_like(asked.system.values)
    for sim in (asked, other):
        sim.effects["touch"].grab("me", "bar", (2.0, 0.8, 0.8), 0.3, (2.0, 1.0, 0.8), 400.0, 20.0, 0.05)
        sim.engine.run(3)
    asked.engine.request_matrix(0, target)
    asked.engine.run(1)
    assert asked.engine.matrix_step(0) == 5
    other.engine.assemble()
    assert np.array_equal(target, other.system.values)
    other.engine.solve()
    for sim in (asked, other):
        sim.engine.run(8)
    a, b = asked.engine.records(), other.engine.records()
    for name in ("step", "form", "estimate", "iterations", "residual", "kinetic", "work", "budget"):
        assert np.array_equal(a[name], b[name], equal_nan=True), name
    assert np.array_equal(asked.fetch().x, other.fetch().x)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_useless_factor_does_not_make_the_step(value):
    """Of one of NaN each estimate is NaN; one that lets nothing move is found out by the forces."""
    sim = with_factor(swinging)
    reference = with_factor(swinging)
    pattern, values = factor_of(sim, dtype=np.float32)
    spoiled = np.full_like(values, np.nan) if np.isnan(value) else values * np.float32(1e3)
    sim.engine.post_factor(0, pattern, spoiled, 2)
    sim.engine.settle_factors()
    for each in (sim, reference):
        each.engine.run(6)
    assert (sim.engine.records()["form"][2:] == ITERATE).all()
    assert np.abs(sim.fetch().x - reference.fetch().x).max() < 1e-3


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_single_precision(precision):
    loose = EXACT | {"tolerance": 1e-4}
    made = lambda p: scene(  # noqa: E731
        held(damping=(0.1, 0.01)),
        dt=0.01,
        gravity=GRAVITY,
        integrator=STAGES,
        update="lockstep-4",
        precision=p,
        **loose,
    )
    exact, single = (run("gpu", made(p), 30) for p in ("float64", precision))
    assert exact.records["form"].tolist() == single.records["form"].tolist()
    assert np.abs(exact.x - single.x).max() < 1e-3
