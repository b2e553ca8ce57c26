# SPDX-License-Identifier: MIT
"""The client library: read the state of a running server, push and grab its objects, move its obstacles, pause it."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar, overload

import zenoh
from google.protobuf.message import Message

from clients.errors import BadInput, ClientError
from clients.forces import Forces, Load
from clients.grab import Grab
from clients.log.atomic_file import atomic_file
from clients.log.frames import Mesh, mesh_of
from clients.log.obstacles import Obstacle as ObstacleShape
from clients.log.obstacles import obstacle_of
from clients.obstacle import Obstacle
from clients.queries import Queries, read
from clients.queries import send as send_query
from clients.subscriptions import REACTIONS, Poses, States, Steps
from protocol import messages_pb2 as pb
from protocol.access.client_name import new_client
from protocol.access.roles import may
from protocol.channels import PROTOCOL, ROOT, SERVER_NAME, check_name, key
from protocol.network.endpoints import BadEndpoint, given_endpoints, usual_endpoints
from protocol.network.identity import ROLES_FILE, usual_identity
from protocol.network.session import ConnectionFailed, ConnectionRefused, UnknownHost, open_session
from protocol.refused import Refused

M = TypeVar("M", bound=Message)
Point = Sequence[float]
Value = float | bool | str | Sequence[Any]  # of a parameter; text is TOML
KINDS = ("operator", "participant", "viewer")  # certificates that are taken from a folder with all of them, the first
LONGEST_SAVE = 60.0  # s that a checkpoint takes to be made and sent, at most
LONGEST_STEPS = 60.0  # s that a server takes to answer `step` or `stop`, at most
FRESH_STATUSES = 3  # times that a status with positions is asked for


class Client:
    """A connection to the server `name`; use it as a context manager, which always closes it.

    connect: endpoints; by default those of the environment variable WARPFACTOR_CONNECT, or tcp/127.0.0.1:7447.
    timeout [s]: for connecting and for every answer; may be changed. secret: proves that commands are of this client.
    tls: folder with a certificate, as `sim-server certs` makes it; by default that of WARPFACTOR_TLS, else none.
    Raises ClientError if there is no such server or it refuses the certificate, BadInput for a bad name, endpoint or
    folder.

    >>> with Client() as client:
    ...     client.push("beam", at="tip", force=(0, -50, 0), duration=0.2)
    """

    def __init__(
        self, name: str = SERVER_NAME, connect: Sequence[str] | None = None, timeout: float = 3.0,
        tls: str | Path | None = None,
    ) -> None:  # fmt: skip
        self.name = name
        self.timeout = timeout
        self._numbers = itertools.count(1)  # of commands
        self._forces: Forces | None = None
        self._rights: pb.Reply | None = None  # what this client may do; None: everything, without a certificate
        try:
            check_name(name, "server name")
            self.identity = usual_identity(tls, KINDS, connect or given_endpoints())
            certified = self.identity is not None
            self.id, self.secret = new_client(self.identity.name if self.identity else "")
            connect = list(connect or usual_endpoints(certified))
            self._where = ", ".join(connect)
            self._session = open_session(
                "client", connect=connect, timeout=timeout, shared_memory=False, tls=self.identity
            )
        except (Refused, BadEndpoint) as error:
            raise BadInput(str(error)) from None
        except (UnknownHost, ConnectionRefused) as error:
            raise ClientError(str(error)) from None
        except ConnectionFailed:
            raise self._no_server() from None
        try:
            self._queries = Queries(self._session.zenoh, name, self._where)
            self._token = self._session.zenoh.liveliness().declare_token(key("alive_client", name, client=self.id))
            self.status()
            if self.identity is not None:
                self._rights = self.command("rights")
        except BaseException:
            self.close()
            raise

    def status(self, fresh: bool = False) -> pb.Status:
        """Returns the server's health, at most a second old.

        fresh: of this moment, with the positions of the objects, unless the server has no time for that.
        """
        for _ in range(FRESH_STATUSES if fresh else 1):
            if fresh:
                with contextlib.suppress(BadInput, ClientError):
                    self.command("status")
            found = self._query("status", pb.Status)
            if not found:
                raise self._no_server()
            if found[0].objects and found[0].objects[0].HasField("low"):
                break  # else the status of each second, which has no positions, came between command and query
        return found[0]

    def scene(self) -> pb.Scene:
        """Returns what is simulated, with the text of the scene file."""
        found = self._query("scene", pb.Scene)
        if not found:
            raise ClientError(f"server {self.name!r} has not announced its scene")
        return found[0]

    def meshes(self) -> dict[str, Mesh]:
        """Returns the present mesh of every object."""
        objects = {name for scene in self._query("scene", pb.Scene) for name in scene.objects}
        found = self._query(
            "topology", pb.Topology, complete=lambda all: bool(objects) and objects <= {t.header.object for t in all}
        )
        try:
            return {mesh.object: mesh for mesh in map(mesh_of, found)}
        except Refused as error:
            raise ClientError(f"server {self.name!r} sent a mesh that cannot be used: {error}") from None

    def obstacles(self) -> dict[str, ObstacleShape]:
        """Returns all obstacles and holders, with their poses at the start."""
        names = {name for scene in self._query("scene", pb.Scene) for name in scene.obstacles}
        if not names:
            return {}
        found = self._query("obstacle", pb.Obstacle, complete=lambda all: names <= {o.header.object for o in all})
        try:
            return {shape.name: shape for shape in map(obstacle_of, found)}
        except Refused as error:
            raise ClientError(f"server {self.name!r} sent an obstacle that cannot be used: {error}") from None

    def obstacle(self, name: str) -> Obstacle:
        """Returns the handle of an obstacle or holder that clients move. Raises BadInput if there is none of this name.

        >>> client.obstacle("tool").move((0, 0.2, 0), rotation=(1, 0, 0, 0))
        """
        shapes = self.obstacles()
        if name not in shapes:
            raise BadInput(f"no obstacle {name!r}; there is {', '.join(sorted(shapes)) or 'none'}")
        return Obstacle(self, shapes[name])

    def push(
        self, object: str, at: Point | str, force: Point, radius: float = 0.0, duration: float = 0.1
    ) -> pb.Interaction:
        """Pushes the nodes of `object` within `radius` [m] of `at` [m] with a total `force` [N] for `duration` [s].

        at: coordinates, or a named point of the object: tip (the free node farthest from what is fixed), top, bottom,
        left, right, front, back. radius 0 takes the nearest free node. Returns the interaction as the server took it.
        """
        wanted = pb.Interaction(
            object=object,
            kind="push",
            force=vector(force, "force"),
            radius=number(radius, "radius"),
            duration=number(duration, "duration", positive=True),
        )
        _begin(wanted, at)
        return self.command("push", wanted).interaction

    def grab(
        self,
        object: str,
        at: Point | str,
        target: Point | None = None,
        radius: float = 0.0,
        stiffness: float = 1000.0,
        max_force: float = 100.0,
    ) -> Grab:
        """Holds the nodes of `object` around `at` [m] by a spring to `target` (first `at` itself) that can be moved.

        at: coordinates or a named point, as of a push; `interaction.point` of the handle holds its coordinates.
        stiffness [N/m] and largest force max_force [N] of the spring. The handle is a context manager that releases.
        """
        wanted = pb.Interaction(
            object=object,
            kind="grab",
            radius=number(radius, "radius"),
            stiffness=number(stiffness, "stiffness", positive=True),
            max_force=number(max_force, "max-force", positive=True),
        )
        _begin(wanted, at)
        if target is not None or not isinstance(at, str):
            wanted.target.CopyFrom(vector(at if target is None else target, "target"))  # type: ignore[arg-type]
        return Grab(self, self.command("grab", wanted).interaction)

    def cut(
        self, object: str, *, blade: Sequence[Point] | None = None, center: Point | None = None, radius: float = 0.0,
        where: str = "", elements: str = "", split: bool = False,
    ) -> pb.Reply:  # fmt: skip
        """Removes elements of an object that lists the effect cutting; the reply has how many, and how many are left.
        With split it removes none: it opens the faces between elements along the blade, or around those that the others
        name, and the reply has how many faces it opened and how many nodes it copied.

        blade: 3 or 4 corners of the surface that a blade sweeps [m]: elements that it meets now. center, radius: those
        with centroids in this sphere now [m]. where: expression in X, Y, Z at rest. elements: numbers, as "3 7-9 12".
        Raises BadInput.

        >>> client.cut("liver", blade=[(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)])
        """
        wanted = pb.Cut(object=object, radius=number(radius, "radius"), where=where, elements=elements, split=split)
        wanted.blade.extend(vector(corner, "blade") for corner in blade or ())
        if center is not None:
            wanted.center.CopyFrom(vector(center, "center"))
        return self.command("cut", cut=wanted)

    @overload
    def set(self, key: str, value: Value) -> list[pb.LiveParameter]: ...
    @overload
    def set(self, key: Mapping[str, Value]) -> list[pb.LiveParameter]: ...
    def set(self, key: str | Mapping[str, Value], value: Value | None = None) -> list[pb.LiveParameter]:
        """Changes parameters of the scene while steps run, all between the same two steps; returns those that were set.

        key: as after --set of sim-server, or NAME.EFFECT.KEY, EFFECT.KEY, NAME.KEY; or values by key. value: text is
        TOML. Raises BadInput for what cannot change or is not allowed; nothing changes then.

        >>> client.set("beam.corotational.young", 2e5)
        >>> client.set({"gravity.g": [0, -1.6, 0], "beam.rayleigh.mass": 0.5})
        """
        given = key if isinstance(key, Mapping) else {key: value}
        parameters = [pb.Parameter(key=name, value=_toml(name, each)) for name, each in given.items()]
        return list(self.command("set", parameters=parameters).parameters)

    def parameters(self) -> list[pb.LiveParameter]:
        """Returns the parameters of the scene that may change while steps run, with the values set last."""
        return list(self.command("parameters").parameters)

    def pause(self) -> pb.Reply:
        """Pauses the simulation. Returns after the present step; the status of the reply has the number of that step.

        Returns after a minute if that step takes longer: the status then says "running".
        """
        reply, end = self.command("pause"), time.monotonic() + LONGEST_STEPS
        unchanged = reply.unchanged
        while reply.status.state == "running" and time.monotonic() < end:  # a server answers within a second or so
            reply = self.command("pause")
        reply.unchanged = unchanged
        return reply

    def resume(self) -> pb.Reply:
        """Resumes the simulation; the status of the reply has the step."""
        return self.command("resume")

    def step(self, n: int = 1) -> pb.Reply:
        """Has a paused server make n steps (1 to 1,000,000). The reply comes after the last one, and holds its number.

        After a minute it comes earlier: its status then says "running", and the other steps follow. In real time the
        steps keep pace with the clock. Raises BadInput if the server is not paused.
        """
        if not 1 <= n < 1 << 32:
            raise BadInput(f"{n} steps: allowed is a number of at least 1")
        command = self._command("step", None, None)
        command.steps = n
        return self._ask(command, self.timeout + LONGEST_STEPS)

    def reset(self, object: str | None = None) -> pb.Reply:
        """Puts an object, or all and what clients moved, back to the start; the status of the reply has the step.

        Pushes and grabs on it end, broken attachments are whole again; step numbers and time go on.
        """
        command = self._command("reset", None, None)
        command.object = object or ""
        return self._ask(command)

    def save(self, path: str | Path) -> pb.Reply:
        """Writes a checkpoint, with which `sim-server SCENE --resume FILE` goes on; the status has its step.

        The file appears whole or not at all. Raises ClientError if it cannot be written.
        """
        path = Path(path)
        reply = self._ask(self._command("save", None, None), self.timeout + LONGEST_SAVE)
        newest = lambda found: bool(found) and found[0].step >= reply.status.step  # noqa: E731
        found = self._queries.ask("checkpoint", pb.Checkpoint, None, self.timeout + LONGEST_SAVE, newest)
        if not newest(found):
            raise ClientError(f"server {self.name!r} sent no checkpoint of step {reply.status.step}")
        try:
            with atomic_file(path) as part:
                part.write_bytes(found[0].data)
        except OSError as error:
            raise ClientError(f"{path}: cannot be written: {error.strerror}") from None
        return reply

    def stop(self) -> pb.Reply:
        """Ends the server, which then closes its log. Returns after the step under way; the status of the reply has the
        number of steps.

        Returns after a minute if that step takes longer: the status then says "running", and the step is the last one.
        """
        return self._ask(self._command("stop", None, None), self.timeout + LONGEST_STEPS)

    def add_worker(self) -> str:
        """Has the server start one more local worker; returns its name. Raises BadInput without `--workers`."""
        return self.command("add_worker").worker

    def kill_worker(self, name: str) -> None:
        """Has the server kill a local worker by SIGKILL, which it then restarts. Raises BadInput."""
        self.command("kill_worker", worker=name)

    def states(self, objects: Sequence[str] | None = None) -> States:
        """Subscribes to frames of the named objects (all by default); only the newest of each is kept."""
        return States(self._session.zenoh, self.name, list(objects or self.scene().objects), self._incarnation)

    def poses(self, obstacles: Sequence[str] | None = None) -> Poses:
        """Subscribes to poses of obstacles that move (all by default); only the newest of each is kept."""
        return Poses(self._session.zenoh, self.name, list(obstacles or self.scene().obstacles), self._incarnation)

    def steps(self) -> Steps:
        """Subscribes to the scalars per step of all objects; a reader that falls behind loses the oldest."""
        return Steps(self._session.zenoh, self.name, incarnation=self._incarnation)

    def reactions(self) -> Steps:
        """Subscribes to what objects exert on obstacles, grabs and each other in each step, sent each millisecond.

        The ObjectSteps that it returns hold object, step, time, contacts and reactions alone.
        """
        return Steps(self._session.zenoh, self.name, "reactions", REACTIONS, self._incarnation)

    @property
    def forces(self) -> Forces:
        """The forces of the newest step; subscribes to them at the first call."""
        if self._forces is None:
            self._forces = self.listen(None)
        return self._forces

    def contact_force(self, first: str, second: str) -> Load:
        """Returns what object `first` exerts on object `second` in the newest step. Raises ClientError."""
        return self.forces.between(first, second, self.timeout)

    def command(
        self, verb: str, interaction: pb.Interaction | None = None, target: pb.ObstacleTarget | None = None,
        **fields: Any,
    ) -> pb.Reply:  # fmt: skip
        """Sends a command and waits for the reply. Raises BadInput if the server refuses it.

        fields: others of Command
        """
        command = self._command(verb, interaction, target)
        command.MergeFrom(pb.Command(**fields))
        return self._ask(command)

    def _ask(self, command: pb.Command, timeout: float | None = None) -> pb.Reply:
        """Sends a command and waits for the reply, `self.timeout` unless told otherwise. Raises BadInput."""
        self._check_right(command.verb)
        payload = command.SerializeToString()
        names = {"verb": command.verb, "client": self.id}
        found = self._queries.ask(
            "command", pb.Reply, payload, self.timeout if timeout is None else timeout, names=names
        )
        if not found:
            there = self._queries.incarnation in self._queries.alive()
            raise self._not_taken(command.verb) if there else self._no_server()
        if found[0].error:
            raise BadInput(f"{command.verb}: {found[0].error}")
        return found[0]

    def send(
        self, verb: str, interaction: pb.Interaction | None = None,
        answered: Callable[[pb.Reply | None], None] = lambda reply: None,
        target: pb.ObstacleTarget | None = None,
    ) -> int:  # fmt: skip
        """Sends a command without waiting for the reply, e.g. to move a grab 1000 times a second.

        Returns its number, by which MoveTaken tells of a move. answered: is called with the reply, or None at the
        time-out, in a thread of zenoh's.
        """
        others: list[pb.Reply] = []  # of another incarnation, as the server may have been restarted
        done_once: list[bool] = []

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is None or done_once:
                return
            with contextlib.suppress(Refused):
                message = read(reply, "command", pb.Reply)
                if message.header.incarnation == self._queries.incarnation:
                    done_once.append(True)
                    answered(message)
                elif not others:
                    others.append(message)

        def done() -> None:
            if not done_once:
                answered(others[0] if others else None)

        self._check_right(verb)
        try:
            command = self._command(verb, interaction, target)
            handler = zenoh.handlers.Callback(take, done)
            payload, names = command.SerializeToString(), {"verb": verb, "client": self.id}
            send_query(self._session.zenoh, self.name, "command", payload, self.timeout, handler, names)
            return command.header.sequence
        except zenoh.ZError as error:
            raise ClientError(f"lost the server {self.name!r} at {self._where}: {error}") from None

    def close(self) -> None:
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def listen(self, on_batch: Callable[[pb.Steps, float], None] | None) -> Forces:
        """Subscribes to the forces of each step. on_batch: as of Forces; close what is returned after use."""
        return Forces(self._session.zenoh, self.name, self._incarnation, on_batch)

    def _incarnation(self) -> int:
        """Of the server whose messages count."""
        return self._queries.incarnation

    def _command(self, verb: str, interaction: pb.Interaction | None, target: pb.ObstacleTarget | None) -> pb.Command:
        if interaction is not None:
            interaction.client = self.id
        header = pb.Header(protocol=PROTOCOL, sequence=next(self._numbers))
        return pb.Command(
            header=header, client=self.id, secret=self.secret, verb=verb, interaction=interaction, target=target
        )

    def _query(
        self, channel: str, kind: type[M], payload: bytes | None = None,
        complete: Callable[[list[M]], bool] = bool,
    ) -> list[M]:  # fmt: skip
        return self._queries.ask(channel, kind, payload, self.timeout, complete)

    def _check_right(self, verb: str) -> None:
        """Raises BadInput if the role of this client's certificate does not have the verb."""
        if self._rights is not None and verb not in self._rights.verbs:
            assert self.identity is not None
            raise BadInput(
                f"{verb}: the certificate {self.identity.name!r} is that of a {self._rights.role}; "
                f"{verb} is for {may(verb) or 'nobody'}"
            )

    def _not_taken(self, verb: str) -> ClientError:
        """The server is there, but nobody takes this command."""
        server = f"server {self.name!r} at {self._where}"
        if self.identity is not None:
            return ClientError(f"{verb}: access rules do not let {self.identity.name!r} through to {server}")
        return ClientError(f"{verb}: {server} does not take this command; is it older than this client, or gone?")

    def _no_server(self) -> ClientError:
        connected = hasattr(self, "_session")
        others = self._servers() if connected else []
        there = f"; there is {', '.join(others)}" if others else "; is it running?"
        if connected and self.identity is not None and (not others or repr(self.name) in others):
            there = (
                f" that answers the certificate {self.identity.name!r}: does {ROLES_FILE} of the server have it, with "
                "the role of a client, and was the server started after it was made?"
            )
        return ClientError(f"no server {self.name!r} at {self._where}{there}")

    def _servers(self) -> list[str]:
        tokens = self._session.zenoh.liveliness().get(f"{ROOT}/*/alive/server/*", timeout=self.timeout)
        names = {str(token.ok.key_expr).split("/")[1] for token in tokens if token.ok is not None}
        return sorted(repr(name) for name in names)


