# SPDX-License-Identifier: MIT
"""What obstacles and holders share: rigid frames that stand, move along keyframes, or go to the poses of a client."""

from collections.abc import Sequence
from math import dist, hypot
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.effects._base import Effect, EffectUpdates
from sim_server.mechanics.system import System
from sim_server.mechanics.world import World
from sim_server.scene.motion import Moved
from sim_server.scene.pose import Pose, quaternion

REACH = 1e3  # sizes of the scene: how far from it a client's pose may be
MOTION = {"fixed": 0, "keyframes": 1, "client": 2}  # Motion of kernels/motion.cu

Point = tuple[float, float, float]
Rotation = tuple[float, float, float, float]


class MoveError(ValueError):
    """A pose that is refused; the text is for the client."""


class Movable(Effect):
    """Effect with m rigid frames, whose poses are (7,): position [m], unit quaternion w, x, y, z.

    kind: what they are, for messages. given: times [s] and poses of each, one at least: where it
    begins, or all keyframes

    listed: their tables. begin, end (m, 7): poses at the start and the end of the step
    frames (keyframes, 7): given poses of all
    ball (m, 4): centre and radius [m] of a sphere around each, in its frame; radius < 0: without end
    swept (m, 4): the same around both poses
    """

    def __init__(
        self, world: World, kind: str, listed: Sequence[Moved],
        given: Sequence[Sequence[tuple[float, Sequence[float]]]],
    ):  # fmt: skip
        self.world, self._kind, self.listed = world, kind, listed
        self._simulation: EffectUpdates | None = None
        self._system: System | None = None
        low, high = world.x.min(axis=0), world.x.max(axis=0)
        self._center, self._size = (low + high) / 2, float(np.linalg.norm(high - low))
        m = len(listed)
        self.begin = np.array([poses[0][1] for poses in given]).reshape(m, 7)
        self.end = self.begin.copy()
        ways = ["keyframes" if o.keyframes else o.moved or "fixed" for o in listed]
        self._motion = np.array([MOTION[way] for way in ways], np.int32)
        self._first = np.concatenate([[0], np.cumsum([len(poses) for poses in given])]).astype(np.int32)
        self._time = np.array([time for poses in given for time, _ in poses])
        self._given_time = self._time
        self.frames = np.array([pose for poses in given for _, pose in poses])
        self._speed = np.array([o.max_speed or 0.0 for o in listed])
        self._turn = np.array([o.max_turn or 0.0 for o in listed])
        self._placed = np.full(m, -1.0)
        self.ball, self.swept = np.zeros((m, 4)), np.zeros((m, 4))
        self._target: Float64 = self.end.copy()

    def connect(self, simulation: EffectUpdates) -> None:
        self._simulation = simulation

    def frame_arrays(self) -> list[NDArray[Any]]:
        """Returns what steps carry on of the frames, with a row for each."""
        return [self.begin, self.end, self.swept, self._placed]

    @property
    def targets(self) -> dict[str, Float64]:
        """Poses (7,) that clients want, as the loop was given them last, by the names of what they move."""
        return {o.name: self._target[k].copy() for k, o in enumerate(self.listed) if o.moved == "client"}

    def move(self, name: str, position: Point, rotation: Rotation) -> None:
        """Has a frame go to a pose, at most at its `max_speed` and `max_turn`.

        position: of the frame [m]. rotation: quaternion w, x, y, z of any length but 0.
        Raises MoveError.
        """
        self._check_name(name)
        what = f"{self._kind} {name!r}"
        if not np.isfinite([*position, *rotation]).all():
            raise MoveError(f"{what}: position and rotation must be finite numbers")
        away, far, length = dist(position, self._center), REACH * self._size, hypot(*rotation)
        if not away <= far:
            raise MoveError(
                f"{what}: position {away:.4g} m from the middle of the scene: at most {far:.4g} m, "
                f"{REACH:g} times its size"
            )
        if not 1e-6 < length < 1e6:
            raise MoveError(f"{what}: rotation has length {length:.4g}: a quaternion w, x, y, z of 1")
        self.restore({name: np.array([*position, *(q / length for q in rotation)])})

    def restore(self, targets: dict[str, Float64]) -> None:
        """Has the loop work with these poses, (7,) by name, from its next step on; the others stay.

        Raises MoveError.
        """
        target = self._target.copy()
        for name, pose in targets.items():
            target[self._check_name(name)] = pose
        self._target = target
        assert self._simulation is not None and self._system is not None
        self._simulation.update_effect(self, self.place(self._system))

    def given(self) -> dict[str, Float64]:
        """Returns what changes of a frame's motion: poses that clients want, and times of keyframes [s]."""
        return {"target": self._target, "time": self._time}

    def give(self, values: dict[str, Float64]) -> None:
        """Sets what `given` returned. To be called while the loop stands still."""
        self._target, self._time = values["target"].copy(), values["time"].copy()
        self.restore({})

    def restart(self, numbers: Sequence[int], time: float) -> None:
        """Puts frames back to where they began; their keyframes are those of the time since `time` [s].

        To be called while the loop stands still.
        """
        if not len(numbers):
            return
        for array in (self.begin, self.end, self._placed):
            self.world.backend.fetch(array)
        self._target, self._time = self._target.copy(), self._time.copy()
        for k in numbers:
            keys = slice(self._first[k], self._first[k + 1])
            self.begin[k] = self.end[k] = self._target[k] = self.frames[self._first[k]]
            self._placed[k] = -1.0
            self._time[keys] = self._given_time[keys] + time
        for array in (self.begin, self.end, self._placed):
            self.world.backend.push(array)
        self.restore({})

    def _check_name(self, name: str) -> int:
        """Returns the number of a frame that a client may move. Raises MoveError."""
        movable = [o.name for o in self.listed if o.moved == "client"]
        found = next((k for k, o in enumerate(self.listed) if o.name == name), None)
        said = f'with moved = "client": {", ".join(movable) or "none"}'
        if found is None:
            raise MoveError(f"no {self._kind} {name[:80]!r}; {self._kind}s {said}")
        if name not in movable:
            raise MoveError(f"{self._kind} {name!r} is not moved by clients; {self._kind}s {said}")
        return found

    def pose_at(self, name: str, time: float) -> Float64:
        """Returns the pose (7,) between keyframes at a time [s], as `pose_at` in kernels/motion.cu has it."""
        number = next(k for k, o in enumerate(self.listed) if o.name == name)
        keys = slice(self._first[number], self._first[number + 1])
        times, poses = self._time[keys], self.frames[keys]
        after = int(np.searchsorted(times, time, "right"))
        k, last = max(after - 1, 0), min(after, len(times) - 1)
        a, b = poses[k], poses[last]
        part = (time - times[k]) / (times[last] - times[k]) if k != last else 0.0
        p, q = a[3:], b[3:] if a[3:] @ b[3:] >= 0 else -b[3:]
        aside = q - (p @ q) * p
        size = float(np.linalg.norm(aside))
        angle = part * float(np.arctan2(size, p @ q))
        rotation = np.cos(angle) * p + (np.sin(angle) / size * aside if size > 0 else 0.0)
        return np.concatenate([a[:3] + part * (b[:3] - a[:3]), rotation / np.linalg.norm(rotation)])

    def place(self, system: System) -> Launch:
        """Returns the launch that makes the poses of a step."""
        self._system = system
        launch: Launch = self.world.backend.module("kernels/motion.cu").bind(
            "place", len(self.listed), clock=system.clock, dt=self.world.dt, motion=self._motion,
            first=self._first, time=self._time, frame=self.frames, target=self._target, speed=self._speed,
            turn=self._turn, ball=self.ball, placed=self._placed, begin=self.begin, end=self.end, swept=self.swept,
        )  # fmt: skip
        return launch


def pose_of(given: Pose) -> list[float]:
    """Returns position and quaternion of a pose of the scene, (7,)."""
    return [*given.translate, *quaternion(given.rotate)]
