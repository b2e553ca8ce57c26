# SPDX-License-Identifier: MIT
"""Steps of several linearizations as a GPU makes them, its kernels run by threads of the processor: in a loop and
unrolled to the same bits, and beside the loop of the CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.simulation import Simulation
from tests.backends.newton_on_threads import OnThreads, compiled
from tests.scenes import bar, simulation

TIGHT = {"tolerance": 1e-12, "preconditioner": "block_jacobi", "max_iterations": 4000}
KERNELS = ["begin_newton", "pcg", "update_state", "accept_trial", "end_newton"]
SOFT = {"young": 3e4, "poisson": 0.35}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("newton"))


def of_law(law: str, **table: Any) -> dict[str, Any]:
    constants = table.pop("constants", SOFT)
    made = bar((3, 1, 1), (2, 0.8, 0.8), young=None, fixed="X < 0.01", **table)
    made["effects"][law] = dict(constants)
    return made


def thrown(sim: Simulation, *velocities: tuple[float, float, float]) -> Simulation:
    """The free nodes of each body begin with a velocity [m/s]."""
    w = sim.world
    for body, velocity in zip(w.bodies, velocities, strict=True):
        w.v[body.nodes] = w.free[body.nodes, None] * np.array(velocity)
    return sim


def crowd() -> Simulation:
    """At rest, stiff, soft, of another law: each has its own way to converge."""
    at = [{"pose": {"translate": [0, 3 * k, 0]}} for k in range(4)]
    sim = simulation(
        bar((2, 1, 1), (1, 0.5, 0.5), name="idle", young=1e6, **at[0]),
        bar((4, 1, 1), (2, 0.8, 0.8), name="stiff", young=1e7, fixed="X < 0.01", **at[1]),
        bar((20, 1, 1), (6, 0.3, 0.3), name="soft", young=2e4, poisson=0.45, fixed="X < 0.01", **at[2]),
        of_law("stable_neo_hookean", name="law", **at[3]),
        dt=0.04, integrator={"linearizations": 12, "trials": 3, "tolerance": 1e-7}, **TIGHT,
    )  # fmt: skip
    return thrown(sim, (0, 0, 0), (0.1, 0.5, 0), (-1.2, -6, 0), (0.6, 3, 0))


def overshooting() -> Simulation:
    """A soft beam that falls into its equilibrium at once, along tangents that lead too far."""
    search = {"scheme": "quasi_static", "linearizations": 25, "trials": 5, "tolerance": 1e-6}
    held = of_law("stable_neo_hookean", constants={"young": 3e4, "poisson": 0.4})
    return simulation(held, dt=0.2, gravity=(0, -9.81, 0), integrator=search, projection="none", **TIGHT)


def crushed() -> Simulation:
    """neo_hookean refuses elements that are turned inside out: their forces are not finite."""
    search = {"linearizations": 12, "trials": 0, "tolerance": 1e-6}
    lost = of_law("neo_hookean", constants={"young": 2e4, "poisson": 0.3})
    other = bar((3, 1, 1), (2, 0.5, 0.5), name="other", fixed="X < 0.01")
    return thrown(simulation(lost, other, dt=0.1, integrator=search, **TIGHT), (-20, 6, 0), (0, 1, 1))


@pytest.mark.parametrize(("made", "steps"), [(crowd, 3), (overshooting, 1), (crushed, 2)])
def test_a_loop_makes_the_steps_of_the_unrolled_form_to_the_bit(library, monkeypatch, made, steps):
    looped, unrolled = (OnThreads(library, made(), monkeypatch, loops) for loops in (True, False))
    cpu, most, status = made(), 0, set()
    for number in range(steps):
        told, same = looped.step(number), unrolled.step(number)
        assert looped.ran == unrolled.ran
        for name in ("linearizations", "nonlinear"):
            assert told[name].tobytes() == same[name].tobytes(), name
        for name in ("iterations", "status", "bad_node", "residual"):
            assert looped.results[name].tobytes() == unrolled.results[name].tobytes(), name
        for name in ("x", "v", "predictor"):
            ours, theirs = (getattr(run.sim.world, name) for run in (looped, unrolled))
            assert ours.tobytes() == theirs.tobytes(), name
        assert looped.sim.system.values.tobytes() == unrolled.sim.system.values.tobytes()
        cpu.engine.run(1)
        records = cpu.engine.records()
        assert told["linearizations"].tolist() == records["linearizations"].tolist()
        assert looped.results["status"][0].tolist() == records["status"].tolist()
        assert looped.results["bad_node"][0].tolist() == records["bad_node"].tolist()
        assert np.abs(looped.sim.world.x - cpu.world.x).max() < 1e-8
        most, status = max(most, int(told["linearizations"].max())), status | set(records["status"].tolist())
        trials = looped.ran.count("accept_trial")
        solved = [k for k, name in enumerate(looped.ran) if name == "rotate_blocks"]
        if len(told) == 1:
            assert len(solved) == told["linearizations"][0] - 1  # none after the last
        assert trials > len(solved) and all(looped.ran[k + 1] == "pcg" for k in solved)
    assert most > 2
    assert (SolveStatus.NOT_FINITE in status) == (made is crushed)
    assert (trials > most) == (made is overshooting)


def test_a_step_that_needs_one_linearization_assembles_forces_once_more(library, monkeypatch):
    """No loop, no blocks, and A stays that of the first linearization, which factors are made of."""
    search = {"linearizations": 4, "tolerance": 0.9}
    made = [simulation(bar((2, 1, 1), fixed="X < 0.01"), integrator=search, **TIGHT) for _ in range(2)]
    one, other = (thrown(sim, (0.0, 0.1, 0.0)) for sim in made)
    run = OnThreads(library, one, monkeypatch)
    other.engine.assemble()
    told = run.step(0)
    assert told["linearizations"].tolist() == [1] and 0 < told["nonlinear"][0] < 0.9
    assert [name for name in run.ran if name in KERNELS] == KERNELS
    assert run.ran.count("rotate") == 1 and "rotate_blocks" not in run.ran
    assert np.array_equal(one.system.values, other.system.values)
