# SPDX-License-Identifier: MIT
"""Pushes and grabs while a simulation runs: what enters the system, for how long, and what is refused."""

from typing import Any

import numpy as np
import pytest

from protocol.push_limits import ORPHANED_PUSH
from sim_server.backends.base import PendingUpdate
from sim_server.effects._base import Effect
from sim_server.effects.touch import Touch, TouchError
from sim_server.simulation import Simulation
from tests.scenes import bar, simulation

H = 0.02
END = (2.0, 0.5, 0.5)  # middle of the free end of the bar
EVER = float("inf")


def held_bar(touch: dict | None = None, **table: Any) -> tuple[Simulation, Touch]:
    """A bar held at one end, and its touch."""
    given: dict[str, Any] = {"young": 1e5, "fixed": "X < 0.01", "touch": touch or {"max_force": 1e6}} | table
    sim = simulation(bar(**given), dt=H, tolerance=1e-9, max_iterations=5000)
    return sim, touch_of(sim)


def touch_of(sim: Simulation) -> Touch:
    assert sim.touch is not None
    return sim.touch


def force_in(sim: Simulation) -> np.ndarray:
    """Forces (n, 3) [N] that a step at rest adds to b."""
    sim.world.x[:], sim.world.v[:] = sim.world.rest, 0
    sim.engine.assemble()
    return sim.system.b / H


def test_untouched_it_adds_nothing():
    with_touch, _ = held_bar()
    without = simulation(bar(young=1e5, fixed="X < 0.01"), dt=H, tolerance=1e-9, max_iterations=5000)
    for sim in (with_touch, without):
        sim.world.v[sim.world.free > 0] = [0.1, -0.2, 0.3]
        sim.engine.run(5)
    assert np.array_equal(with_touch.world.x, without.world.x)


@pytest.mark.parametrize("radius", [0.0, 0.6, 5.0])
def test_a_push_enters_b_with_its_total_shared_by_the_nodes(radius):
    sim, touch = held_bar()
    force = (3.0, -40.0, 5.0)
    push = touch.push("anna", "bar", END, radius, force, 1.0)
    found = force_in(sim)
    np.testing.assert_allclose(found.sum(axis=0), force, rtol=1e-12, atol=1e-9)
    assert np.array_equal(np.flatnonzero(np.abs(found).max(axis=1) > 1e-6), push.nodes)
    np.testing.assert_allclose(found[push.nodes], np.tile(np.array(force) / len(push.nodes), (len(push.nodes), 1)))


def test_nodes_are_those_within_the_radius_now_and_free():
    sim, touch = held_bar()
    sim.world.x += [0.0, 10.0, 0.0]
    distance = np.linalg.norm(sim.world.x - np.array(END) - [0, 10, 0], axis=1)
    for radius in (0.3, 0.6, 1.1, 3.0):
        push = touch.push("anna", "bar", (2.0, 10.5, 0.5), radius, (0, 1, 0), 0.001)
        expected = np.flatnonzero((distance <= radius) & (sim.world.free > 0))
        assert np.array_equal(push.nodes, expected)
        sim.engine.run(1)
    nearest = touch.push("anna", "bar", (2.1, 10.9, 1.2), 0.0, (0, 1, 0), 1.0)
    assert nearest.nodes.tolist() == [int(np.linalg.norm(sim.world.x - [2.1, 10.9, 1.2], axis=1).argmin())]
    held = touch.push("anna", "bar", (-1.0, 10.0, 0.0), 0.0, (0, 1, 0), 1.0)
    assert (sim.world.free[held.nodes] > 0).all()  # the nearest of all is fixed


def test_changes_together_are_given_to_the_loop_as_one():
    sims = {together: held_bar() for together in (False, True)}
    given: list[Effect] = []
    for together, (sim, touch) in sims.items():
        sim.on_effect_update.append(lambda effect, pending: given.append(effect))

        def act(touch: Touch = touch) -> None:
            first = touch.push("anna", "bar", END, 0.6, (0, 5, 0), 1.0)
            held = touch.grab("bert", "bar", END, 0.0, END, 1e3, 0.0, EVER)
            touch.move("bert", held.id, (2.0, 0.9, 0.5))
            assert [a.id for a in touch.alive()] == [first.id, held.id]
            with pytest.raises(TouchError, match="max_force"):
                touch.push("anna", "bar", END, 0.6, (0, 5e9, 0), 1.0)
            touch.release("anna", first.id)

        if together:
            with touch.together():
                act()
        else:
            act()
        sim.engine.run(3)
    (apart, first), (once, touch) = sims.values()
    assert given == [first] * 4 + [touch]
    assert np.array_equal(apart.world.x, once.world.x)
    assert touch.known()[0].start == 0.0 and touch.known()[0].target == (2.0, 0.9, 0.5)


