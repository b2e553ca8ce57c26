# SPDX-License-Identifier: MIT
"""Carries out commands of clients on a running simulation: to push, grab, set, pause, step, reset, save and so on."""

import logging
import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import islice
from typing import TYPE_CHECKING

from protocol import messages_pb2 as pb
from protocol.counters import Counters
from protocol.push_limits import LONGEST_PUSH
from sim_server.recording import messages
from sim_server.service import cuts
from sim_server.simulation import Simulation

if TYPE_CHECKING:
    from sim_server.effects._movable import Movable
    from sim_server.effects.touch import Interaction, Touch  # imported where a scene lists it
    from sim_server.service.supervisor import Supervisor

log = logging.getLogger(__name__)

MOST_LISTED = 2000  # live parameters in a reply
MOST_SET, LONGEST_KEY, LONGEST_VALUE = 256, 300, 8192  # parameters of a command; characters
FAILED = "it failed"  # begins the reply to a command that ended in an error which no check foresees
MAX_STEPS = 1_000_000  # single ones of a command
UNIT = 1e-6  # that the length of a quaternion may differ from 1 by


class BadCommand(ValueError):
    """A command that is not carried out; the text goes back to the client."""


class Commands:
    """Carries out commands on one simulation.

    on_interaction: called with every accepted push and grab and the present time [s]
    frozen: returns True for an object that has run away and moves no more
    counters: of commands that end in an error which no check foresees; None: its own

    supervisor: of the local workers; None: the server has none
    """

    def __init__(
        self, simulation: Simulation, on_interaction: Callable[[pb.Interaction, float], None],
        frozen: Callable[[str], bool] = lambda name: False, counters: Counters | None = None,
    ):  # fmt: skip
        self.simulation, self.engine = simulation, simulation.engine
        self.on_interaction, self.frozen = on_interaction, frozen
        self.counters = Counters(log) if counters is None else counters
        self.stopping = False
        self.supervisor: Supervisor | None = None
        self._owners: set[str] = set()
        self._pauses = 0

    @property
    def engine_paused(self) -> bool:
        """True from `pause` to `resume`."""
        return bool(self.engine.loop.pause)

    @property
    def engine_halted(self) -> bool:
        """True if the loop stands still after the newest `pause`, and has no single steps left."""
        loop = self.engine.loop
        return bool(loop.single <= 0 and loop.halted == loop.pause != 0)

    def make_steps(self, steps: int) -> None:
        """Has the loop, which stands still in a pause, make some steps more."""
        self.engine.loop.single = steps

    def carry_out(self, command: pb.Command) -> pb.Reply:
        """Carries out a command and returns the reply, with an error if it cannot be done."""
        try:
            verb = VERBS.get(command.verb)
            if verb is None:
                raise BadCommand(f"unknown verb {command.verb!r}; known: {', '.join(sorted(VERBS))}")
            return verb(self, command)
        except ValueError as error:  # BadCommand, BadParameter, TouchError, MoveError and WorkerError
            return pb.Reply(error=str(error))
        except Exception as error:  # whatever a client asks for, the run goes on
            self.counters.refuse(self.counters.unexpected(error, f"command {command.verb} of {command.client}"))
            return pb.Reply(error=f"{FAILED}: {type(error).__name__}: {error}")

    def together(self) -> AbstractContextManager[None]:
        """Returns a context for the commands of a round: the loop gets their changes together when it ends."""
        touch = self.simulation.touch
        return nullcontext() if touch is None else touch.together()

    def release_absent(self, clients: set[str]) -> int:
        """Releases the interactions of clients that are not in `clients`; returns their number.

        Called after each round: a command that waited while its client died acts for a moment at most.
        """
        lost = self._owners - clients
        self._owners -= lost
        return sum(self._touch().release_all(client) for client in lost)

    def interactions(self) -> list[pb.Interaction]:
        """Interactions that the loop has, with the time of their first step (negative: not yet); some may be over."""
        touch = self.simulation.touch
        return [] if touch is None else [messages.interaction(a) for a in touch.known()]

    # --- verbs --------------------------------------------------------------------------------------------------

    def _push(self, command: pb.Command) -> pb.Reply:
        i = command.interaction
        _finite(i, "point", "force", "radius", "duration")
        if i.duration > LONGEST_PUSH:
            raise BadCommand(f"duration = {i.duration:g} s: a push lasts at most {LONGEST_PUSH:g} s")
        point, force = self._point(i), _tuple(i.force)
        return self._accept(
            command, self._touch(i.object).push(command.client, i.object, point, i.radius, force, i.duration)
        )

    def _grab(self, command: pb.Command) -> pb.Reply:
        i = command.interaction
        _finite(i, "point", "target", "radius", "duration", "stiffness", "max_force")
        duration = i.duration if i.duration > 0 else math.inf
        point = self._point(i)
        target = point if i.at and not i.HasField("target") else _tuple(i.target)
        taken = self._touch(i.object).grab(
            command.client, i.object, point, i.radius, target, i.stiffness, i.max_force, duration
        )
        return self._accept(command, taken)

    def _move(self, command: pb.Command) -> pb.Reply:
        i = command.interaction
        _finite(i, "target")
        return self._accept(command, self._touch().move(command.client, i.id, _tuple(i.target)))

    def _release(self, command: pb.Command) -> pb.Reply:
        return pb.Reply(interaction=messages.interaction(self._touch().release(command.client, command.interaction.id)))

    def _move_obstacle(self, command: pb.Command) -> pb.Reply:
        target, mover = command.target, self._mover(command.target.obstacle)
        if target.HasField("rotation"):
            rotation = _unit(target.rotation)
        else:
            now = mover.targets.get(target.obstacle)
            rotation = (1.0, 0.0, 0.0, 0.0) if now is None else tuple(now[3:].tolist())
        mover.move(target.obstacle, _tuple(target.position), rotation)
        return pb.Reply()

    def _set(self, command: pb.Command) -> pb.Reply:
        if not 0 < len(command.parameters) <= MOST_SET:
            raise BadCommand(f"{len(command.parameters)} parameters; allowed: 1 to {MOST_SET} at a time")
        for p in command.parameters:
            if p.key.endswith("cutting.removed"):
                raise BadCommand(f"{p.key[:80]}: elements are removed by the command cut, and come back by reset")
            if p.key.endswith("cutting.opened"):
                raise BadCommand(f"{p.key[:80]}: faces are opened by the command cut with split, and closed by reset")
            if len(p.key) > LONGEST_KEY or len(p.value) > LONGEST_VALUE:
                raise BadCommand(
                    f"{p.key[:40]}...: at most {LONGEST_KEY} characters of a key, {LONGEST_VALUE} of a value"
                )
        values = {p.key: p.value for p in command.parameters}
        if len(values) < len(command.parameters):
            raise BadCommand("a parameter is set twice")
        done = self.simulation.parameters.set(values, command.client)
        return pb.Reply(parameters=map(messages.live_parameter, done))

    def _cut(self, command: pb.Command) -> pb.Reply:
        return cuts.carry_out(self.simulation, command.cut, command.client)

    def _parameters(self, command: pb.Command) -> pb.Reply:
        return pb.Reply(parameters=map(messages.live_parameter, islice(self.simulation.parameters, MOST_LISTED)))

    def _reset(self, command: pb.Command) -> pb.Reply:
        names = [body.name for body in self.simulation.world.bodies]
        if command.object and command.object not in names:
            raise BadCommand(f"no object {command.object[:80]!r}; objects of the scene: {', '.join(names)}")
        return pb.Reply(status=self._status_of("paused" if self.engine_paused else "running"))

    def _save(self, command: pb.Command) -> pb.Reply:
        return pb.Reply(status=self._status_of("paused" if self.engine_paused else "running"))

    def _pause(self, command: pb.Command) -> pb.Reply:
        unchanged, loop = self.engine_paused, self.engine.loop
        loop.single = 0  # single steps end, too
        if not unchanged:
            self._pauses += 1  # a number of its own: the loop may still stand in the last one
            loop.pause = self._pauses
        return pb.Reply(status=self._status_of("paused"), unchanged=unchanged)

    def _step(self, command: pb.Command) -> pb.Reply:
        if not self.engine_paused:
            raise BadCommand("the server is not paused: only a paused one makes single steps")
        if command.steps > MAX_STEPS:
            raise BadCommand(f"steps = {command.steps}: at most {MAX_STEPS}")
        if self.simulation.touch is not None:
            self.simulation.touch.flush()  # what came before it holds from the first step on
        return pb.Reply(status=self._status_of("paused"))

    def _resume(self, command: pb.Command) -> pb.Reply:
        unchanged = not self.engine_paused
        if self.simulation.touch is not None:
            self.simulation.touch.flush()  # what came before it holds from the first step on
        self.engine.loop.single = 0
        self.engine.loop.pause = 0
        return pb.Reply(status=self._status_of("running"), unchanged=unchanged)

    def _stop(self, command: pb.Command) -> pb.Reply:
        self.stopping = True
        return pb.Reply(status=self._status_of("stopping"))

    def _add_worker(self, command: pb.Command) -> pb.Reply:
        return pb.Reply(worker=self._local_workers().add())

    def _kill_worker(self, command: pb.Command) -> pb.Reply:
        self._local_workers().kill(command.worker)
        return pb.Reply(worker=command.worker)

    def _local_workers(self) -> "Supervisor":
        """Returns the supervisor of local workers. Raises BadCommand if there is none."""
        if self.supervisor is None:
            raise BadCommand("this server has no local workers: it was started without --workers, or needs none")
        return self.supervisor

    def _status_of(self, state: str) -> pb.Status:
        status = pb.Status(state=state)
        self.stamp(status)
        return status

    def stamp(self, status: pb.Status) -> None:
        """Sets the present step and time."""
        status.step = self.engine.step
        status.time = status.step * self.simulation.world.dt

    def _accept(self, command: pb.Command, taken: "Interaction") -> pb.Reply:
        message = messages.interaction(taken)
        self._owners.add(command.client)
        self.on_interaction(message, float(self.simulation.system.clock[0]))
        return pb.Reply(interaction=message)

    def _touch(self, name: str = "") -> "Touch":
        """Returns the pushes and grabs of the scene. name: object of a command. Raises BadCommand if it takes none."""
        if name and self.frozen(name):
            raise BadCommand(f"object {name!r} has run away and is frozen: it takes no pushes or grabs any more")
        if self.simulation.touch is None:
            raise BadCommand(
                f"object {name!r} does not list the effect touch, so it takes no pushes or grabs; "
                "add touch = true to its effects"
                if name
                else "no object of the scene lists the effect touch"
            )
        return self.simulation.touch

    def _mover(self, name: str) -> "Movable":
        """Returns the effect that moves an obstacle or a holder. Raises BadCommand."""
        mover = self.simulation.movable(name)
        if mover is None:
            raise BadCommand("the scene does not list the effect contact, so it has no obstacles, and no holders")
        return mover

    def _point(self, i: pb.Interaction) -> tuple[float, float, float]:
        """Returns the point at which a push or grab begins [m]."""
        return self._touch(i.object).points(i.object).named(i.at) if i.at else _tuple(i.point)


