# SPDX-License-Identifier: MIT
"""Copies of a scene as an environment of gymnasium: they move as one body alone does, and begin again one by one."""

import numpy as np
import pytest

import warpfactor as wf
from sim_server.errors import InputError

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
data_equivalence = pytest.importorskip("gymnasium.utils.env_checker").data_equivalence
AutoresetMode = gymnasium.vector.AutoresetMode

N = 3
FINGER = {
    "dt": 0.01,
    "effects": {"gravity": {"g": [0, -9.81, 0]}},
    "solver": {"preconditioner": "block_jacobi", "tolerance": 1e-10},
    "object": [{
        "name": "finger", "mesh": {"bar": [4, 2, 2], "size": [0.1, 0.02, 0.02]}, "density": 1000,
        "effects": {"corotational": {"young": 1e5, "poisson": 0.4}, "fixed": {"where": "X < 0.001"}},
    }],
}  # fmt: skip


def made(action=None, **keys):
    given = {"reward": lambda s: -s.positions[:, 0, 1], "max_episode_steps": 6} | keys
    return wf.gym.VectorEnv(FINGER, N, action or wf.gym.Forces("tip", 0.1), **given)


def alone(forces, steps=1):
    """Positions and velocities of the tip of one body under a force on its tip for each of some actions."""
    with wf.Simulation(FINGER, forces=True) as simulation:
        tip, found = simulation.tip("finger"), []
        for force in forces:
            simulation.forces[tip] = force
            simulation.step(steps)
            found.append(np.concatenate([simulation.x[tip], simulation.v[tip]]))
    return np.array(found)


ACTIONS = np.random.default_rng(1).uniform(-0.1, 0.1, (6, N, 3))


@pytest.fixture(scope="module")
def env():
    with_reward = made()
    yield with_reward
    with_reward.close()


def test_it_is_a_vector_environment(env):
    """Spaces and what is returned, as gymnasium has them; its own vector wrappers take it."""
    assert isinstance(env, gymnasium.vector.VectorEnv)
    observation, infos = env.reset(seed=1)
    assert infos == {} and observation in env.observation_space and observation[0] in env.single_observation_space
    for space, single in (
        (env.action_space, env.single_action_space),
        (env.observation_space, env.single_observation_space),
    ):
        assert space == gymnasium.vector.utils.batch_space(single, N)
    env.action_space.seed(0)
    with_statistics = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    with_statistics.reset(seed=1)
    for _ in range(8):
        found, rewards, ended, truncated, infos = with_statistics.step(env.action_space.sample())
        assert found in env.observation_space
        assert [a.shape for a in (rewards, ended, truncated)] == [(N,)] * 3
        assert rewards.dtype == float and ended.dtype == truncated.dtype == bool
    again, _ = env.reset(seed=1)
    assert data_equivalence(again, observation)


def test_copies_move_as_one_body_alone(env):
    """Each under forces of its own, to the rounding that solves leave."""
    env.reset()
    found = np.array([env.step(a)[0] for a in ACTIONS])
    for k in range(N):
        np.testing.assert_allclose(found[:, k], alone(ACTIONS[:, k].astype(float)), atol=1e-9)
    assert np.ptp(found[-1], axis=0).max() > 1e-3, "they differ"


def test_all_copies_are_stepped_by_the_launches_of_one(env):
    with wf.Simulation(FINGER, forces=True) as simulation:
        one = [launch.name for launch in simulation.inside.engine.launches]
    assert [launch.name for launch in env.simulation.inside.engine.launches] == one


def test_equal_actions_give_equal_copies_to_the_bit(env):
    env.reset()
    for a in ACTIONS:
        found = env.step(np.tile(a[0], (N, 1)))[0]
    assert (found == found[0]).all()


def test_a_copy_begins_again_to_the_bit_while_others_go_on():
    """By hand: mode DISABLED with a mask."""
    env = made(autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=None)
    start, _ = env.reset()
    first = [env.step(a)[0] for a in ACTIONS]
    other = made(autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=None)
    other.reset()
    for a in ACTIONS:
        other.step(a)
    mask = np.arange(N) == 1
    found, _ = env.reset(options={"reset_mask": mask})
    assert (found[1] == start[1]).all() and (found[~mask] == first[-1][~mask]).all()
    assert env.state.steps.tolist() == [6, 0, 6]
    for k, a in enumerate(ACTIONS):
        found, uninterrupted = env.step(a)[0], other.step(a)[0]
        np.testing.assert_array_equal(found[1], first[k][1])
        np.testing.assert_array_equal(found[~mask], uninterrupted[~mask])
    assert (found[1] != uninterrupted[1]).any()
    assert env.state.time.tolist() == pytest.approx([0.12, 0.06, 0.12])
    env.close(), other.close()