def test_observers_learn_in_which_step_the_loop_took_a_change_up():
    sim, touch = held_bar()
    given: list[PendingUpdate] = []
    sim.on_effect_update.append(lambda effect, pending: given.append(pending))
    sim.engine.run(3)
    touch.push("anna", "bar", END, 0.6, (0, 5, 0), 1.0)
    assert len(given) == 1 and given[0].taken < 0
    sim.engine.run(2)
    assert given[0].taken == 3


def test_nodes_of_the_named_body_only():
    bodies = [bar(name=name, young=1e5, touch={"max_force": 100}) for name in ("a", "b")]
    sim = simulation(*bodies, dt=H)
    touch = touch_of(sim)
    push = touch.push("anna", "b", END, 0.6, (0, 1, 0), 1.0)
    first = sim.world.bodies[1].first
    assert (push.nodes >= first).all()
    sim.engine.run(3)
    assert not sim.world.v[:first].any()
    assert sim.world.v[first:].any()


@pytest.mark.parametrize("steps", [1, 2, 3, 10, 50])
def test_a_push_lasts_as_many_steps_as_its_duration_holds(steps):
    """And gives an unheld body the momentum F t."""
    sim, touch = held_bar(fixed=None)
    sim.engine.run(7)
    touch.push("anna", "bar", END, 0.6, (0.0, 60.0, 0.0), steps * H)
    sim.engine.run(steps + 20)
    momentum = sim.world.mass @ sim.world.v
    np.testing.assert_allclose(momentum, [0, 60 * steps * H, 0], rtol=1e-6, atol=1e-6)
    assert touch.alive() == []


def test_a_push_is_alive_from_when_it_is_asked_for_until_it_is_over():
    sim, touch = held_bar()
    push = touch.push("anna", "bar", END, 0.0, (0, 1, 0), 2 * H)
    assert [a.id for a in touch.alive()] == [push.id]
    assert touch.alive()[0].start < 0
    sim.engine.run(1)
    assert touch.alive()[0].start == 0.0
    sim.engine.run(2)
    assert touch.alive() == []


def test_what_is_over_before_anybody_looked_is_still_known():
    """The log asks afterwards which pushes acted in which steps."""
    sim, touch = held_bar()
    push = touch.push("anna", "bar", END, 0.0, (0, 1, 0), 2 * H)
    sim.engine.run(20)
    assert touch.alive() == []
    assert [(a.id, a.start) for a in touch.known()] == [(push.id, 0.0)]