def _begin(wanted: pb.Interaction, at: Point | str) -> None:
    """Sets where the interaction begins: at a named point or at coordinates."""
    if isinstance(at, str):
        wanted.at = at
    else:
        wanted.point.CopyFrom(vector(at, "at"))


def _toml(key: str, value: Any) -> str:
    """Returns the value of a parameter as TOML; text is TOML already. Raises BadInput."""
    try:
        plain = value.tolist() if hasattr(value, "tolist") else value  # of NumPy
        return plain if isinstance(plain, str) else json.dumps(plain)
    except TypeError as error:
        raise BadInput(f"set: {key} = {value!r}: {error}") from None


def vector(values: Point, what: str) -> pb.Vector:
    """Returns three finite numbers as a message. Raises BadInput."""
    numbers = list(values)
    if len(numbers) != 3 or not all(math.isfinite(value) for value in numbers):
        raise BadInput(f"--{what} {' '.join(map(str, numbers))}: allowed are three finite numbers")
    return pb.Vector(x=numbers[0], y=numbers[1], z=numbers[2])


def number(value: float, what: str, positive: bool = False) -> float:
    """Returns a finite number that is not negative, or is positive. Raises BadInput."""
    if not math.isfinite(value) or value < 0 or (positive and value == 0):
        raise BadInput(f"--{what} {value}: allowed is a finite number {'above 0' if positive else 'of at least 0'}")
    return value
