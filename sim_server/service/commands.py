# SPDX-License-Identifier: MIT
"""What clients ask of a running simulation: touch it, pause it, stop it."""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

from protocol import messages_pb2 as pb
from protocol.push_limits import LONGEST_PUSH
from sim_server.recording import messages
from sim_server.simulation import Simulation

if TYPE_CHECKING:
    from sim_server.effects.touch import Interaction, Touch  # imported where a scene lists it


class Refusal(ValueError):
    """A command that is not carried out; the text goes back to the client."""


class Commands:
    """Carries out commands on one simulation. accepted(interaction, time): told of every push and grab taken."""

    def __init__(self, simulation: Simulation, accepted: Callable[[pb.Interaction, float], None]):
        self.simulation, self.engine = simulation, simulation.engine
        self.accepted = accepted
        self.stopping = False
        self.frozen: Callable[[str], bool] = lambda name: False  # objects that have run away and move no more
        self._owners: set[str] = set()

    @property
    def engine_paused(self) -> bool:
        """The loop stands still until `resume`."""
        return bool(self.engine.loop.pause)

    @property
    def engine_stands(self) -> bool:
        """After `pause`: the step under way has ended. The loop sets its deadline to 0 while it waits."""
        return bool(self.engine.loop.deadline == 0)

    def carry_out(self, command: pb.Command) -> pb.Reply:
        """Does it and says so; what cannot be done is answered with an error."""
        try:
            verb = _VERBS.get(command.verb)
            if verb is None:
                raise Refusal(f"unknown verb {command.verb!r}; known: {', '.join(sorted(_VERBS))}")
            return verb(self, command)
        except ValueError as error:  # Refusal and TouchError
            return pb.Reply(error=str(error))

    def together(self) -> AbstractContextManager[None]:
        """Around the commands of a round: what they change goes to the loop at once."""
        touch = self.simulation.touch
        return nullcontext() if touch is None else touch.together()

    def gone(self, clients: set[str]) -> int:
        """Releases what clients that are no longer there still held; returns how many.

        Asked after each round of commands: one that waited while its client died takes hold for a moment at most.
        """
        lost = self._owners - clients
        self._owners -= lost
        return sum(self._touch().release_all(client) for client in lost)

    def applied(self) -> list[pb.Interaction]:
        """Interactions that the loop knows, with the time of their first step (negative: not yet); some may be over."""
        touch = self.simulation.touch
        return [] if touch is None else [messages.interaction(a) for a in touch.known()]

    # --- verbs --------------------------------------------------------------------------------------------------

    def _push(self, command: pb.Command) -> pb.Reply:
        i = command.interaction
        _finite(i, "point", "force", "radius", "duration")
        if i.duration > LONGEST_PUSH:
            raise Refusal(f"duration = {i.duration:g} s: a push lasts at most {LONGEST_PUSH:g} s")
        point, force = self._point(i), _tuple(i.force)
        return self._took(
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
        return self._took(command, taken)

    def _move(self, command: pb.Command) -> pb.Reply:
        i = command.interaction
        _finite(i, "target")
        return self._took(command, self._touch().move(command.client, i.id, _tuple(i.target)))

    def _release(self, command: pb.Command) -> pb.Reply:
        return pb.Reply(interaction=messages.interaction(self._touch().release(command.client, command.interaction.id)))

    def _pause(self, command: pb.Command) -> pb.Reply:
        unchanged, loop = self.engine_paused, self.engine.loop
        if not unchanged and not loop.realtime:
            loop.deadline = -1.0  # not looked at without a pace; 0 again once the loop stands still
        loop.pause = 1
        return pb.Reply(status=self._happened("paused"), unchanged=unchanged)

    def _resume(self, command: pb.Command) -> pb.Reply:
        unchanged = not self.engine_paused
        if self.simulation.touch is not None:
            self.simulation.touch.flush()  # what came before it holds from the first step on
        self.engine.loop.pause = 0
        return pb.Reply(status=self._happened("running"), unchanged=unchanged)

    def _stop(self, command: pb.Command) -> pb.Reply:
        self.stopping = True
        return pb.Reply(status=self._happened("stopping"))

    def _happened(self, state: str) -> pb.Status:
        status = pb.Status(state=state)
        self.date(status)
        return status

    def date(self, status: pb.Status) -> None:
        """Sets step and time to those of now."""
        status.step = self.engine.step
        status.time = status.step * self.simulation.world.dt

    def _took(self, command: pb.Command, taken: "Interaction") -> pb.Reply:
        message = messages.interaction(taken)
        self._owners.add(command.client)
        self.accepted(message, float(self.simulation.system.clock[0]))
        return pb.Reply(interaction=message)

    def _touch(self, name: str = "") -> "Touch":
        """Pushes and grabs of the scene. name: of the object that they are asked for. Raises Refusal without any."""
        if name and self.frozen(name):
            raise Refusal(f"object {name!r} has run away and is frozen: it takes no pushes or grabs any more")
        if self.simulation.touch is None:
            raise Refusal(
                f"object {name!r} does not list the effect touch, so it takes no pushes or grabs; "
                "add touch = true to its effects"
                if name
                else "no object of the scene lists the effect touch"
            )
        return self.simulation.touch

    def _point(self, i: pb.Interaction) -> tuple[float, float, float]:
        """Where a push or grab is to begin, in coordinates [m]."""
        return self._touch(i.object).points(i.object).named(i.at) if i.at else _tuple(i.point)


def _tuple(v: pb.Vector) -> tuple[float, float, float]:
    return (v.x, v.y, v.z)


def _finite(i: pb.Interaction, *names: str) -> None:
    for name in names:
        value = getattr(i, name)
        values = _tuple(value) if isinstance(value, pb.Vector) else (value,)
        if not all(map(math.isfinite, values)):
            raise Refusal(f"{name} = {values}: must be finite")


_VERBS: dict[str, Callable[[Commands, pb.Command], pb.Reply]] = {
    "push": Commands._push, "grab": Commands._grab, "move": Commands._move, "release": Commands._release,
    "pause": Commands._pause, "resume": Commands._resume, "stop": Commands._stop,
}  # fmt: skip