def test_grabs_begin_again_to_the_bit():
    """Targets draw; after a reset the grab is made anew."""
    env = made(wf.gym.Grabs("tip", reach=0.05, stiffness=100.0, max_force=5.0), max_episode_steps=4)
    env.reset()
    actions = np.tile([0.0, 0.03, 0.0], (N, 1))
    first = [env.step(actions) for _ in range(4)]
    assert first[-1][3].all()
    begun = env.step(actions)[0]
    second = [env.step(actions) for _ in range(4)]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    assert (first[-1][0][:, 1] > begun[:, 1] + 0.002).all()
    env.close()


def test_a_stiff_grab_holds_the_tip_at_its_target():
    """Of 1e5 N/m against a finger of about 10 N/m."""
    env = made(
        wf.gym.Grabs(["tip"], reach=0.02, stiffness=1e5, max_force=1e3), max_episode_steps=None, steps_per_action=40
    )
    env.reset()
    actions = np.array([[0, 0.01, 0], [0, -0.01, 0], [0, 0, 0.005]])
    env.step(actions)
    np.testing.assert_allclose(env.state.displacements[:, 0], actions, atol=2e-5)
    env.close()


def test_next_step_begins_an_episode_with_the_step_after_it_ended():
    env = made(max_episode_steps=2)
    start, _ = env.reset()
    assert not env.step(ACTIONS[0])[3].any()
    *_, rewards, ended, truncated, _ = env.step(ACTIONS[1])
    assert truncated.all() and not ended.any() and rewards.all()
    observation, rewards, ended, truncated, _ = env.step(np.full((N, 3), 1e9))  # these actions are not looked at
    np.testing.assert_array_equal(observation, start)
    assert not rewards.any() and not ended.any() and not truncated.any()
    env.close()


def test_same_step_tells_the_last_observation():
    keys = {"terminated": lambda s: s.steps * np.array([1, 0, 1]) >= 2, "max_episode_steps": 3}
    env, plain = made(autoreset_mode=AutoresetMode.SAME_STEP, **keys), made(max_episode_steps=None)
    start, _ = env.reset()
    plain.reset()
    env.step(ACTIONS[0]), plain.step(ACTIONS[0])
    observation, _, ended, truncated, infos = env.step(ACTIONS[1])
    last = plain.step(ACTIONS[1])[0]
    assert ended.tolist() == [True, False, True] and not truncated.any()
    np.testing.assert_array_equal(observation[[0, 2]], start[[0, 2]])
    np.testing.assert_array_equal(observation[1], last[1])
    np.testing.assert_array_equal(infos["_final_obs"], ended)
    assert infos["final_obs"][1] is None
    np.testing.assert_array_equal(infos["final_obs"][2], last[2])
    assert env.step(ACTIONS[2])[3].tolist() == [False, True, False]
    env.close(), plain.close()


def test_parameters_are_drawn_from_the_seed_of_each_copy():
    """Softer copies sag more; the same seed gives the same, whichever copy has it."""
    young = lambda random: {"finger.corotational.young": random.uniform(5e4, 5e5)}  # noqa: E731
    env = made(randomize=young, max_episode_steps=None, steps_per_action=5)
    found = []
    for seed in (7, 7, [9, 8, 7]):
        env.reset(seed=seed)
        found.append(env.step(np.zeros((N, 3)))[0][:, 1])
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2][::-1])
    drawn = [np.random.default_rng(7 + k).uniform(5e4, 5e5) for k in range(N)]
    assert np.argsort(drawn).tolist() == np.argsort(found[0]).tolist() and np.ptp(found[0]) > 1e-5
    env.close()
    env = made(randomize=lambda random: {"gravity.g": [0, 0, 0]})
    with pytest.raises(InputError, match=r"'gravity.g' must be a parameter of one of the objects finger"):
        env.reset()
    env.close()


