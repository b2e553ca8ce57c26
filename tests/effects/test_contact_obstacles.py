# SPDX-License-Identifier: MIT
"""Obstacles in motion and the rows of surface nodes that may touch them in a step, against plain references."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from sim_server.backends.base import PendingUpdate
from sim_server.effects._base import Effect
from sim_server.effects._movable import MoveError
from sim_server.effects.contact import Contact
from sim_server.errors import InputError
from sim_server.mesh.surface import surface_triangles
from sim_server.scene.model import Scene
from sim_server.scene.pose import Pose, quaternion
from sim_server.simulation import Simulation
from tests.reference import contact_rows, shapes
from tests.scenes import bar, random_rotations

H = 0.01
G = (0.5, -9.81, 0.3)
FLOOR = {"name": "floor", "shape": "plane"}


def made(*obstacles: dict, bars: list[dict] | None = None, gravity: Any = G, **contact: Any) -> Simulation:
    """A scene of bars of 1 x 0.5 x 0.5 m and obstacles."""
    effects = {"contact": contact} | ({"gravity": {"g": list(gravity)}} if gravity else {})
    table = {
        "name": "test", "dt": H, "effects": effects, "obstacle": list(obstacles),
        "object": bars or [bar((3, 2, 2), (1, 0.5, 0.5))],
    }  # fmt: skip
    return Simulation(Scene.model_validate(table, context={"folder": "."}))


def contact_of(sim: Simulation) -> Contact:
    found = sim.effects["contact"]
    assert isinstance(found, Contact)
    return found


def rows_of(effect: Contact) -> Any:
    """The rows of nodes against obstacles, without those of triangles and between bodies that follow: views."""
    held = effect.contact_input()
    count, rows = held.body_start[-1], len(held.obstacle)
    names = ("corner", "weight", "obstacle", "normal", "gap", "drift", "entry", "stiffness", "friction", "thickness")
    cut = {name: getattr(held, name)[:count] for name in (*names, "force", "traction")}
    return SimpleNamespace(obstacles=held.obstacles, body_start=held.body_start, all=rows, **cut)


SHAPES: dict[str, tuple[dict, contact_rows.Distance]] = {
    "plane": ({}, shapes.plane),
    "sphere": ({"radius": 0.3}, lambda p: shapes.sphere(p, 0.3)),
    "box": ({"size": [0.6, 0.2, 0.4]}, lambda p: shapes.box(p, np.array([0.3, 0.1, 0.2]))),
    "capsule": ({"radius": 0.1, "length": 0.5}, lambda p: shapes.capsule(p, 0.1, 0.25)),
}


def obstacle(shape: str, random: np.random.Generator, moving: bool) -> dict:
    """Somewhere in the bar; moving: it goes and turns in a step."""
    place, angles = random.uniform([0, 0, 0], [1, 0.5, 0.5]), random.uniform(-180, 180, 3)
    first = {"rotate": angles.tolist(), "translate": place.tolist()}
    if not moving:
        return {"shape": shape, **SHAPES[shape][0], "pose": first}
    then = {"rotate": (angles + random.uniform(-2, 2, 3)).tolist(),
            "translate": (place + random.uniform(-0.05, 0.05, 3)).tolist()}  # fmt: skip
    return {"shape": shape, **SHAPES[shape][0], "keyframes": [{"time": 0.0, **first}, {"time": H, **then}]}


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_rows_are_those_of_the_reference(seed, moving):
    random = np.random.default_rng(seed)
    names = random.choice(list(SHAPES), 3)
    listed = [{"name": f"o{k}", **obstacle(str(name), random, moving)} for k, name in enumerate(names)]
    pair = {"between": ["bar", "o1"], "value": 0.07}
    sim = made(*listed, bars=[bar((5, 3, 3), (1, 0.5, 0.5))], thickness=0.02, friction=[pair])
    effect, world = contact_of(sim), sim.world
    world.x += random.normal(0, 0.03, world.x.shape)
    world.v[:] = random.normal(0, 10, world.v.shape)
    sim.engine.assemble()
    rows, s = rows_of(effect), H * (world.v + H * np.array(G))
    table = rows.obstacles
    found = entering = 0
    for i, node in enumerate(effect.node):
        expected = contact_rows.rows([
            contact_rows.row(k, SHAPES[str(name)][1], table.begin[k], table.end[k], world.x[node], s[node], 0.02)
            for k, name in enumerate(names)
        ])  # fmt: skip
        assert rows.corner[2 * i].tolist() == [node, -1, -1, -1]
        assert rows.obstacle[2 * i : 2 * i + 2].tolist() == [r.obstacle for r in expected] + [-1] * (2 - len(expected))
        for k, r in zip((2 * i, 2 * i + 1), expected, strict=False):
            assert rows.entry[k] == pytest.approx(r.entry, abs=1e-8)
            np.testing.assert_allclose(rows.normal[k], r.normal, atol=1e-6)
            np.testing.assert_allclose(rows.drift[k], r.drift, atol=1e-6)
            assert rows.gap[k] == pytest.approx(r.gap, abs=1e-6)
            assert rows.friction[k] == (0.07 if r.obstacle == 1 else 0.5)
            found, entering = found + 1, entering + (r.entry <= 1)
    assert found > entering > 3


def test_stiffness_is_that_of_the_node_in_the_first_step_and_stays():
    sim = made(FLOOR, stiffness=3.0)
    effect = contact_of(sim)
    rows, nodes = rows_of(effect), np.repeat(effect.node, 2)
    assert not rows.stiffness.any()
    sim.engine.assemble()
    trace = sim.system.block[nodes][:, [0, 3, 5]].sum(axis=1)
    assert (trace > 0).all()
    np.testing.assert_allclose(rows.stiffness, 3 * (sim.world.mass[nodes] + trace / 3) / H**2, rtol=1e-14)
    kept = rows.stiffness.copy()
    sim.world.x[:] *= 1.7
    sim.engine.assemble()
    assert np.array_equal(rows.stiffness, kept)


def test_a_thickness_is_a_tenth_of_the_shortest_edge_of_each_surface():
    bars = [bar((2, 1, 1), (1, 0.5, 0.5)), bar((3, 3, 3), (9, 0.3, 3), name="flat", friction=0.2)]
    sim = made(FLOOR, bars=bars)
    rows = rows_of(contact_of(sim))
    starts = rows.body_start
    end = starts[2]
    assert rows.thickness[: starts[1]] == pytest.approx(0.05) and rows.thickness[starts[1] : end] == pytest.approx(0.01)
    edges = contact_of(sim).contact_input().surfaces.edge
    assert len(rows.thickness) == len(rows.corner) == end
    assert rows.all == 2 * end + 2 * len(edges), "as many rows between bodies, and two for each edge"
    bodies = np.searchsorted([b.last for b in sim.world.bodies], rows.corner[:end, 0], side="right")
    assert np.array_equal(np.repeat([0, 1], np.diff(starts)), bodies)
    sim.world.x[:, 1] = 0.001
    sim.engine.assemble()
    assert rows.friction[0] == 0.5 and rows.friction[starts[1]] == pytest.approx(np.sqrt(0.1))
    with pytest.raises(InputError, match=r"thickness = 0.06 m: at most 0.05 m, half of the shortest edge .* 'flat'"):
        made(FLOOR, bars=bars, thickness=0.06)


def test_only_free_surface_nodes_have_rows():
    sim = made(FLOOR, bars=[bar((3, 3, 3), (1, 1, 1), fixed="X < 0.01")])
    effect = contact_of(sim)
    surface = np.unique(surface_triangles(sim.world.bodies[0].mesh.tets))
    assert np.array_equal(effect.node, [i for i in surface if sim.world.rest[i, 0] > 0.01])
    sim.world.x[:, 1] = 0.0
    sim.engine.assemble()
    assert (rows_of(effect).obstacle[::2] == 0).all()
    sim.world.free[effect.node[3]] = 0  # as of a body that is frozen
    sim.engine.assemble()
    assert rows_of(effect).obstacle[6] == -1


def test_an_object_that_begins_inside_an_obstacle_is_told_with_its_deepest_node(caplog):
    bars = [bar((2, 2, 2), (1, 1, 1)), bar((2, 2, 2), (1, 1, 1), name="sunk", pose={"translate": [0, -0.3, 5]})]
    made(FLOOR, {"name": "ball", "shape": "sphere", "radius": 1, "pose": {"translate": [0, 9, 0]}}, bars=bars)
    (told,) = [record.message for record in caplog.records]
    assert told == (
        "object 'sunk' begins inside obstacle 'floor': node 0 is 0.3 m deep (9 such nodes); it is thrown out"
    )


@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("thick", [0.002, 0.02])
@pytest.mark.parametrize("moving", [False, True])
def test_a_plate_is_found_from_the_side_on_which_a_step_begins(speed, thick, moving):
    """By nodes that fly through it, and by a plate that flies through nodes."""
    plate = {"name": "plate", "shape": "box", "size": [9, thick, 9]}
    if moving:
        ends = [{"time": t, "translate": [0, y, 0]} for t, y in ((0.0, 0.0), (H, speed * H))]
        plate["keyframes"] = ends
    sim = made(plate, thickness=0.0004, gravity=None)
    rows, world, effect = rows_of(contact_of(sim)), sim.world, contact_of(sim)
    above = thick / 2 + 0.0005 + np.random.default_rng(1).uniform(0, 0.9, len(world.x)) * (speed * H - 0.0001)
    world.x[:, 1] = above
    world.v[:, 1] = 0 if moving else -speed
    sim.engine.assemble()
    assert (rows.obstacle[::2] == 0).all() and (rows.obstacle[1::2] == -1).all()
    assert ((rows.entry[::2] >= 0) & (rows.entry[::2] <= 1)).all()
    np.testing.assert_allclose(rows.normal[::2], np.tile([0.0, 1.0, 0.0], (len(effect.node), 1)), atol=1e-15)
    way = speed * H if moving else 0
    np.testing.assert_allclose(rows.gap[::2], above[effect.node] - thick / 2 - way, atol=1e-12)
    np.testing.assert_allclose(rows.drift[::2, 1], way, atol=1e-12)


def test_a_row_keeps_the_memory_of_its_obstacle_in_whatever_slot():
    wall = {"name": "wall", "shape": "plane", "pose": {"rotate": [0, 0, -90]}}  # x < 0
    sim = made(FLOOR, wall, thickness=0.02, gravity=None)
    rows, world = rows_of(contact_of(sim)), sim.world
    world.v[:] = 0

    def at(x: float, y: float) -> None:
        world.x[:, 0], world.x[:, 1] = x, y
        sim.engine.assemble()

    at(0.03, 0.02)
    assert rows.obstacle[:2].tolist() == [0, 1]
    rows.force[:2], rows.traction[:2] = [5, 7], [[1, 0, 2], [0, 3, 4]]
    at(0.01, 0.02)
    assert rows.obstacle[:2].tolist() == [1, 0]
    assert rows.force[:2].tolist() == [7, 5]
    np.testing.assert_allclose(rows.traction[:2], [[0, 3, 4], [1, 0, 2]], atol=1e-14)
    at(0.01, 0.05)
    assert rows.obstacle[:2].tolist() == [1, -1]
    assert rows.force[:2].tolist() == [7, 0] and not rows.traction[1].any()
    at(0.01, 0.02)  # it was left, so it is forgotten
    assert rows.obstacle[:2].tolist() == [1, 0]
    assert rows.force[:2].tolist() == [7, 0]
    np.testing.assert_allclose(rows.traction[:2], [[0, 3, 4], [0, 0, 0]], atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_traction_turns_with_the_normal(seed):
    """By the smallest rotation from one normal to the other: its length stays, and so does a part along the axis."""
    random = np.random.default_rng(seed)
    sim = made({"name": "ball", "shape": "sphere", "radius": 0.4}, thickness=0.02, gravity=None)
    rows, world = rows_of(contact_of(sim)), sim.world
    before, after = random.normal(size=(2, 3))
    before, after = before / np.linalg.norm(before), after / np.linalg.norm(after)
    world.x[:] = 0.41 * before
    sim.engine.assemble()
    traction = np.cross(before, random.normal(size=3))
    rows.force[:], rows.traction[:] = 1, traction
    world.x[:] = 0.41 * after
    sim.engine.assemble()
    axis = np.cross(before, after)
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(before @ after))
    np.testing.assert_allclose(rows.traction[::2], np.tile(turn.apply(traction), (len(rows.force) // 2, 1)), atol=1e-12)
    assert abs(rows.traction[::2] @ after).max() < 1e-12


def test_a_traction_whose_normal_turns_over_stays_in_the_plane():
    plate = {"name": "plate", "shape": "box", "size": [9, 0.01, 9]}
    sim = made(plate, thickness=0.02, gravity=None)
    rows = rows_of(contact_of(sim))
    sim.world.x[:, 1] = 0.02
    sim.engine.assemble()
    rows.traction[::2] = [1, 0, 2]
    sim.world.x[:, 1] = -0.02
    sim.engine.assemble()
    assert rows.normal[0].tolist() == [0, -1, 0]
    assert rows.traction[0].tolist() == [1, 0, 2]


def test_an_obstacle_too_many_is_counted():
    listed = [{"name": f"o{k}", "shape": "plane", "pose": {"translate": [0, -0.001 * k, 0]}} for k in range(4)]
    sim = made(*listed, thickness=0.02, gravity=None)
    sim.world.x[:, 1] = 0.01
    sim.engine.assemble()
    assert (contact_of(sim).dropped == 2).all()
    assert rows_of(contact_of(sim)).obstacle[:2].tolist() == [0, 1]


def test_states_that_are_no_numbers_have_no_rows():
    sim = made(FLOOR, {"name": "ball", "shape": "sphere", "radius": 3.0}, gravity=None)
    effect = contact_of(sim)
    sim.world.x[effect.node[0]] = np.nan
    sim.world.v[effect.node[1]] = np.inf
    sim.engine.assemble()
    rows = rows_of(effect)
    assert rows.obstacle[:2].tolist() == [-1, -1]
    assert np.isfinite(rows.gap).all() and np.isfinite(rows.normal).all()


# --- motion -------------------------------------------------------------------------------------------------------


def test_angles_of_a_scene_are_the_rotation_of_the_quaternion():
    for angles in np.random.default_rng(0).uniform(-180, 180, (20, 3)):
        w, *v = quaternion(Pose(rotate=tuple(angles)).rotate)
        expected = Rotation.from_euler("xyz", angles, degrees=True)
        np.testing.assert_allclose(Rotation.from_quat([*v, w]).as_matrix(), expected.as_matrix(), atol=1e-14)


def test_keyframes_are_joined_by_lines_and_shortest_rotations():
    times, random = [0.02, 0.035, 0.08], np.random.default_rng(3)
    angles, places = random.uniform(-80, 80, (3, 3)), random.normal(size=(3, 3))
    keys = [
        {"time": t, "rotate": a.tolist(), "translate": p.tolist()}
        for t, a, p in zip(times, angles, places, strict=True)
    ]
    sim = made({**FLOOR, "keyframes": keys})
    table = rows_of(contact_of(sim)).obstacles
    slerp = Slerp(times, Rotation.from_euler("xyz", angles, degrees=True))
    last = None
    for step in range(11):
        sim.engine.run(1)
        for pose, t in ((table.begin[0], step * H), (table.end[0], (step + 1) * H)):
            held = np.clip(t, times[0], times[-1])
            np.testing.assert_allclose(pose[:3], [np.interp(t, times, places[:, k]) for k in range(3)], atol=1e-13)
            expected = slerp(held).as_matrix()
            np.testing.assert_allclose(shapes.rotation(pose[3:]), expected, atol=1e-13)
            assert np.linalg.norm(pose[3:]) == pytest.approx(1, abs=1e-15)
        assert last is None or np.allclose(last, table.begin[0], atol=1e-14)
        last = table.end[0].copy()
    assert np.array_equal(table.begin[0], table.end[0])


TOOL = {"name": "tool", "shape": "sphere", "radius": 0.1, "moved": "client", "max_speed": 2.0, "max_turn": 5.0,
        "pose": {"translate": [3, 0, 0]}}  # fmt: skip


def test_a_fixed_obstacle_stays_where_its_pose_puts_it():
    sim = made({**FLOOR, "pose": {"rotate": [10, 20, 30], "translate": [1, 2, 3]}})
    sim.engine.run(3)
    table = rows_of(contact_of(sim)).obstacles
    expected = [1, 2, 3, *quaternion((10, 20, 30))]
    assert table.begin[0].tolist() == table.end[0].tolist() == expected


def test_a_client_moves_an_obstacle_at_most_so_fast():
    sim = made(FLOOR, TOOL)
    effect = contact_of(sim)
    table, given = rows_of(effect).obstacles, []
    sim.on_effect_update.append(lambda e, pending: given.append((e, pending)))
    sim.engine.run(2)
    goal, turn = np.array([3.05, 0.04, 0.0]), Rotation.from_rotvec([0, 0.3, 0])
    w = turn.as_quat()[[3, 0, 1, 2]]
    effect.move("tool", tuple(goal), tuple(-2 * w))  # of any length and sign
    start = np.array([3.0, 0, 0])
    for step in range(8):
        before = table.end[1].copy()
        sim.engine.run(1)
        assert np.array_equal(table.begin[1], before)
        part = min(1, 2.0 * H * (step + 1) / np.linalg.norm(goal - start))
        np.testing.assert_allclose(table.end[1, :3], start + part * (goal - start), atol=1e-14)
        angle = Rotation.from_quat(table.end[1, [4, 5, 6, 3]]).magnitude()
        assert angle == pytest.approx(min(0.3, 5.0 * H * (step + 1)), abs=1e-13)
    assert np.array_equal(table.end[1, :3], goal)
    assert np.array_equal(table.begin[1], table.end[1])
    ((seen, pending),) = given
    assert seen is effect and isinstance(seen, Effect) and isinstance(pending, object) and pending.taken == 2
    np.testing.assert_allclose(effect.targets["tool"], [*goal, *-w], atol=1e-15)


def test_a_step_assembled_twice_moves_an_obstacle_once():
    sim = made(FLOOR, TOOL)
    effect = contact_of(sim)
    effect.move("tool", (4.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    for _ in range(3):
        sim.engine.assemble()
    table = rows_of(effect).obstacles
    assert table.begin[1, 0] == 3 and table.end[1, 0] == pytest.approx(3.02)


def test_targets_restored_at_the_same_steps_repeat_the_motion():
    poses: list[np.ndarray] = []
    sims = [made(FLOOR, TOOL) for _ in range(2)]
    taken: list[tuple[PendingUpdate, dict]] = []
    first = contact_of(sims[0])
    sims[0].on_effect_update.append(lambda e, pending: taken.append((pending, first.targets)))
    for k in range(6):
        first.move("tool", (3 + 0.01 * k, 0.03 * k, 0.0), (1.0, 0.1 * k, 0.0, 0.0))
        sims[0].engine.run(3)
        poses.append(rows_of(first).obstacles.end.copy())
    again = contact_of(sims[1])
    targets = {pending.taken: target for pending, target in taken}
    for step in range(18):
        if step in targets:
            again.restore(targets[step])
        sims[1].engine.run(1)
        if step % 3 == 2:
            assert np.array_equal(rows_of(again).obstacles.end, poses[step // 3])


NAN = float("nan")
REFUSED = {
    "no such obstacle": (("toll", (0, 0, 0), (1, 0, 0, 0)), r"no obstacle 'toll'; .* moved = \"client\": tool"),
    "an object": (("bar", (0, 0, 0), (1, 0, 0, 0)), "no obstacle 'bar'"),
    "a fixed one": (("floor", (0, 0, 0), (1, 0, 0, 0)), "'floor' is not moved by clients; .*: tool"),
    "NaN": (("tool", (0, NAN, 0), (1, 0, 0, 0)), "'tool': position and rotation must be finite"),
    "a rotation of NaN": (("tool", (0, 0, 0), (1, NAN, 0, 0)), "must be finite"),
    "no rotation": (("tool", (0, 0, 0), (0, 0, 0, 0)), "rotation has length 0: a quaternion"),
    "far away": (
        ("tool", (0, 1e5, 0), (1, 0, 0, 0)),
        "1e.05 m from the middle of the scene: at most 1225 m, 1000 times",
    ),
    "beyond all numbers": (("tool", (1e308, 1e308, 0), (1, 0, 0, 0)), "from the middle of the scene"),
}


@pytest.mark.parametrize(("given", "message"), REFUSED.values(), ids=REFUSED.keys())
@pytest.mark.filterwarnings("error")
def test_poses_that_cannot_be_are_refused_and_change_nothing(given, message):
    sim = made(FLOOR, TOOL)
    effect = contact_of(sim)
    with pytest.raises(MoveError, match=message):
        effect.move(*given)
    assert effect.targets["tool"].tolist() == [3, 0, 0, 1, 0, 0, 0]


@given(st.lists(st.floats(-180, 180), min_size=6, max_size=6), st.floats(0.001, 10))
@settings(max_examples=50, deadline=None)
def test_a_turn_never_passes_its_bound_and_arrives(angles, speed):
    sim = _turning(speed)
    effect = contact_of(sim)
    table = rows_of(effect).obstacles
    start, goal = quaternion(angles[:3]), quaternion(angles[3:])
    table.end[1, 3:] = start
    effect.move("tool", (3.0, 0.0, 0.0), goal)
    sim.engine.assemble()
    between = Rotation.from_quat(table.begin[1, [4, 5, 6, 3]]).inv() * Rotation.from_quat(table.end[1, [4, 5, 6, 3]])
    whole = Rotation.from_quat(np.array(start)[[1, 2, 3, 0]]).inv() * Rotation.from_quat(np.array(goal)[[1, 2, 3, 0]])
    assert between.magnitude() == pytest.approx(min(whole.magnitude(), speed * H), abs=1e-7)
    assert np.linalg.norm(table.end[1, 3:]) == pytest.approx(1, abs=1e-14)


def _turning(speed: float) -> Simulation:
    return made(FLOOR, {**TOOL, "max_turn": speed}, bars=[bar((1, 1, 1), (1, 1, 1))])


def test_detection_turns_with_the_scene():
    """All of it turned by a rotation: the same rows, with normals and drifts turned."""
    random, (turn,) = np.random.default_rng(5), random_rotations(1, 5)
    listed = [{"name": f"o{k}", **obstacle(name, random, True)} for k, name in enumerate(("box", "capsule"))]
    found = []
    x, v = None, None
    for R in (np.eye(3), turn):
        sim = made(*listed, thickness=0.02, gravity=tuple(R @ np.array(G)))
        effect = contact_of(sim)
        q = Rotation.from_matrix(R)
        for pose in effect.frames:  # the poses of keyframes
            pose[:3], pose[3:] = R @ pose[:3], (q * Rotation.from_quat(pose[[4, 5, 6, 3]])).as_quat()[[3, 0, 1, 2]]
        if x is None:
            x, v = sim.world.x + random.normal(0, 0.03, sim.world.x.shape), random.normal(0, 10, sim.world.v.shape)
        sim.world.x[:], sim.world.v[:] = x @ R.T, v @ R.T
        sim.engine.assemble()
        rows = rows_of(effect)
        found.append((rows.obstacle, rows.entry, rows.gap, rows.normal @ R, rows.drift @ R))
    assert (found[0][0] >= 0).any()
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
