# SPDX-License-Identifier: MIT
"""On a GPU, too, the first step waits for the factors of its own matrices, and is then as any such step."""

import pytest

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline
from sim_server.updates.first_factors import FirstFactors
from tests.scenes import bar

pytestmark = pytest.mark.gpu
DEVICE = "gpu"

UPPER = bar((3, 2, 2), (1, 1, 1), name="upper", pose={"translate": [0, 1.0, 0]})
TOUCHING = {"object": [bar((3, 2, 2), (1, 1, 1), name="lower"), UPPER], "obstacle": [{"name": "f", "shape": "plane"}]}
HELD = {"object": [bar((6, 2, 2), fixed="X < 0.01", name="a"), bar((4, 3, 3), fixed="X < 0.01", name="b")]}
SCENES = {
    "two bodies": HELD, "contact": TOUCHING, "ros2": HELD | {"integrator": {"scheme": "ros2"}},
    "newton": HELD | {"integrator": {"scheme": "newmark", "linearizations": 4}},
}  # fmt: skip


def built(table: dict) -> Simulation:
    effects: dict = {"gravity": {"g": [0, -9.81, 0]}} | ({"contact": {}} if "obstacle" in table else {})
    table = {"name": "t", "dt": 0.02, "effects": effects, "solver": {"preconditioner": "cholesky"}} | table
    return Simulation(Scene.model_validate(table), DEVICE)


@pytest.mark.parametrize("table", SCENES.values(), ids=SCENES)
def test_the_first_step_is_solved_by_the_factors_of_its_own_matrices(table: dict) -> None:
    sim, twin = built(table), built(table)
    patterns = {b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies}
    driver, other = Driver(sim, Inline(patterns)), Driver(twin)
    first = FirstFactors(driver)
    assert first.run() and first.missing == [] and first.seconds < 30
    records, expected = driver.advance(0), other.step_with_fresh_factors()
    assert records["factor_step"].tolist() == [0, 0]
    assert records["iterations"].tolist() == expected["iterations"].tolist()
    assert (records["whole"] < first.seconds + 1).all() and (records["whole"] > 0).all()
    driver.advance(3)  # and the loop goes on from there
    assert sim.engine.step == 4 and twin.fetch().x.shape == sim.fetch().x.shape


def test_both_end_their_first_step_alike() -> None:
    sim, twin = built(TOUCHING), built(TOUCHING)
    patterns = {b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies}
    assert FirstFactors(Driver(sim, Inline(patterns))).run()
    Driver(twin).step_with_fresh_factors()
    assert sim.fetch().x.tobytes() == twin.fetch().x.tobytes()