def test_parameters_of_all_copies_are_set_at_once(monkeypatch):
    """Each change has the whole scene checked: one for each copy would take the square of their number."""
    env = made(randomize=lambda random: {"finger.corotational.young": np.float32(random.integers(50, 500) * 1e3)})
    parameters, given = env.simulation.inside.parameters, []
    set_them = parameters.set
    monkeypatch.setattr(parameters, "set", lambda values, *rest: given.append(values) or set_them(values, *rest))
    env.reset(seed=3)
    assert [len(each) for each in given] == [N]
    env.close()


def test_a_copy_that_runs_away_is_truncated_and_begins_again():
    """Pulled by far more than its law bears; the others go on."""
    env = made(wf.gym.Forces("tip", 1e9), max_episode_steps=None, autoreset_mode=AutoresetMode.NEXT_STEP)
    start, _ = env.reset()
    actions = np.zeros((N, 3))
    actions[1] = 1e9
    lost = np.zeros(N, bool)
    for _ in range(20):
        *_, truncated, infos = env.step(actions)
        lost |= infos.get("lost", False)
        if truncated.any():
            break
    assert lost.tolist() == truncated.tolist() == [False, True, False]
    np.testing.assert_array_equal(env.step(0 * actions)[0][1], start[1])
    assert not env.step(0 * actions)[3].any()
    env.close()


def test_copies_do_not_touch_each_other():
    """In a scene with contact they fall on the floor as one body does."""
    scene = {
        **FINGER, "effects": {"gravity": {}, "contact": {}},
        "obstacle": [{"name": "floor", "shape": "plane", "pose": {"translate": [0, -0.02, 0]}}],
        "object": [{**FINGER["object"][0], "effects": {"corotational": {"young": 1e5, "poisson": 0.4}}}],
    }  # fmt: skip
    env = wf.gym.VectorEnv(scene, N, wf.gym.Forces("tip", 1.0), reward=lambda s: np.zeros(N), steps_per_action=15)
    env.reset()
    found = env.step(np.zeros((N, 3)))[0]
    with wf.Simulation(scene) as simulation:
        simulation.step(15)
        tip = simulation.tip("finger")
        np.testing.assert_allclose(found[:, :3], np.tile(simulation.x[tip], (N, 1)), atol=1e-9)
    env.close()


PAIR = {
    **FINGER, "effects": {"gravity": {}},
    "object": [
        {**FINGER["object"][0], "effects": {"corotational": {"young": 1e5, "poisson": 0.4}}},
        {**FINGER["object"][0], "name": "load", "mesh": {"bar": [1, 1, 1], "size": [0.02, 0.02, 0.02]},
         "pose": {"translate": [0.08, -0.05, 0]}, "effects": {"corotational": {"young": 1e5, "poisson": 0.4}}},
    ],
    "holder": [{
        "name": "hand", "object": "finger", "where": "X < 0.001",
        "keyframes": [{"time": 0}, {"time": 0.1, "translate": [0, 0.03, 0]}],
    }],
    "spring": [{
        "name": "string", "stiffness": 50,
        "between": [{"object": "finger", "at": [0.1, 0, 0]}, {"object": "load", "at": [0.02, 0.02, 0]}],
    }],
}  # fmt: skip


def test_holders_and_springs_are_those_of_each_copy():
    """A moved finger with a load on a string; a copy that begins again is moved again, from the beginning."""
    seen = [{"load": 0}, {"finger": "X > 0.099 and Y < 0.001"}]
    keys = {"reward": lambda s: np.zeros(N), "autoreset_mode": AutoresetMode.DISABLED}
    env = wf.gym.VectorEnv(PAIR, N, wf.gym.Forces({"load": 0}, 0.1), seen, **keys)
    env.reset()
    actions = np.zeros((N, 3))
    first = [env.step(actions)[0] for _ in range(12)]
    with wf.Simulation(PAIR) as simulation:
        simulation.step(12)
        np.testing.assert_allclose(first[-1][:, :3], np.tile(simulation.positions("load")[0], (N, 1)), atol=1e-7)
    assert (first[-1] == first[-1][0]).all() and np.abs(first[-1][0] - first[0][0]).max() > 0.01
    env.reset(options={"reset_mask": np.arange(N) == 2})
    again = [env.step(actions)[0] for _ in range(12)]
    np.testing.assert_allclose([a[2] for a in again], [a[2] for a in first], atol=1e-7)
    assert (again[-1][0] == again[-1][1]).all() and np.abs(again[-1][0] - again[-1][2]).max() > 1e-3
    env.close()


