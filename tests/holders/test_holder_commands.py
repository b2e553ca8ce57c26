# SPDX-License-Identifier: MIT
"""Commands that move holders, what of them goes into messages, and what is refused of their tables; no network."""

import numpy as np
import pytest
from pydantic import ValidationError

from protocol import messages_pb2 as pb
from sim_server.errors import InputError
from sim_server.recording import messages
from sim_server.recording.obstacles import obstacle_messages, pose_messages
from sim_server.scene.messages import readable
from sim_server.service.commands import Commands
from sim_server.updates.worker_assembly import Assembly
from tests.holders.holder_scenes import held_bar, left, right


def moved(commands: Commands, name: str, *position: float, rotation: tuple | None = None) -> str:
    turn = None if rotation is None else pb.Quaternion(**dict(zip("wxyz", rotation, strict=True)))
    target = pb.ObstacleTarget(
        obstacle=name, position=pb.Vector(**dict(zip("xyz", position, strict=True))), rotation=turn
    )
    return commands.carry_out(pb.Command(client="anna", verb="move_obstacle", target=target)).error


def test_a_holder_goes_where_a_client_sends_it_at_its_speed():
    sim = held_bar(left(), right(moved="client", max_speed=0.5))
    commands = Commands(sim, lambda interaction, time: None)
    sim.engine.run(3)
    begun = sim.world.x[sim.world.rest[:, 0] > 1.99].mean(axis=0)
    assert moved(commands, "right", 2.1, 0.5, 0.5) == ""
    sim.engine.run(4)
    now = sim.world.x[sim.world.rest[:, 0] > 1.99].mean(axis=0)
    np.testing.assert_allclose(now - begun, [4 * 0.5 * 0.01, 0, 0], atol=1e-12)
    sim.engine.run(40)
    assert sim.world.x[sim.world.rest[:, 0] > 1.99].mean(axis=0) == pytest.approx([2.1, 0.5, 0.5])
    poses = {p.header.object: p for p in pose_messages(sim, sim.engine.step)}
    assert list(poses) == ["right"] and poses["right"].position.x == 2.1


@pytest.mark.parametrize(
    ("name", "position", "rotation", "said"),
    [
        ("left", (0, 0, 0), None, "holder 'left' is not moved by clients; holders with moved = \"client\": right"),
        ("top", (0, 0, 0), None, "no holder 'top'"),
        ("right", (np.inf, 0, 0), None, "must be finite numbers"),
        ("right", (0, 1e9, 0), None, "1000 times its size"),
        ("right", (0, 0, 0), (2, 0, 0, 0), "must be a quaternion of length 1"),
    ],
)
def test_bad_moves_are_refused(name, position, rotation, said):
    sim = held_bar(left(), right(moved="client"))
    before = sim.holders.targets["right"]
    assert said in moved(Commands(sim, lambda interaction, time: None), name, *position, rotation=rotation)
    np.testing.assert_array_equal(sim.holders.targets["right"], before)


def test_messages_name_holders_and_the_forces_on_them():
    sim = held_bar(left(), right(keyframes=[{"time": 1.0, "translate": [0.1, 0, 0]}]))
    shapes = {o.header.object: o for o in obstacle_messages(sim)}
    assert {name: (o.shape, o.moved) for name, o in shapes.items()} == {
        "left": ("holder", ""), "right": ("holder", "keyframes"),
    }  # fmt: skip
    assert messages.scene(sim).obstacles == ["left", "right"]
    sim.engine.run(20)
    records, reactions = sim.engine.records_and_reactions()
    told = messages.reactions(sim, reactions, sim.engine.other_reactions())
    last = messages.steps(sim, records, "", told)[-1]
    forces = {r.obstacle: r.force.x for r in last.reactions}
    assert forces["left"] > 0 > forces["right"]
    assert pose_messages(sim, 20)[0].position.x == pytest.approx(2 + 0.1 * 0.2), "from where it begins at time 0"


def test_a_worker_assembles_the_matrix_of_held_bodies():
    keys = [{"time": 0.0}, {"time": 0.2, "translate": [0, 0.3, 0]}]
    for integrator in ({}, {"linearizations": 3}):
        sim = held_bar(left(keyframes=keys), gravity=(0, -9.81, 0), integrator=integrator)
        assembly = Assembly(messages.scene(sim), messages.topology(sim, sim.world.bodies[0]))
        sim.engine.run(5)
        x = sim.world.x.copy()
        if integrator:  # a search begins with held nodes where the step ends
            x[sim.world.free == 0, 1] += 0.3 * 0.01 / 0.2
        sim.engine.assemble()
        np.testing.assert_allclose(assembly.matrix(x), sim.system.values, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("holders", "keys", "said"),
    [
        ([left(where="X < -1")], {}, "holds 0 of"),
        ([left(where="true")], {}, "must hold some and leave some free"),
        ([left()], {"fixed": "Y < 0.3"}, "a node is held once"),
        ([left(), right(where="X < 0.6")], {}, "a node is held once"),
        ([left(where="X < 1.2")], {"fixed": "X > 1.2"}, "no node of object 'bar' is left free"),
        ([left(), left(where="X > 1.9")], {}, "more than once: left"),
        ([left(name="bar")], {}, "more than once: bar"),
        ([left(object="beam")], {}, "no object 'beam'"),
        ([left(keyframes=[{"time": 0.0, "translate": [1, 0, 0]}])], {}, "that of time 0 must be without"),
        ([left(moved="client", keyframes=[{"time": 1.0}])], {}, "allowed is one of the two"),
        ([left(max_speed=1.0)], {}, 'without moved = "client"'),
    ],
)
def test_tables_that_cannot_be_are_refused(holders, keys, said):
    with pytest.raises((InputError, ValidationError)) as caught:
        held_bar(*holders, **keys)
    error = caught.value
    assert said in (
        str(readable(error, "held.toml", {"holder": holders})) if isinstance(error, ValidationError) else str(error)
    )