def _tuple(v: pb.Vector) -> tuple[float, float, float]:
    return (v.x, v.y, v.z)


def _unit(q: pb.Quaternion) -> tuple[float, float, float, float]:
    """Returns the quaternion with length 1. Raises BadCommand if its length is another."""
    length = math.hypot(q.w, q.x, q.y, q.z)
    if not abs(length - 1) <= UNIT:
        raise BadCommand(f"rotation = {q.w, q.x, q.y, q.z} of length {length:.9g}: must be a quaternion of length 1")
    return (q.w / length, q.x / length, q.y / length, q.z / length)


def _finite(i: pb.Interaction, *names: str) -> None:
    for name in names:
        value = getattr(i, name)
        values = _tuple(value) if isinstance(value, pb.Vector) else (value,)
        if not all(map(math.isfinite, values)):
            raise BadCommand(f"{name} = {values}: must be finite")


VERBS: dict[str, Callable[[Commands, pb.Command], pb.Reply]] = {
    "push": Commands._push, "grab": Commands._grab, "move": Commands._move, "release": Commands._release,
    "cut": Commands._cut, "move_obstacle": Commands._move_obstacle, "set": Commands._set,
    "parameters": Commands._parameters,
    "pause": Commands._pause, "resume": Commands._resume, "step": Commands._step, "reset": Commands._reset,
    "save": Commands._save, "stop": Commands._stop,
    "add_worker": Commands._add_worker, "kill_worker": Commands._kill_worker,
}  # fmt: skip
