# SPDX-License-Identifier: MIT
"""Many copies of a scene as one vector environment of gymnasium: one scene, one loop, on a GPU one launch for all."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces, vector
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from sim_server.arrays import Float64
from sim_server.embedded.scene import Scene
from sim_server.embedded.simulation import Simulation
from sim_server.errors import InputError
from sim_server.gym.actions import Actions
from sim_server.gym.copies import Select, copied

MOST = 100_000  # copies
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class State:
    """What rewards and ends of episodes are computed from, for n copies with k observed nodes each.

    positions (n, k, 3) [m], velocities (n, k, 3) [m/s], displacements (n, k, 3) [m] from where the nodes began;
    actions (n, places, 3): the last ones, zero before the first; steps (n,): actions so far in the episode; time (n,):
    simulated since it began [s]
    """

    positions: Float64
    velocities: Float64
    displacements: Float64
    actions: Float64
    steps: NDArray[np.int64]
    time: Float64


class VectorEnv(vector.VectorEnv[Float64, Any, Any]):
    """`num_envs` copies of the objects of a scene, which do not touch each other, stepped together.

    scene: as of Simulation. action: Forces or Grabs. An action is 3 numbers for each of its places.
    observe: nodes, "tip", an expression as "X > 0.09", row numbers, or a list of such. An observation (6 k,) has their
        positions, then their velocities.
    reward: (n,) of a State, of all copies at once; terminated: likewise (n,) of bool.
    randomize: values of live parameters of a copy whose episode begins, by key as of Simulation.set, made with the
        random numbers of that copy: lambda random: {"finger.corotational.young": random.uniform(1e5, 2e5)}
    steps_per_action: steps of simulation. max_episode_steps: actions until an episode is truncated; None: never.

    A copy whose body runs away is truncated (infos["lost"]). With seed=s copy k has the random numbers of seed s + k.
    Copies are equal to a bit and repeat an episode to the bit where no factors are in use, with solver.preconditioner
    "block_jacobi"; else to the tolerance. Obstacles, and signals that follow time, are those of all copies and are not
    reset. Raises InputError for what cannot be built, and for bad actions.

    >>> env = VectorEnv("gallery/tentacle", 16, Forces("tip", 0.5), reward=lambda s: s.positions[:, 0, 0])
    """

    def __init__(
        self, scene: Scene | Mapping[str, Any] | str | Path, num_envs: int, action: Actions,
        observe: Select | Sequence[Select] = "tip", *, reward: Callable[[State], ArrayLike],
        terminated: Callable[[State], ArrayLike] | None = None,
        randomize: Callable[[np.random.Generator], Mapping[str, Any]] | None = None, steps_per_action: int = 1,
        max_episode_steps: int | None = None, autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        device: str = "cpu",
    ):  # fmt: skip
        _count("num_envs", num_envs, MOST)
        _count("steps_per_action", steps_per_action, 10**6)
        if max_episode_steps is not None:
            _count("max_episode_steps", max_episode_steps, 10**9)
        if not isinstance(scene, Scene):
            scene = Scene.load(scene) if isinstance(scene, str | Path) else Scene(scene)
        self.num_envs, self.metadata = num_envs, {"autoreset_mode": AutoresetMode(autoreset_mode)}
        self._reward, self._terminated, self._randomize = reward, terminated, randomize
        self._steps_per_action, self._most = steps_per_action, max_episode_steps
        many, self._copies = copied(scene, num_envs, action.effects)
        self.simulation = Simulation(many, device, forces=action.forces)
        self._action = action
        action.connect(self.simulation, self._copies)
        listed = isinstance(observe, list | tuple) and not all(isinstance(each, int) for each in observe)
        chosen: Any = observe if listed else [observe]
        rows = [self._copies.nodes(self.simulation, each, "observe")[1] for each in chosen]
        self._rows = np.concatenate(rows, axis=1)
        self._begun = self.simulation.inside.world.x[self._rows]
        self._set_spaces()
        self._random = [np.random.default_rng() for _ in range(num_envs)]
        self._actions = np.zeros((num_envs, len(action.at), 3))
        self._steps, self._began = np.zeros(num_envs, np.int64), np.zeros(num_envs)
        self._done, self._is_reset = np.zeros(num_envs, bool), False

    def _set_spaces(self) -> None:
        n, wide, largest = self.num_envs, 3 * len(self._action.at), self._action.largest
        self.single_action_space = spaces.Box(-largest, largest, (wide,), np.float32)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (6 * self._rows.shape[1],), np.float64)
        self.action_space = vector.utils.batch_space(self.single_action_space, n)
        self.observation_space = vector.utils.batch_space(self.single_observation_space, n)

    @property
    def state(self) -> State:
        """The state now, as it is given to `reward`."""
        world = self.simulation
        x, v = (_host(each[self._rows]) for each in (world.x, world.v))
        time = world.time - self._began
        return State(x, v, x - self._begun, self._actions.copy(), self._steps.copy(), time)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float64, dict[str, Any]]:
        """Begins new episodes. options: {"reset_mask": (n,) of bool}, the copies whose episodes begin; others go on.

        seed: s for seeds s + k of the copies, or one of each. Raises InputError.
        """
        self._open()
        mask = self._mask(options)
        for k, each in enumerate(self._seeds(seed)):
            if each is not None and mask[k]:
                self._random[k] = np.random.default_rng(each)
        if isinstance(seed, int):
            super().reset(seed=seed)
        self._begin(mask)
        self._is_reset = True
        return self._observation(self.state), {}

    def step(self, actions: Any) -> tuple[Float64, Float64, Bools, Bools, dict[str, Any]]:
        """Has the actions (n, 3 places) act on the next steps_per_action steps. Raises InputError for bad ones.

        Of copies whose episode is over: in mode NEXT_STEP it begins anew, and their action is not looked at.
        """
        self._open()
        mode, over = self.metadata["autoreset_mode"], self._done.copy()
        if not self._is_reset:
            raise InputError("step: reset comes first")
        if mode is AutoresetMode.DISABLED and over.any():
            raise InputError(
                f'step: the episodes of copies {_shown(over)} are over; reset(options={{"reset_mask": ...}})'
            )
        self._actions = self._checked(actions, over)
        self._action.apply(self._actions)
        self.simulation.step(self._steps_per_action)
        self._steps += 1
        if over.any():
            self._begin(over)
        return self._outcome(over, mode)

    def close_extras(self, **kwargs: Any) -> None:
        """Lets go of the simulation."""
        self.simulation.close()

    def _outcome(self, over: Bools, mode: AutoresetMode) -> tuple[Float64, Float64, Bools, Bools, dict[str, Any]]:
        """Returns what `step` does. over: copies that have begun anew in this call, which earn nothing."""
        state = self.state
        rewards = np.where(over, 0.0, self._numbers("reward", self._reward(state), float))
        ended = np.zeros(self.num_envs, bool)
        if self._terminated is not None:
            ended = self._numbers("terminated", self._terminated(state), bool) & ~over
        lost = self._lost() & ~over
        late = np.zeros_like(ended) if self._most is None else self._steps >= self._most
        truncated = (late & ~over) | lost
        self._done = ended | truncated
        infos: dict[str, Any] = {"lost": lost} if lost.any() else {}
        observation = self._observation(state)
        if mode is AutoresetMode.SAME_STEP and self._done.any():
            infos |= self._final(observation, self._done, lost)
            self._begin(self._done)
            observation = self._observation(self.state)
        return observation, rewards, ended, truncated, infos

    def _final(self, observation: Float64, done: Bools, lost: Bools) -> dict[str, Any]:
        """Returns the last observations of episodes, as gymnasium has them in infos."""
        last = np.full(self.num_envs, None, object)
        for k in np.flatnonzero(done):
            last[k] = observation[k].copy()
        return {
            "final_obs": last, "_final_obs": done.copy(),
            "final_info": {"lost": lost, "_lost": done.copy()}, "_final_info": done.copy(),
        }  # fmt: skip

    def _begin(self, mask: Bools) -> None:
        """Puts copies back to the start, with new parameters."""
        chosen = np.flatnonzero(mask).tolist()
        if self._randomize is not None:
            drawn = [(k, self._randomize(self._random[k])) for k in chosen]
            values = {self._key(key, k): value for k, each in drawn for key, value in each.items()}
            if values:  # all at once: each change has the whole scene checked
                self.simulation.set(values)
        everything = len(chosen) == self.num_envs
        self.simulation.reset(*([] if everything else [name for k in chosen for name in self._copies.of(k)]))
        self._action.begin(chosen)
        self._steps[chosen], self._began[chosen] = 0, self.simulation.time
        self._actions[chosen], self._done[chosen] = 0, False

    def _key(self, key: str, copy: int) -> str:
        """Returns the key of a parameter of an object in a copy. Raises InputError."""
        parts = key.removeprefix("object.").split(".")
        if parts[0] not in self._copies.names:
            raise InputError(
                f"randomize: {key!r} must be a parameter of one of the objects {', '.join(self._copies.names)}; "
                "others are those of all copies"
            )
        own = ".".join([self._copies.names[parts[0]][copy], *parts[1:]])
        return f"object.{own}" if key.startswith("object.") else own

    def _lost(self) -> Bools:
        """Returns which copies have a body that ran away (n,)."""
        lost = set(self.simulation.lost)
        return np.array([not lost.isdisjoint(self._copies.of(k)) for k in range(self.num_envs)])

    def _observation(self, state: State) -> Float64:
        parts = [each.reshape(self.num_envs, -1) for each in (state.positions, state.velocities)]
        return np.concatenate(parts, axis=1)

    def _checked(self, actions: Any, ignored: Bools) -> Float64:
        """Returns actions as (n, places, 3); those of ignored copies as zero. Raises InputError."""
        try:
            given = np.asarray(actions, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"actions: must be numbers, not {type(actions).__name__}") from None
        shape, largest = self.action_space.shape, self._action.largest
        if given.shape != shape:
            raise InputError(f"actions of shape {given.shape}: must be {shape}, 3 numbers for each place of each copy")
        given = np.where(ignored[:, None], 0.0, given)
        bad = ~(np.abs(given) <= largest * (1 + 1e-6))
        if bad.any():
            copy, component = np.argwhere(bad)[0]
            value = given[copy, component]
            raise InputError(f"actions[{copy}, {component}] = {value:g}: must be from {-largest:g} to {largest:g}")
        return np.clip(given, -largest, largest).reshape(self._actions.shape)

    def _numbers(self, what: str, values: ArrayLike, kind: type) -> NDArray[Any]:
        found = np.asarray(values)
        if found.shape != (self.num_envs,) or (kind is bool and found.dtype != bool):
            raise InputError(
                f"{what}: returned {found.dtype} of shape {found.shape}; must be {kind.__name__} ({self.num_envs},)"
            )
        return found.astype(kind)

    def _mask(self, options: Mapping[str, Any] | None) -> Bools:
        """Returns which copies are to be reset (n,). Raises InputError."""
        if options is None or "reset_mask" not in options:
            return np.ones(self.num_envs, bool)
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise InputError(f"reset_mask: must be an array of bool ({self.num_envs},), at least one of it true")
        if not self._is_reset and not mask.all():
            raise InputError("reset_mask: the first reset is of all copies")
        return mask

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + k for k in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InputError(f"seed: {len(seed)} seeds for {self.num_envs} copies")
        return list(seed)

    def _open(self) -> None:
        if self.closed:
            raise InputError("this environment is closed")


def _host(array: Any) -> Float64:
    """Returns a copy on the host of an array of NumPy or CuPy."""
    found: Float64 = np.array(array.get() if hasattr(array, "get") else array, dtype=float)
    return found


def _count(name: str, value: int, most: int) -> None:
    if not isinstance(value, int | np.integer) or not 1 <= value <= most:
        raise InputError(f"{name} = {value!r}: must be a whole number from 1 to {most}")


def _shown(mask: Bools) -> str:
    return ", ".join(str(k) for k in np.flatnonzero(mask)[:10])
