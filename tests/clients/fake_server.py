# SPDX-License-Identifier: MIT
"""The network side of a server and nothing behind it: answers queries, remembers commands, publishes on demand."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

import zenoh
from google.protobuf.message import Message

from protocol import messages_pb2 as pb
from protocol.channels import commands, everything, key
from protocol.network.session import open_session
from tests.ports import free_endpoint
from tests.sample_contact import MOVED, obstacle, pose
from tests.sample_run import DT, header, object_step, scene, state, topology

LOW, TIP = pb.Vector(x=-1, y=0, z=0), pb.Vector(x=1, y=2, z=3)


class FakeServer:
    def __init__(
        self, name: str = "sim", objects: tuple[str, ...] = ("beam", "liver"), obstacles: tuple[str, ...] = ()
    ) -> None:
        self.endpoint = free_endpoint()
        self.name, self.objects, self.obstacles = name, objects, obstacles
        self.commands: list[pb.Command] = []
        self.state, self.stopped = "running", "stopping"  # and the state that the answer to `stop` tells
        self.silent = False
        self.protocol = header().protocol
        self._held: list[zenoh.Query] = []
        self._session = open_session("server", listen=[self.endpoint], shared_memory=False)
        self._token = self._session.zenoh.liveliness().declare_token(key("alive_server", name, incarnation="7"))
        self._queryable = self._session.zenoh.declare_queryable(everything(name), self._answer)
        self._lock = threading.Lock()

    def status(self) -> pb.Status:
        found = pb.Status(header=header(), scene="made-up.toml", state=self.state, step=50, time=1.0, dt=DT)
        found.header.protocol = self.protocol
        found.step_p50, found.step_p99 = 0.004, 0.006
        for name in self.objects:
            last = object_step(name, 50)
            found.objects.append(pb.ObjectStatus(object=name, nodes=5, tets=2, last=last, low=LOW, high=TIP, tip=TIP))
        found.workers.append(pb.WorkerInfo(worker="w1", host="here", pid=1, library="supernodal", threads=1, jobs=3))
        return found

    def publish(self, step: int) -> None:
        """A frame of every object and one batch of steps."""
        for name in self.objects:
            data = state(name, step).SerializeToString()
            self._session.zenoh.put(key("state", self.name, object=name), data)
        for name in MOVED.keys() & set(self.obstacles):
            self._session.zenoh.put(key("pose", self.name, object=name), pose(name, step).SerializeToString())
        batch = pb.Steps(header=header(), steps=[object_step(name, step) for name in self.objects])
        self._session.zenoh.put(key("steps", self.name), batch.SerializeToString())

    def publish_garbage(self) -> None:
        for name in self.objects:
            self._session.zenoh.put(key("state", self.name, object=name), b"\xff\xff\xff")
        self._session.zenoh.put(key("steps", self.name), b"\xff" * 100)

    def clients(self) -> list[str]:
        """Names of the clients that are alive."""
        tokens = self._session.zenoh.liveliness().get(key("alive_client", self.name), timeout=5)
        return [str(token.ok.key_expr).rsplit("/", 1)[1] for token in tokens if token.ok is not None]

    def _answer(self, query: zenoh.Query) -> None:
        if self.silent:
            self._held.append(query)
            return
        with query:
            for name, message in self._answers(query):
                query.reply(name, message.SerializeToString())

    def _answers(self, query: zenoh.Query) -> list[tuple[str, Message]]:
        asked = str(query.key_expr)
        if asked.startswith(commands(self.name)):
            assert query.payload is not None
            return [(asked, self._obey(pb.Command.FromString(bytes(query.payload))))]
        if asked == key("status", self.name):
            return [(asked, self.status())]
        if asked == key("scene", self.name):
            found = scene(list(self.objects))
            found.obstacles.extend(self.obstacles)
            return [(asked, found)]
        if asked == key("obstacle", self.name):
            return [(key("obstacle", self.name, object=name), obstacle(name)) for name in self.obstacles]
        if asked == key("topology", self.name):
            return [(key("topology", self.name, object=name), topology(name)) for name in self.objects]
        return []

    def _obey(self, command: pb.Command) -> pb.Reply:
        with self._lock:
            self.commands.append(command)
        wanted = command.interaction
        if command.verb in ("push", "grab") and wanted.object not in self.objects:
            return pb.Reply(header=header(), error=f"no object {wanted.object!r}; there is {', '.join(self.objects)}")
        if command.verb == "move_obstacle" and command.target.obstacle not in MOVED:
            return pb.Reply(header=header(), error=f"obstacle {command.target.obstacle!r} is fixed")
        if command.verb in ("pause", "resume", "stop"):
            state = {"pause": "paused", "resume": "running", "stop": self.stopped}[command.verb]
            unchanged, self.state = self.state == state, state
            return pb.Reply(header=header(), status=self.status(), unchanged=unchanged)
        taken = pb.Interaction()
        taken.CopyFrom(wanted)
        taken.id, taken.nodes, taken.start = 11, 4, 1.0
        if wanted.at:
            taken.point.CopyFrom(TIP)
        return pb.Reply(header=header(), interaction=taken, status=self.status())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for query in self._held:
            query.drop()
        self._session.close()
