# SPDX-License-Identifier: MIT
"""Sends what objects exert in each step to who asked for it, as soon as it is known: for force feedback."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.backends.base import PendingUpdate
from sim_server.effects._base import Effect
from sim_server.network.link import ServerLink
from sim_server.recording.object_steps import Reactions
from sim_server.simulation import Simulation

TOGETHER = 256  # steps of objects in a message, at most
MOVES = 1024  # that the loop may not have taken up yet


class ReactionTelemetry:
    """The channel `reactions` of one run. Without subscribers nothing is made, sent or kept."""

    def __init__(self, simulation: Simulation, link: ServerLink):
        self._simulation, self._link = simulation, link
        self._wanted = False
        self._newest: dict[Effect, PendingUpdate] = {}  # what the loop was given last
        self._moves: deque[tuple[PendingUpdate, pb.MoveTaken]] = deque(maxlen=MOVES)  # in the order of arrival
        simulation.on_effect_update.append(self._newest.__setitem__)

    def look(self) -> None:
        """Checks for subscribers."""
        self._wanted = self._link.wants_reactions()
        if not self._wanted:
            self._moves.clear()

    def moved(self, commands: Sequence[pb.Command]) -> None:
        """Notes the moves among commands that were carried out, after the loop was given what they change."""
        for command in commands if self._wanted else ():
            move = pb.MoveTaken(client=command.client, move=command.header.sequence)
            effect: Effect | None
            if command.verb == "move":
                effect, move.grab = self._simulation.touch, command.interaction.id
            elif command.verb == "move_obstacle":
                effect, move.obstacle = self._simulation.contact, command.target.obstacle
            else:
                continue
            if effect in self._newest and move.move:
                self._moves.append((self._newest[effect], move))

    def publish(self, records: NDArray[Any], reactions: Reactions) -> None:
        """Sends the steps of these records, and which moves the loop has taken up."""
        if not self._wanted or not len(records):
            return
        bodies, moves = self._simulation.world.bodies, self._taken()
        for first in range(0, len(records), TOGETHER):
            part = slice(first, first + TOGETHER)
            steps = [
                pb.ObjectStep(
                    header=pb.Header(object=bodies[int(r["body"])].name, epoch=1),
                    step=r["step"], time=r["time"], contacts=r["contacts"],
                )
                for r in records[part]
            ]  # fmt: skip
            reactions[part].add_to(dict(enumerate(steps)), records[part])
            self._link.publish_reactions(pb.Steps(steps=steps, moves=moves if not first else ()))

    def _taken(self) -> list[pb.MoveTaken]:
        """Removes and returns the moves that the loop works with, the newest of each grab or obstacle of a client.

        An update that a newer one replaced before the loop saw it counts as taken up with that one.
        """
        last = max((k for k, (pending, _) in enumerate(self._moves) if pending.taken >= 0), default=-1)
        found = [self._moves.popleft() for _ in range(last + 1)]
        newest: dict[tuple[str, str, int], pb.MoveTaken] = {}
        step: dict[bool, int] = {}  # by what was moved
        for pending, move in reversed(found):
            grab = move.HasField("grab")
            if pending.taken >= 0:
                step[grab] = pending.taken
            if grab not in step:
                self._moves.appendleft((pending, move))
                continue
            move.step = step[grab]
            newest.setdefault((move.client, move.obstacle, move.grab), move)
        return list(newest.values())