def test_several_interactions_add_up_at_a_node():
    sim, touch = held_bar()
    for _ in range(3):
        touch.push("anna", "bar", END, 0.0, (0.0, 2.0, 0.0), 1.0)
    touch.push("ben", "bar", END, 0.6, (5.0, 0.0, 0.0), 1.0)
    np.testing.assert_allclose(force_in(sim).sum(axis=0), [5, 6, 0], rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("stiffness", [1e2, 1e4, 1e6, 1e9])
def test_a_grab_pulls_with_a_bounded_force(stiffness):
    """Target a metre away: k times the distance, and never more than max_force in all."""
    sim, touch = held_bar()
    target = (END[0], END[1] + 1.0, END[2])
    grab = touch.grab("anna", "bar", END, 0.6, target, stiffness, 500.0, EVER)
    sim.engine.assemble()
    force = sim.system.b.sum(axis=0) / H
    share, K = stiffness / len(grab.nodes), sim.system.block[grab.nodes]
    inertia = sim.world.mass[grab.nodes] + K[:, [0, 3, 5]].sum(axis=1) / 3
    reached = share / (1 + H * H * share / inertia)  # of each node at the end of the step, its neighbours held
    if (reached <= 500.0 / len(grab.nodes)).all():
        assert force[1] == pytest.approx(stiffness, rel=1e-9)
        assert sim.system.diagonal.sum() == pytest.approx(sim.world.mass.sum() + H * H * stiffness, rel=1e-9)
    else:
        assert force[1] == pytest.approx(500, rel=1e-9)
        assert np.array_equal(sim.system.diagonal, sim.world.mass)
    assert abs(force[[0, 2]]).max() < 1e-6


def test_the_largest_force_of_the_scene_bounds_every_grab():
    sim, touch = held_bar({"max_force": 20.0})
    touch.grab("anna", "bar", END, 0.6, (END[0], END[1] + 10, END[2]), 1e6, 1e9, EVER)
    assert force_in(sim)[:, 1].sum() == pytest.approx(20, rel=1e-9)
    other, touch = held_bar({"max_force": 20.0})
    touch.grab("anna", "bar", END, 0.6, (END[0], END[1] + 10, END[2]), 1e6, 0.0, EVER)  # 0: as the scene says
    assert force_in(other)[:, 1].sum() == pytest.approx(20, rel=1e-9)


@pytest.mark.parametrize("stiffness", [1e3, 1e5, 1e7, 1e9])
@pytest.mark.parametrize("limit", [2e3, 1e4, 1e6])
def test_a_grab_of_any_stiffness_comes_to_rest(stiffness, limit):
    """The end is drawn up by 0.2 m and stays: no trembling about the target, however stiff the spring."""
    sim, touch = held_bar(young=1e4, damping=(2.0, 0.0))
    target = (END[0], END[1] + 0.2, END[2])
    touch.grab("anna", "bar", END, 0.0, target, stiffness, limit, EVER)
    sim.engine.run(500)
    speed = 0.0
    for _ in range(100):
        sim.engine.run(1)
        speed = max(speed, np.abs(sim.world.v).max())
    assert (sim.engine.records()["status"] == 0).all()
    assert speed < 1e-3
    node = touch.alive()[0].nodes[0]
    gap = np.linalg.norm(sim.world.x[node] - target)
    assert gap * stiffness < limit * 1.001
    assert gap < 0.2
    if stiffness == 1e9:
        assert gap < 1e-5


def test_a_grab_follows_its_target_and_lets_go():
    sim, touch = held_bar(young=1e4, damping=(2.0, 0.0))
    grab = touch.grab("anna", "bar", END, 0.0, END, 1e7, 1e6, EVER)
    node = grab.nodes[0]
    for y in (0.2, -0.1, 0.3):
        touch.move("anna", grab.id, (END[0], END[1] + y, END[2]))
        sim.engine.run(200)
        assert np.abs(sim.world.x[node] - [END[0], END[1] + y, END[2]]).max() < 1e-3
    touch.release("anna", grab.id)
    assert touch.alive() == []
    sim.engine.run(1500)
    assert np.abs(sim.world.x - sim.world.rest).max() < 1e-2


def test_grabbed_nodes_keep_their_places_about_the_point():
    """With the target at the grabbed point there is no force: the patch is held as it is, not drawn together."""
    sim, touch = held_bar()
    touch.grab("anna", "bar", (1.9, 0.6, 0.4), 0.8, (1.9, 0.6, 0.4), 1e6, 1e6, EVER)
    assert np.abs(force_in(sim)).max() < 1e-9


REFUSED = {
    "too strong a push": ("push", {"force": (0.0, 1e7, 0.0)}, r"1e\+07 N on 'bar': at most max_force = 1e\+06 N"),
    "a push of no duration": ("push", {"duration": 0.0}, "duration = 0 s: must be above 0"),
    "a push of duration NaN": ("push", {"duration": float("nan")}, "must be above 0"),
    "a negative radius": ("push", {"radius": -1.0}, "radius = -1 m: must not be negative"),
    "nothing within reach": ("push", {"point": (50.0, 0.0, 0.0)}, r"'bar' within 0.6 m .*nearest is 48"),
    "an unknown object": ("push", {"name": "beam"}, "no object 'beam'; objects of the scene: bar"),
    "a grab without stiffness": ("grab", {"stiffness": 0.0}, "stiffness = 0 N/m"),
    "a grab with stiffness NaN": ("grab", {"stiffness": float("nan")}, "must be above 0"),
    "a grab of negative duration": ("grab", {"duration": -1.0}, "must be above 0"),
    "a target beyond all numbers": (
        "grab", {"target": (1e308, 0.0, 0.0)}, r"target \(1e\+308, 0, 0\) is 1e\+308 m from .*at most 2449 m",
    ),
    "a target whose square is none": (
        "grab", {"target": (1e200, 0.0, 0.0), "stiffness": 1e308}, "1000 times the size of 'bar'",
    ),
    "a stiffness beyond all springs": (
        "grab", {"stiffness": 1e308}, r"stiffness = 1e\+308 N/m: at most 4.082e\+14 N/m on 'bar'",
    ),
    "a point beyond all numbers": (
        "grab", {"point": (1e308, 0.0, 0.0), "target": (1e308, 0.0, 0.0), "radius": 0.0},
        r"point \(1e\+308, 0, 0\) is 1e\+308 m from 'bar': at most 2449 m",
    ),
    "a push far away": ("push", {"point": (0.0, -1e5, 0.0), "radius": 0.0}, "point .* is 1e.05 m from 'bar'"),
    "a push whose square is none": ("push", {"force": (1e200, 1e200, 0.0)}, "at most max_force"),
}  # fmt: skip


@pytest.mark.parametrize(("verb", "change", "message"), REFUSED.values(), ids=REFUSED.keys())
@pytest.mark.filterwarnings("error")
def test_what_cannot_be_done_is_refused_and_changes_nothing(verb, change, message):
    sim, touch = held_bar()
    given = {"client": "anna", "name": "bar", "point": END, "radius": 0.6, "duration": 1.0}
    given |= {"force": (0.0, 1.0, 0.0)} if verb == "push" else {"target": END, "stiffness": 10.0, "max_force": 5.0}
    with pytest.raises(TouchError, match=message):
        getattr(touch, verb)(**(given | change))
    assert touch.alive() == []
    assert not force_in(sim).any()


@pytest.mark.filterwarnings("error")
def test_a_target_out_of_bounds_leaves_a_grab_where_it_was():
    sim, touch = held_bar()
    grab = touch.grab("anna", "bar", END, 0.0, END, 1e4, 100.0, EVER)
    with pytest.raises(TouchError, match="1000 times the size of 'bar'"):
        touch.move("anna", grab.id, (1e200, 0.0, 0.0))
    sim.engine.run(3)
    assert touch.alive()[0].target == END and (sim.engine.records()["status"] == 0).all()


def test_what_the_bounds_allow_gives_finite_steps():
    """The stiffest spring to the farthest target, in double precision and squared in single precision."""
    sim, touch = held_bar()
    far = 1e3 * np.sqrt(6) * 0.999
    touch.grab("anna", "bar", END, 0.6, (END[0], END[1] + far, END[2]), 1e18 / (1e3 * np.sqrt(6)), 50.0, EVER)
    sim.engine.run(5)
    assert (sim.engine.records()["status"] == 0).all() and np.isfinite(sim.world.x).all()
    assert np.isfinite(np.float32(1e18) ** 2)


def test_one_who_misses_is_told_where_the_body_is():
    sim, touch = held_bar()
    sim.world.x += [0.0, 10.0, 0.0]
    with pytest.raises(TouchError) as told:
        touch.push("anna", "bar", (2.0, 0.0, 0.0), 0.6, (0.0, 1.0, 0.0), 1.0)
    assert str(told.value) == (
        "no free node of 'bar' within 0.6 m of (2, 0, 0); the nearest is 10 m away at (2, 10, 0); "
        "'bar' now fills x from 0 to 2, y from 10 to 11, z from 0 to 1 m"
    )


def test_at_most_so_many_at_once():
    sim, touch = held_bar({"max_force": 10.0, "max_interactions": 3})
    for _ in range(3):
        touch.push("anna", "bar", END, 0.0, (0, 1, 0), H)
    with pytest.raises(TouchError, match=r"'bar' has 3 interactions already \(max_interactions\)"):
        touch.push("ben", "bar", END, 0.0, (0, 1, 0), H)
    sim.engine.run(3)
    touch.push("ben", "bar", END, 0.0, (0, 1, 0), H)


def test_one_client_cannot_touch_what_another_holds():
    _, touch = held_bar()
    grab = touch.grab("anna", "bar", END, 0.0, END, 10.0, 5.0, EVER)
    push = touch.push("anna", "bar", END, 0.0, (0, 1, 0), 1.0)
    for verb in (lambda: touch.move("ben", grab.id, END), lambda: touch.release("ben", grab.id)):
        with pytest.raises(TouchError, match="client 'ben' has no interaction 1"):
            verb()
    with pytest.raises(TouchError, match="is a push; only a grab has a target"):
        touch.move("anna", push.id, END)
    with pytest.raises(TouchError, match="has no interaction 77"):
        touch.release("anna", 77)


def test_what_a_lost_client_held_is_let_go_and_others_are_left_alone():
    _, touch = held_bar()
    touch.grab("anna", "bar", END, 0.0, END, 10.0, 5.0, EVER)
    touch.grab("anna", "bar", END, 0.6, END, 10.0, 5.0, EVER)
    push = touch.push("anna", "bar", END, 0.0, (0, 1, 0), 1.0)
    other = touch.grab("ben", "bar", END, 0.0, END, 10.0, 5.0, EVER)
    assert touch.release_all("anna") == 2
    assert [a.id for a in touch.alive()] == [push.id, other.id]  # a push ends by itself
    assert touch.release_all("nobody") == 0


@pytest.mark.parametrize("begun", [False, True])
def test_a_push_outlives_its_client_by_a_bounded_time(begun):
    sim, touch = held_bar()
    touch.push("anna", "bar", END, 0.0, (0, 1e-3, 0), 1000.0)
    if begun:
        sim.engine.run(10)
    assert touch.release_all("anna") == 0
    past = 9 * H if begun else 0.0  # the clock shows when the last step began
    assert touch.alive()[0].duration == pytest.approx(past + ORPHANED_PUSH)
    sim.engine.run(round(ORPHANED_PUSH / H) - begun)
    assert len(touch.alive()) == 1
    assert touch.release_all("anna") == 0  # again: no longer
    sim.engine.run(1)
    assert touch.alive() == []


def test_an_object_that_does_not_list_touch_is_not_touched():
    sim = Simulation.load("deploy/scenes/four_beams.toml")
    with pytest.raises(TouchError, match="object 'beam2' does not list the effect touch; these do: beam1"):
        sim.effects["touch"].push("anna", "beam2", (2.0, 0.5, 4.0), 0.5, (0.0, 1.0, 0.0), 1.0)


def test_two_who_pull_one_point_to_either_side_hold_it_between_their_targets():
    """Forces add: with springs of 1 : 3 the point rests where they balance, and the body there is not strained."""
    sim, touch = held_bar(young=1e4, damping=(2.0, 0.0), fixed=None)
    for client, stiffness, side in (("anna", 1e5, -0.4), ("ben", 3e5, 0.4)):
        touch.grab(client, "bar", END, 0.0, (END[0], END[1] + side, END[2]), stiffness, 1e6, EVER)
    begun = force_in(sim).sum(axis=0)
    assert begun == pytest.approx([0, 0.4 * (3e5 - 1e5), 0], abs=1e-6)
    sim.engine.run(800)
    node = touch.alive()[0].nodes[0]
    assert sim.world.x[node, 1] == pytest.approx(END[1] + 0.2, abs=1e-3)
    assert np.abs(sim.world.v).max() < 1e-2


def test_forces_together_are_bounded_and_those_that_are_there_stay():
    sim, touch = held_bar({"max_force": 100.0, "max_total_force": 250.0})
    touch.push("anna", "bar", END, 0.0, (0, 100, 0), 2 * H)
    grab = touch.grab("ben", "bar", END, 0.0, END, 1e3, 80.0, EVER)
    with pytest.raises(TouchError, match=r"'bar': 90 N beside the 180 N of 2 others: at most max_total_force = 250 N"):
        touch.push("carl", "bar", END, 0.0, (90, 0, 0), H)
    with pytest.raises(TouchError, match="max_total_force"):
        touch.grab("carl", "bar", END, 0.0, END, 1e3, 0.0, EVER)  # 0: as the scene says, 100 N
    assert [a.client for a in touch.alive()] == ["anna", "ben"]
    touch.push("carl", "bar", END, 0.0, (70, 0, 0), H)
    sim.engine.run(3)
    touch.push("carl", "bar", END, 0.0, (90, 0, 0), H)  # the push of 100 N is over
    touch.release("ben", grab.id)
    touch.grab("dora", "bar", END, 0.0, END, 1e3, 100.0, EVER)


def test_without_a_total_it_is_four_times_the_largest_force():
    _, touch = held_bar({"max_force": 10.0})
    for _ in range(4):
        touch.push("anna", "bar", END, 0.0, (0, 0, 10), H)
    with pytest.raises(TouchError, match="at most max_total_force = 40 N"):
        touch.push("anna", "bar", END, 0.0, (0, 0, 1e-3), H)