def test_copies_of_several_objects_that_touch_are_refused():
    scene = {**PAIR, "effects": {"contact": {}}, "holder": None, "spring": None}
    scene = {key: value for key, value in scene.items() if value is not None}
    action = wf.gym.Forces({"load": 0}, 0.1)
    with pytest.raises(InputError, match=r"contact\.between = true with the objects finger, load: their copies"):
        wf.gym.VectorEnv(scene, N, action, {"load": 0}, reward=lambda s: np.zeros(N))
    scene |= {"effects": {"contact": {"between": False}}, "obstacle": [{"name": "floor", "shape": "plane"}]}
    wf.gym.VectorEnv(scene, N, action, {"load": 0}, reward=lambda s: np.zeros(N)).close()
    with pytest.raises(InputError, match=r"observe = 'tip': the scene has several objects; write \{NAME: 'tip'\}"):
        wf.gym.VectorEnv(scene, N, action, reward=lambda s: np.zeros(N))


BAD_ACTIONS = [
    (np.zeros((N, 2)), r"actions of shape \(3, 2\): must be \(3, 3\)"),
    (np.full((N, 3), np.nan), r"actions\[0, 0\] = nan: must be from -0.1 to 0.1"),
    (np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0]]), r"actions\[1, 2\] = 0.2: must be from -0.1 to 0.1"),
    ([["x"] * 3] * N, "actions: must be numbers, not list"),
]


@pytest.mark.parametrize(("actions", "message"), BAD_ACTIONS)
def test_bad_actions_are_refused_and_nothing_moves(env, actions, message):
    before, _ = env.reset()
    with pytest.raises(InputError, match=message):
        env.step(actions)
    np.testing.assert_array_equal(env.state.positions.reshape(N, -1), before[:, :3])


BAD = [
    ({"num_envs": 0}, "num_envs = 0: must be a whole number from 1"),
    ({"steps_per_action": 1.5}, "steps_per_action = 1.5"),
    ({"observe": "X > 9"}, "observe of object 'finger' = 'X > 9': no node is there"),
    ({"observe": [[0, 99]]}, "numbers of nodes are from 0 to 44"),
    ({"observe": {"toe": "tip"}}, "must name one of finger"),
    ({"observe": "X >"}, "observe of object 'finger'"),
    ({"action": lambda: wf.gym.Forces("tip", 0.0)}, "Forces = 0: must be above 0"),
    ({"action": lambda: wf.gym.Grabs("X > 0.09", 1, 1, 1)}, "a grab is at one node, with others within its radius; 9"),
    ({"action": lambda: wf.gym.Grabs("X < 0.001", 1, 1, 0)}, "max_force = 0: must be above 0"),
]


@pytest.mark.parametrize(("keys", "message"), BAD, ids=[m for _, m in BAD])
def test_what_cannot_be_built_is_refused(keys, message):
    with pytest.raises(InputError, match=message):
        given = {"num_envs": 2, "reward": lambda s: np.zeros(2), "action": lambda: wf.gym.Forces("tip", 1.0)} | keys
        wf.gym.VectorEnv(FINGER, action=given.pop("action")(), **given)


def test_what_comes_out_of_order_is_refused():
    env = made(max_episode_steps=1, autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(InputError, match="reset comes first"):
        env.step(ACTIONS[0])
    with pytest.raises(InputError, match="the first reset is of all copies"):
        env.reset(options={"reset_mask": np.arange(N) == 0})
    env.reset()
    env.step(ACTIONS[0])
    with pytest.raises(InputError, match="the episodes of copies 0, 1, 2 are over"):
        env.step(ACTIONS[0])
    with pytest.raises(InputError, match="must be an array of bool"):
        env.reset(options={"reset_mask": [True]})
    with pytest.raises(InputError, match="2 seeds for 3 copies"):
        env.reset(seed=[1, 2])
    env.close()
    env.close()
    with pytest.raises(InputError, match="is closed"):
        env.reset()


def test_rewards_of_a_wrong_shape_are_refused():
    env = made(reward=lambda s: 1.0)
    env.reset()
    with pytest.raises(InputError, match=r"reward: returned float64 of shape \(\); must be float \(3,\)"):
        env.step(ACTIONS[0])
    env.close()
