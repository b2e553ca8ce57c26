# SPDX-License-Identifier: MIT
"""Forces on obstacles, grabs and other bodies together are what changes the momentum of each body."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.backends.cpu.structs import REACTION_KINDS
from sim_server.recording import messages
from sim_server.simulation import Simulation

DT = 0.01
CUBE = """
[[object]]
name = "{name}"
mesh = {{ bar = [2, 2, 2], size = [0.1, 0.1, 0.1], split = "kuhn" }}
pose = {{ translate = {at}, rotate = {turned} }}
[object.effects]
corotational = {{ young = 1e5, poisson = 0.4 }}
touch = {{ max_force = 50 }}
"""
SCENE = f"""
dt = {DT}
[effects]
gravity = {{ g = [0, -9.81, 0] }}
contact = {{ tolerance = 1e-10, passes = 200 }}
[solver]
tolerance = 1e-12
preconditioner = "block_jacobi"
[[obstacle]]
name = "floor"
shape = "plane"
[[obstacle]]
name = "wall"
shape = "box"
size = [0.1, 1, 1]
pose = {{ translate = [-0.06, 0.5, 0] }}
""" + "".join(
    CUBE.format(name=name, at=at, turned=turned)
    for name, at, turned in (
        ("a", [0, 0.002, 0], [0, 0, 0]), ("b", [0.01, 0.11, 0.01], [0, 20, 0]), ("c", [0, 0.23, 0], [10, 0, 0])
    )
)  # fmt: skip
STRONG, WEAK = 1, 2  # ids of the grabs


@pytest.fixture(scope="module")
def sim(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    path: Path = tmp_path_factory.mktemp("scene") / "stack.toml"
    path.write_text(SCENE)
    found = Simulation.load(path)
    touch = found.touch
    assert touch is not None
    touch.grab("anna", "b", (0.1, 0.16, 0.06), 0.05, (0.2, 0.2, 0.06), 300.0, 40.0, np.inf)
    touch.grab("ben", "c", (0.05, 0.33, 0.05), 0.05, (0.0, 0.6, 0.05), 1e4, 3.0, np.inf)
    touch.push("carl", "a", (0.1, 0.05, 0.05), 0.05, (-2.0, 0.0, 0.0), 10.0)
    return found


def momenta(sim: Simulation) -> np.ndarray:
    world = sim.fetch()
    return np.array([world.mass[b.nodes] @ world.v[b.nodes] for b in world.bodies])


def wrenches_are_contrary(sim: Simulation, told: np.ndarray) -> int:
    """Of each pair of bodies both have the same force and torque about the same point, but for the sign."""
    pairs = {(r["body"], r["number"]): r for r in told if r["kind"] == REACTION_KINDS["ON_OBJECT"]}
    for (body, other), r in pairs.items():
        back, x = pairs[other, body], sim.world.x
        assert (r["force"] == -back["force"]).all() and (r["torque"] == -back["torque"]).all()
        assert (r["point"] == back["point"]).all()
        nodes = x[sim.world.bodies[body].nodes]
        assert ((nodes.min(axis=0) - 0.02 < r["point"]) & (r["point"] < nodes.max(axis=0) + 0.02)).all()
    return len(pairs)


def test_momentum_of_each_body_changes_by_what_acts_on_it(sim: Simulation) -> None:
    names = [b.name for b in sim.world.bodies]
    weights = np.array([[0, -9.81 * sim.world.mass[b.nodes].sum(), 0] for b in sim.world.bodies])
    before, seen, pairs = momenta(sim), set(), 0
    for _ in range(60):
        sim.engine.run(1)
        records, on_obstacles = sim.engine.records_and_reactions()
        exerted = messages.reactions(sim, on_obstacles, sim.engine.other_reactions())
        after, expected = momenta(sim), weights.copy()
        expected[0, 0] -= 2.0  # the push
        for step in messages.steps(sim, records, reactions=exerted):
            for r in step.reactions:
                seen.add(r.obstacle or r.object or r.grab)
                expected[names.index(step.header.object)] -= [r.force.x, r.force.y, r.force.z]
        assert set(records["status"]) == {0} and not records["clipped"].any()
        np.testing.assert_allclose((after - before) / DT, expected, atol=1e-6)
        before = after
        pairs += wrenches_are_contrary(sim, exerted.others)
    assert pairs > 20
    assert seen == {"floor", "wall", "a", "b", "c", STRONG, WEAK}


def test_a_grab_pulls_no_more_than_its_limit_and_a_released_one_not_at_all(sim: Simulation) -> None:
    sim.engine.run(3)
    sim.engine.records()
    told = sim.engine.other_reactions()
    grabs = told[told["kind"] == REACTION_KINDS["ON_GRAB"]]
    weak = grabs[grabs["number"] == WEAK]
    assert len(weak) == 3 and {sim.world.bodies[k].name for k in weak["body"]} == {"c"}
    np.testing.assert_allclose(np.linalg.norm(weak["force"], axis=1), 3.0, rtol=0.05)
    assert sim.touch is not None
    sim.touch.release("ben", WEAK)
    sim.engine.run(2)
    sim.engine.records()
    told = sim.engine.other_reactions()
    assert set(told["number"][told["kind"] == REACTION_KINDS["ON_GRAB"]]) == {STRONG}


def test_what_is_held_by_nobody_tells_nothing(sim: Simulation) -> None:
    assert sim.touch is not None
    sim.touch.release_all("anna")
    sim.engine.run(2)
    sim.engine.records()
    told = sim.engine.other_reactions()
    assert set(told["kind"]) <= {REACTION_KINDS["ON_OBJECT"]} and sim.engine.loop.others_dropped == 0
