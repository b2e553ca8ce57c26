# SPDX-License-Identifier: MIT
"""Parameters that change while steps run on a GPU."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.parameters.cases import CASES, both, same, table, texts
from tests.scenes import bar
from tests.scenes import scene as scene_of
from tests.system.test_parameters_of_a_server import parameters_set
from tests.system.test_replay_of_a_server import messages, recorded, replayed

pytestmark = pytest.mark.gpu
HERE = [name for name in CASES if name not in ("gas", "liquid")]  # which a GPU refuses


@pytest.mark.parametrize("name", HERE)
def test_what_is_set_is_as_if_it_had_been_in_the_scene(name: str) -> None:
    """To the bit, whatever else the loop has launched before."""
    one, other = both(CASES[name], "gpu")
    assert same(one, other)
    assert not same(one, unchanged(name))


def unchanged(name: str) -> Simulation:
    """The same steps with the values of the start."""
    case = CASES[name]
    sim = Simulation(Scene.model_validate(table(case)), "gpu")
    sim.engine.run(6 if case.start else 11)
    sim.fetch()
    return sim


def test_it_is_taken_between_batches_of_many_steps() -> None:
    """The answer does not depend on how many steps are launched together before it."""
    case = CASES["rayleigh"]
    found = []
    for steps in ((40, 7), (20, 13, 7, 7)):
        sim = Simulation(Scene.model_validate(table(case)), "gpu")
        for count in steps[:-1]:
            sim.engine.run(count)
        sim.parameters.set(texts(case))
        sim.engine.run(steps[-1])
        found.append(sim)
        assert sim.engine.step == 47
        sim.fetch()
    assert same(*found)


def test_a_change_of_stiffness_is_the_work_that_it_is_on_a_cpu() -> None:
    """And no record of a step before tells the energy after it."""
    found = {}
    for device in ("cpu", "gpu"):
        given = scene_of(bar((4, 1, 1), fixed="X < 0.01"), gravity=(0, -9.81, 0), dt=0.01, tolerance=1e-10)
        sim = Simulation(given, device)
        sim.engine.run(20)
        assert np.isnan(sim.engine.records()["elastic"]).all()
        sim.parameters.set({"bar.corotational.young": "1e7"})
        sim.engine.run(30)
        sim.parameters.set({"bar.corotational.young": "1e5"})
        sim.engine.run(30)
        records = sim.engine.records()
        assert (records["kinetic"] <= records["budget"]).all() and (records["status"] == 0).all()
        assert np.isnan(records["elastic"]).all()
        found[device] = records["work"][[0, 29, 30, -1]]
    np.testing.assert_allclose(found["gpu"], found["cpu"], rtol=1e-6)
    assert found["gpu"][0] > 0 and found["gpu"][2] < found["gpu"][1]


def test_a_recorded_run_is_repeated_bit_for_bit(tmp_path: Path) -> None:
    log = recorded(tmp_path, "", "cholesky", "--device", "gpu", "--realtime", touch=parameters_set)
    taken = [m.step for m in messages(log, "parameters")]
    assert len(taken) > 3 and taken == sorted(taken)
    assert replayed(log, 0, timeout=240)["same"]
