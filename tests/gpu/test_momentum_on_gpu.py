# SPDX-License-Identifier: MIT
"""Momenta of free bodies in Rosenbrock-W steps on a GPU, and their motion beside that on the CPU."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.scene import Scene
from sim_server.simulation import Simulation
from tests.gpu.test_rosenbrock_on_gpu import EXACT, GRAVITY, STAGES, both, run
from tests.scenes import bar, scene
from tests.state import put

pytestmark = pytest.mark.gpu

DT = 0.02


def free(cells: tuple[int, int, int] = (4, 2, 2), **table: object) -> dict:
    return bar(cells, (0.5 * cells[0], 0.5 * cells[1], 0.5 * cells[2]), **{"young": 1e7} | table)


def turning(sim: Simulation, step: int) -> None:
    """All bodies move, vibrate and turn, at rates of 1 to 3.5 [1/s]."""
    if step:
        return
    w = sim.world
    v = np.zeros_like(w.v)
    for k, body in enumerate(w.bodies):
        arm = w.x[body.nodes] - w.x[body.nodes].mean(axis=0)
        axis = (3 - k % 3) * np.array([0.3, 1.0, 0.5])
        v[body.nodes] = np.array([1.0, 0.5, -0.3]) + np.cross(axis, arm)
        v[body.nodes, 1] += 0.3 * arm[:, 0] ** 2
    put(sim, w.v, w.free[:, None] * v)


def momenta(sim: Simulation, body: int, x: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    """Momentum, and angular momentum about the centre of mass."""
    nodes = sim.world.bodies[body].nodes
    mass = sim.world.mass[nodes, None]
    arm = x[nodes] - (mass * x[nodes]).sum(axis=0) / mass.sum()
    return (mass * v[nodes]).sum(axis=0), np.cross(arm, mass * v[nodes]).sum(axis=0)


def check_kept(sim: Simulation, bodies: list[int], near: float) -> None:
    """That bodies have the momenta with which `turning` began, the angular ones to `near`, relative."""
    start = Simulation(sim.scene, "cpu")
    turning(start, 0)
    state = sim.fetch()
    for body in bodies:
        linear, angular = momenta(sim, body, state.x, state.v)
        was, turned = momenta(start, body, start.world.x, start.world.v)
        assert np.linalg.norm(linear - was) < 1e-11 * np.linalg.norm(was), body
        assert np.linalg.norm(angular - turned) < near * np.linalg.norm(turned), body


@pytest.mark.parametrize("solve, near, kept", [("iterate", 1e-7, 1e-9), ("auto", 1e-5, 1e-4)])
def test_a_free_body_keeps_its_momenta_and_moves_as_on_the_cpu(solve, near, kept):
    """Without the momenta that its forces make it would lose more than half of its spin. near: [m]."""
    make = lambda: scene(free(), dt=DT, integrator=STAGES | {"solve": solve}, update="lockstep-4", **EXACT)  # noqa: E731
    _, gpu = both(make, 60, turning, near=near)
    check_kept(gpu.sim, [0], kept)
    form = FORMS["ITERATE"] if solve == "iterate" else FORMS["FACTOR"]
    assert (gpu.records["form"][8:] == form).all()


def several() -> Scene:
    """Free, held, and free with a grab for some steps."""
    at = [{"name": name, "pose": {"translate": [0, 3 * k, 0]}} for k, name in enumerate(("free", "held", "grabbed"))]
    return scene(
        free(**at[0]), free(fixed="X < 0.01", **at[1]),
        free((3, 2, 1), young=1e5, touch={"max_force": 1000.0}, **at[2]),
        dt=DT, gravity=GRAVITY, integrator=STAGES | {"solve": "iterate"}, update="every-3", **EXACT,
    )  # fmt: skip


def test_a_grab_may_come_and_go():
    held_by: list[int] = []

    def grab(sim: Simulation, step: int) -> None:
        turning(sim, step)
        touch = sim.effects["touch"]
        if step == 5:
            held_by.append(touch.grab("me", "grabbed", (1.5, 7.0, 0.5), 0.0, (1.5, 7.2, 0.5), 400.0, 500.0, 10.0).id)
        if step == 12:
            touch.release("me", held_by.pop())

    both(several, 24, grab, near=1e-6)


@pytest.mark.parametrize("solve, kept", [("iterate", 1e-9), ("auto", 1e-4)])
def test_many_small_bodies_keep_their_momenta(solve, kept):
    """A thread block has nodes of several; each third is held."""
    bars = [
        free((1, 1, 1 + k % 3), name=f"b{k}", pose={"translate": [0, 2 * k, 0]},
             **({"fixed": "X < 0.01"} if k % 3 == 1 else {}))
        for k in range(60)
    ]  # fmt: skip
    made = scene(*bars, dt=DT, integrator=STAGES | {"solve": solve}, update="lockstep-4", **EXACT)
    gpu, again = (run("gpu", made, 12, turning) for _ in range(2))
    check_kept(gpu.sim, [k for k in range(60) if k % 3 != 1], kept)
    assert gpu.x.tobytes() == again.x.tobytes()
