# SPDX-License-Identifier: MIT
"""Energies and runaways on a GPU beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.messages_pb2 import RUNAWAY
from sim_server.effects.touch import Touch
from sim_server.simulation import Simulation
from tests.gpu.test_loads_on_gpu import made as loaded
from tests.scenes import bar, scene
from tests.state import put

pytestmark = pytest.mark.gpu

TIGHT: dict[str, Any] = {"tolerance": 1e-10, "preconditioner": "block_jacobi", "max_iterations": 4000}
ENERGIES = ("kinetic", "elastic", "gravity", "work", "budget")
WILD = {"neo_hookean": {"young": 1e6, "poisson": 0.45, "inversion": "regularize"}, "fixed": {"where": "X < 0.01"}}


def objects() -> list[dict]:
    """Of several sizes and laws, so that bodies share warps and thread blocks of their nodes."""
    law = {"stable_neo_hookean": {"young": 3e4, "poisson": 0.3}, "fixed": {"where": "X < 0.01"}}
    return [
        bar((4, 2, 2), name="a", young=2e4, fixed="X < 0.01", touch={"max_force": 1e4}),
        bar((1, 1, 1), name="small", young=5e4),
        bar((5, 2, 1), name="law", young=None, effects=law),
        bar((6, 3, 3), (3, 1, 1), name="b", young=1e5, fixed="X < 0.01", touch={"max_force": 1e4}, damping=(0.1, 0.01)),
    ]


def run(sim: Simulation, steps: int) -> NDArray[Any]:
    """Records (steps, bodies), with a push and a grab that moves."""
    touch = sim.effects.get("touch")
    if isinstance(touch, Touch):
        touch.push("me", "a", (2.0, 0.5, 0.5), 0.8, (0.0, 200.0, 50.0), 0.05)
        held = touch.grab("me", "b", (3.0, 1.0, 1.0), 0.4, (3.2, 1.0, 1.0), 2e4, 1e4, 10.0)
    found = []
    for step in range(steps):
        if isinstance(touch, Touch):
            touch.move("me", held.id, (3.2, 1.0 + 0.02 * step, 1.0))
        sim.engine.run(1)
        found.append(sim.engine.records())
    return np.array(found)


INTEGRATORS = [
    {}, {"linearizations": 4, "tolerance": 1e-8}, {"scheme": "newmark", "linearizations": 4, "tolerance": 1e-8},
    {"scheme": "bdf2", "linearizations": 4, "tolerance": 1e-8},
    {"scheme": "generalized_alpha", "linearizations": 4, "tolerance": 1e-8},
]  # fmt: skip


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=lambda i: i.get("scheme", "backward_euler") + str(len(i)))
def test_energies_are_those_of_the_cpu(integrator):
    made = scene(*objects(), dt=0.01, gravity=(0.5, -9.81, 1.0), integrator=integrator, **TIGHT)
    found = {}
    for device in ("gpu", "cpu"):
        sim = Simulation(made, device)
        sim.engine.loop.energy_every = 2
        v = np.zeros_like(sim.world.v)
        v[sim.world.body("small").nodes] = np.random.default_rng(0).normal(size=(8, 3))
        put(sim, sim.world.v, v)
        found[device] = run(sim, 12)
    gpu, cpu = found["gpu"], found["cpu"]
    known = np.isfinite(cpu["elastic"])
    assert (np.isfinite(gpu["elastic"]) == known).all() and known[1::2].all() and not known[::2].any()
    scale = np.abs(cpu["gravity"]).max(axis=0)
    for name in ENERGIES:
        here = known if name == "elastic" else np.ones_like(known)
        difference = np.where(here, np.abs(np.nan_to_num(gpu[name]) - np.nan_to_num(cpu[name])), 0)
        assert (difference <= 1e-7 * scale).all(), name
    assert (np.abs(cpu["work"][-1, [0, 3]]) > 1).all() and not cpu["work"][:, 1].any()
    np.testing.assert_allclose(gpu["stride"], cpu["stride"], rtol=1e-4)


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_energies_in_other_precisions(precision):
    found = {}
    for device, chosen in (("gpu", precision), ("cpu", "float64")):
        made = scene(*objects(), dt=0.01, gravity=(0, -9.81, 0), preconditioner="block_jacobi", precision=chosen)
        sim = Simulation(made, device)
        sim.engine.loop.energy_every = 1
        found[device] = run(sim, 10)
    for name in ENERGIES:
        scale = np.abs(found["cpu"]["gravity"]).max(axis=0)
        assert (np.abs(found["gpu"][name] - found["cpu"][name]) <= 1e-3 * scale).all(), name
    assert (found["gpu"]["status"] != RUNAWAY).all()


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
@pytest.mark.parametrize("name", ["cable", "membrane", "rod", "target"])
def test_energies_of_loads_are_summed_in_the_type_that_they_have(tmp_path, name, precision):
    """A kernel writes them as `real` or as `local`, which differ in mixed precision."""
    found = {}
    for device, chosen in (("gpu", precision), ("cpu", "float64")):
        sim = loaded(tmp_path, [name], device, precision=chosen, preconditioner="block_jacobi")
        sim.engine.loop.energy_every = 1
        sim.engine.run(5)
        found[device] = sim.engine.records()
    assert (found["gpu"]["status"] != RUNAWAY).all()
    for column in ("elastic", "budget"):
        scale = np.abs(found["cpu"][column]).max() + np.abs(found["cpu"]["gravity"]).max() * 1e-2
        assert np.abs(found["gpu"][column] - found["cpu"][column]).max() <= 2e-3 * scale, column


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
def test_a_cable_that_is_drawn_in_does_not_run_away(precision):
    """What the change of its length adds to the elastic energy is work."""
    cable = {"path": [[0, 0.5, 0.5], [1, 0.5, 0.5], [2, 0.5, 0.5]], "stiffness": 2e4, "shortening": 0.0}
    body = bar((4, 2, 2), (2, 1, 1), young=1e5, fixed="X < 0.01", damping=(5.0, 0.0))
    body["effects"]["cable"] = cable
    sim = Simulation(scene(body, dt=0.01, preconditioner="block_jacobi", precision=precision), "gpu")
    for step in range(20):
        sim.parameters.set({"bar.cable.shortening": f"{0.05 * step:g}"})
        sim.engine.run(1)
    records = sim.engine.records()
    assert (records["status"] != RUNAWAY).all() and records["work"][-1] > 1


def released(device: str, on_runaway: str, names: tuple[str, ...] = ("calm", "wild", "other")) -> Simulation:
    """The wild one from three times its length."""
    listed = {
        "calm": bar((4, 2, 2), name="calm", young=2e4, fixed="X < 0.01"),
        "wild": bar((4, 2, 2), (2, 0.5, 0.5), name="wild", young=None, effects=WILD),
        "other": bar((3, 2, 2), name="other", young=2e4, fixed="X < 0.01"),
    }
    made = scene(
        *(listed[name] for name in names), gravity=(0, -9.81, 0), preconditioner="block_jacobi", projection="clamp",
        max_iterations=3000, on_runaway=on_runaway,
    )  # fmt: skip
    sim = Simulation(made, device)
    x = sim.world.x.copy()
    if "wild" in names:
        nodes = sim.world.body("wild").nodes
        x[nodes] = sim.world.rest[nodes] * [3, 1, 1]
    put(sim, sim.world.x, x)
    return sim


def test_a_runaway_is_frozen_in_its_step_and_neighbours_do_not_notice():
    sim, cpu, alone = released("gpu", "freeze"), released("cpu", "freeze"), released("gpu", "freeze", ("calm", "other"))
    mine = sim.world.body("wild").nodes
    before, first = None, None
    for step in range(30):
        sim.fetch()
        x = sim.world.x[mine].copy()
        sim.engine.run(1)
        if sim.engine.records()["status"][1] == RUNAWAY and first is None:
            before, first = x, step
    cpu.engine.run(30)
    alone.engine.run(30)
    status = cpu.engine.records()["status"].reshape(-1, 3)[:, 1].tolist()
    assert first is not None and abs(status.index(RUNAWAY) - first) <= 1 and first > 0
    sim.fetch()
    alone.fetch()
    np.testing.assert_array_equal(sim.world.x[mine], before)
    assert not sim.world.v[mine].any()
    for name in ("calm", "other"):
        a, b = sim.world.body(name).nodes, alone.world.body(name).nodes
        assert sim.world.x[a].tobytes() == alone.world.x[b].tobytes()
        assert sim.world.v[a].tobytes() == alone.world.v[b].tobytes()
    sim.engine.loop.energy_every = 1
    sim.engine.run(20)  # also by graphs of many steps
    records = sim.engine.records().reshape(-1, 3)
    assert (records["status"][:, 1] == RUNAWAY).all() and not records["iterations"][:, 1].any()
    assert not records["kinetic"][:, 1].any() and np.isfinite(records["elastic"]).all()
    sim.fetch()
    np.testing.assert_array_equal(sim.world.x[mine], before)


def test_going_on_is_only_told():
    sim = released("gpu", "go_on", ("wild",))
    sim.engine.run(12)
    assert (sim.engine.records()["status"] == RUNAWAY).any()
    sim.fetch()
    assert not np.abs(sim.world.x).max() < 1e3


@pytest.mark.parametrize("integrator", INTEGRATORS[1:], ids=lambda i: i.get("scheme", "backward_euler"))
def test_a_frozen_body_stays_in_every_scheme(integrator):
    """A state set without a word to the account has energy from nowhere."""
    made = scene(bar(name="a", young=1e5), bar(name="b", young=1e5), integrator=integrator, dt=0.01, **TIGHT)
    sim = Simulation(made, "gpu")
    sim.engine.run(3)
    sim.fetch()
    nodes, v = sim.world.bodies[0].nodes, sim.world.v.copy()
    v[nodes] = [0, 300.0, 0]
    put(sim, sim.world.v, v)
    sim.engine._energies.started = True  # put has asked for a new start
    x = sim.world.x[nodes].copy()
    sim.engine.run(1)
    sim.engine.run(5)
    status = sim.engine.records()["status"].reshape(-1, 2)
    assert (status[3:, 0] == RUNAWAY).all() and (status[:, 1] != RUNAWAY).all()
    sim.fetch()
    np.testing.assert_array_equal(sim.world.x[nodes], x)
    assert not sim.world.v[nodes].any()


def test_runs_repeat_to_the_bit():
    found = []
    for _ in range(2):
        sim = Simulation(scene(*objects(), dt=0.01, gravity=(0, -9.81, 0), preconditioner="block_jacobi"), "gpu")
        sim.engine.loop.energy_every = 3
        records = run(sim, 20)
        found.append([records[name].tobytes() for name in (*ENERGIES, "stride")])
    assert found[0] == found[1]
