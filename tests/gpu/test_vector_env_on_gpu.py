# SPDX-License-Identifier: MIT
"""Copies of a scene as an environment on a GPU: all in one launch, with the answers of a CPU."""

import numpy as np
import pytest

import warpfactor as wf
from tests.gym.test_vector_env import ACTIONS, FINGER, N

pytestmark = pytest.mark.gpu


def environment(device: str, action: object, copies: int = N) -> wf.gym.VectorEnv:
    given = {"reward": lambda s: -s.positions[:, 0, 1], "max_episode_steps": 4, "device": device}
    return wf.gym.VectorEnv(FINGER, copies, action, **given)


@pytest.mark.parametrize("kind", ["forces", "grabs"])
def test_copies_move_as_on_a_cpu(kind: str) -> None:
    """Over the end of an episode, too: a reset of all copies."""
    action = {
        "forces": lambda: wf.gym.Forces("tip", 0.1),
        "grabs": lambda: wf.gym.Grabs("tip", reach=0.1, stiffness=100.0, max_force=5.0),
    }[kind]
    found = []
    for device in ("cpu", "gpu"):
        env = environment(device, action())
        start, _ = env.reset(seed=1)
        steps = [env.step(actions) for actions in ACTIONS]
        np.testing.assert_array_equal(steps[4][0], start)
        found.append(np.array([step[0] for step in steps]))
        assert [step[3].all() for step in steps] == [False, False, False, True, False, False]
        env.close()
    assert np.ptp(found[0], axis=0).max() > 1e-3
    np.testing.assert_allclose(*found, atol=1e-8)


def test_a_copy_begins_again_while_others_go_on() -> None:
    """One of 200, by a mask."""
    env = environment("gpu", wf.gym.Forces("tip", 0.1), 200)
    start, _ = env.reset()
    actions = np.random.default_rng(2).uniform(-0.1, 0.1, (200, 3))
    first = [env.step(actions)[0] for _ in range(2)]
    mask = np.arange(200) == 77
    found, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(found[mask], start[mask])
    np.testing.assert_array_equal(found[~mask], first[-1][~mask])
    again = env.step(actions)[0]
    np.testing.assert_allclose(again[mask], first[0][mask], atol=1e-12)
    assert np.abs(again[~mask] - first[1][~mask]).max() > 1e-6
    launches = len(env.simulation.inside.engine.launches)
    env.close()
    few = environment("gpu", wf.gym.Forces("tip", 0.1), 2)
    assert len(few.simulation.inside.engine.launches) == launches, "as many for 2 copies as for 200"
    few.close()
