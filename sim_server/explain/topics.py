# SPDX-License-Identifier: MIT
"""Which keys of the network and channels of the log an effect is the reason for.

All that tells of a run (service/telemetry.py, service/commands.py, recording/) is given a simulation without effects,
then one with a single effect: what it sends or writes beyond the first is because of that effect. The network and the
log are stand-ins that note keys, below the code that makes them. No step is made.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from protocol import messages_pb2 as pb
from protocol.channels import CHANNELS, key
from protocol.counters import Counters
from sim_server.backends.cpu.structs import REACTION
from sim_server.effects._base import Effect
from sim_server.explain.asker import CORE
from sim_server.network.link import ServerLink
from sim_server.network.publishers import Publishers
from sim_server.network.queryables import QUERYABLES
from sim_server.recording import messages
from sim_server.recording.pieces import Record
from sim_server.recording.recorder import Recorder
from sim_server.service.commands import Commands
from sim_server.service.telemetry import Telemetry
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver


@dataclass(frozen=True)
class Topics:
    """Keys of the network that are sent, answered or subscribed to, and channels of the log."""

    network: frozenset[str]
    log: frozenset[str]

    def beyond(self, other: "Topics") -> "Topics":
        """Returns those that are not in `other`."""
        return Topics(self.network - other.network, self.log - other.log)


class NotedLink(ServerLink):
    """The server's side of a network that is not there; everybody subscribes to everything. found: keys."""

    def __init__(self, name: str) -> None:
        self.name, self.incarnation, self.found = name, 1, set[str]()
        self.counters = Counters(SimpleNamespace(warning=lambda *_: None))  # type: ignore[arg-type]
        self.local_workers = list
        queue: Any = SimpleNamespace(post=lambda *_: True)
        session: Any = SimpleNamespace(declare_publisher=self._publisher)
        self._job_queue = queue
        self._publishers = Publishers(session, self.name, queue, queue, self.counters, self._stamp)
        answers: Any = SimpleNamespace(set_answer=lambda name, _: self.found.add(name), answer=lambda _: b"")
        self._queryables = answers
        self.dispatch: Any = SimpleNamespace(announce=lambda _: None, workers=list)

    def _publisher(self, name: str, **_: object) -> Any:
        self.found.add(name)
        return SimpleNamespace(matching_status=True, put=lambda _: None)

    def clients(self) -> list[str]:
        return ["client"]


class NotedRecorder(Recorder):
    """A log that is not there. found: its channels."""

    def __init__(self) -> None:
        self.found = set[str]()
        self.dropped = self.lost = self.written = self.thinned = self._time = 0
        self._waiting_bytes = self._frame_bytes = 0
        self.failure = ""

    def _put(self, records: Sequence[Record], *_: object, **__: object) -> bool:
        self.found |= {record.topic for record in records}
        return True


def topics(simulation: Simulation, server: str) -> dict[str, Topics]:
    """Returns those of each effect, and those of any scene with these objects, CORE. server: its name in keys."""
    without = _told(simulation, server, {})
    found = {CORE: Topics(without.network | _always(simulation, server), without.log)}
    for name in dict.fromkeys(e.name for e in simulation.effects.values()):
        alone = {key: e for key, e in simulation.effects.items() if e.name == name}
        found[name] = _told(simulation, server, alone).beyond(found[CORE])
    return found


def _always(simulation: Simulation, server: str) -> set[str]:
    """Keys that a server subscribes to or answers, whatever its scene."""
    wanted = simulation.scene.solver.wants_factors
    of_workers = [name for name, c in CHANNELS.items() if c.sender == "worker" and name not in ("echo", "part")]
    names = (*QUERYABLES, "alive_server", "alive_client", *(of_workers if wanted else ()))
    return {key(name, server) for name in names}


def _told(simulation: Simulation, server: str, effects: dict[str, Effect]) -> Topics:
    """What is sent and written of a simulation with these effects alone, by a step, a command and an update of each."""
    view = copy.copy(simulation)
    view.effects, view.on_effect_update = effects, []
    view.parameters = copy.copy(simulation.parameters)
    view.parameters.on_set = []
    link, recorder = NotedLink(server), NotedRecorder()
    commands = Commands(view, recorder.interaction)
    telemetry = Telemetry(Driver(view), link, recorder, False, commands)
    telemetry.open()
    _tell_of_a_step(view, telemetry, link)
    for body in view.world.bodies:
        push = pb.Interaction(object=body.name, force=pb.Vector(x=1), duration=1)
        commands.carry_out(pb.Command(verb="push", client="client", interaction=push))
    taken: Any = SimpleNamespace(taken=0)
    for effect in effects.values():
        for observe in view.on_effect_update:
            observe(effect, taken)
    update: Any = SimpleNamespace(values={"dt": "1"}, replaces=None, taken=0, client="")
    observers: list[Callable[[Any], None]] = view.parameters.on_set
    for observe_set in observers:
        observe_set(update)
    telemetry.on_reset("", show=False)
    return Topics(frozenset(link.found), frozenset(recorder.found))


def _tell_of_a_step(view: Simulation, telemetry: Telemetry, link: NotedLink) -> None:
    """Tells of a step that was not made, in which nothing moved."""
    world = view.world
    records = np.zeros(len(world.bodies), view.engine.records_dtype)
    records["body"] = np.arange(len(world.bodies))
    on_obstacles = np.zeros((len(records), len(view.reaction_names), 6))
    telemetry.frame_interval()
    telemetry.records(records, messages.reactions(view, on_obstacles, np.zeros(0, REACTION)))
    for body in world.bodies:
        if link.wants_state(body.name):
            link.publish_state(messages.state(body, 0, 0.0, world.x, world.v))
    mover = view.contact
    telemetry.contact.publish_poses(0, np.zeros((0, 7)) if mover is None else world.backend.fetch(mover.end))
