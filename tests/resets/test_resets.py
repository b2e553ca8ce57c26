# SPDX-License-Identifier: MIT
"""Objects, and whole scenes, that are put back to the start: what follows is what followed from it, to the bit."""

from typing import Any

import numpy as np
import pytest

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from tests.physics.test_runaway import WILD
from tests.resets import state_scenes
from tests.resets.state_scenes import SCENES, made
from tests.scenes import bar, simulation

TIMED = ("step", "time", "assemble", "solve", "integrate", "whole", "late", "begin", "cpu")


def course(sim: Simulation, steps: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Positions after the steps, and their records without what a clock says."""
    sim.engine.run(steps)
    records = sim.engine.records()
    return sim.fetch().x.copy(), records[[name for name in records.dtype.names if name not in TIMED]]


def same(a: tuple[Any, Any], b: tuple[Any, Any]) -> bool:
    return np.array_equal(a[0], b[0]) and all(
        np.array_equal(a[1][n], b[1][n], equal_nan=a[1][n].dtype.kind == "f") for n in a[1].dtype.names
    )


@pytest.mark.parametrize("name", sorted(set(SCENES) - {"ros2", "central_difference"}))
def test_a_scene_that_is_reset_does_the_same_again(name: str) -> None:
    """Beside what is a cache: without factors, and without the estimates of stable substeps."""
    sim = made(name, preconditioner="block_jacobi")
    start = Start(sim)
    first = course(sim)
    if sim.movers and name != "held":
        sim.movers[0].move("tool", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        sim.engine.run(3)
        sim.engine.records()
    start.reset()
    assert same(course(sim), first)
    assert name != "attached" or (sim.ties is not None and sim.ties.broken.all()), "it breaks, and did so before"


def test_one_object_is_reset_and_the_others_go_on() -> None:
    """Both fall freely: what happens to one is not seen by the other."""
    sims = [
        simulation(bar(name="a"), bar(name="b", pose={"translate": [0, 5, 0]}), gravity=(0, -9.81, 0)) for _ in "xy"
    ]
    start = Start(sims[0])
    for sim in sims:
        first = course(sim)
    start.reset("a")
    a, b = (sims[0].world.body(name).nodes for name in "ab")
    again, alone = (course(sim) for sim in sims)
    np.testing.assert_array_equal(again[0][a], first[0][a])
    np.testing.assert_array_equal(again[0][b], alone[0][b])
    assert not np.array_equal(again[0][a], alone[0][a])
    with pytest.raises(KeyError, match="no object 'c'"):
        start.reset("c")


def test_a_body_that_ran_away_moves_again() -> None:
    """Released from three times its length it flies apart, is frozen, put back to that and does so again."""
    sim = simulation(
        bar((4, 2, 2), (2, 0.5, 0.5), young=None, effects=WILD), preconditioner="block_jacobi", projection="clamp",
        max_iterations=3000,
    )  # fmt: skip
    sim.world.x *= [3, 1, 1]
    start = Start(sim)
    first = course(sim, 10)
    assert (sim.world.free == 0).all(), "frozen"
    start.reset()
    assert sim.world.free.sum() == 4 * 9
    assert same(course(sim, 10), first)


def test_the_keyframes_of_a_reset_scene_begin_again() -> None:
    from tests.contact_scene import contact_simulation

    sim = contact_simulation()
    start = Start(sim)
    sim.engine.run(25)
    there = sim.contact.end[2].copy() if sim.contact else None
    start.reset()
    sim.engine.run(25)
    assert sim.contact is not None
    np.testing.assert_allclose(sim.contact.end[2], there, atol=1e-12)
    np.testing.assert_allclose(sim.contact.pose_at("paddle", 0.5), there, atol=1e-12)


def test_the_start_is_before_the_first_step() -> None:
    sim = simulation(bar(fixed="X < 0.01"))
    sim.engine.run(1)
    with pytest.raises(ValueError, match="has made 1 steps"):
        Start(sim)


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha"])
def test_a_reset_begins_with_the_parameters_that_were_set(scheme: str) -> None:
    """Without weight a body at rest stays so, while another one goes on as if there had been no reset."""
    pair = bar(fixed="X < 0.01", name="a"), bar(fixed="X < 0.01", name="b", pose={"translate": [0, 5, 0]})
    sims = [simulation(*pair, gravity=(0, -9.81, 0), integrator={"scheme": scheme}) for _ in "xy"]
    start, x0 = Start(sims[0]), sims[0].world.x.copy()
    sims[1].engine.prepare()
    a, b = (sims[0].world.body(name).nodes for name in "ab")
    for sim in sims:
        sim.engine.run(10)
        sim.parameters.set({"gravity.g": "[0, 0, 0]"})
    start.reset("a")
    assert not sims[0].engine.withdraw_changes(), "the loop has them before the reset"
    (x, records), (alone, _) = (course(sim, 5) for sim in sims)
    np.testing.assert_allclose(x[a], x0[a], rtol=0, atol=1e-15)
    assert (records["status"] == 0).all()
    np.testing.assert_array_equal(x[b], alone[b])
    start.reset()
    np.testing.assert_allclose(course(sims[0], 5)[0], x0, rtol=0, atol=1e-15)


def test_a_reset_finds_all_rows_of_contacts_before_it_writes_any() -> None:
    """Those of the other object that touched it, too, are as at the start in all that is known of them."""
    table = state_scenes.table([state_scenes.cube(), state_scenes.cube("next", y=0.205)], obstacle=[state_scenes.FLOOR])
    sim = Simulation(Scene.model_validate(table | {"solver": {"preconditioner": "block_jacobi", "update": "never"}}))
    start = Start(sim)
    sim.engine.run(80)
    assert sim.contact is not None
    rows = sim.contact.contact_input()
    touching = (rows.obstacle >= 0) & (np.abs(rows.force) > 0)
    of_pair = np.flatnonzero(touching)[np.flatnonzero(touching) >= len(sim.contact.node) * 2]
    assert len(of_pair), "the one rests on the other"
    start.reset("next")
    assert (rows.obstacle[of_pair] == -1).all() and not rows.force[of_pair].any() and not rows.normal[of_pair].any()
