# SPDX-License-Identifier: MIT
"""What the server tells: a connection that is made again when the server is gone, and the newest of everything.

`Feed.link` has one connection; a thread of its own asks for the status and the parameters, so that a slow answer holds
up no frame.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Literal

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.log.frames import Frame, Mesh
from clients.log.obstacles import Obstacle, ObstacleFrame
from protocol import messages_pb2 as pb

STATUS_PERIOD = 0.5  # s between two questions for status and parameters
LOST_AFTER = 2  # questions without an answer
MESH_PERIOD = 0.3  # s between two questions for meshes of a body that is being cut
RETRY_PERIOD = 0.5  # s between two attempts to connect
QUESTION_TIMEOUT = 2.0  # s
RENEWED_AFTER = 1.5  # s after a change of parameters; a server renews moduli each second
DROPPED_FOR = 10.0  # s before another attempt with a scene that cannot be shown

log = logging.getLogger(__name__)


class Link:
    """One connection to one run of the server. Raises ClientError, BadInput."""

    def __init__(self, server: str, connect: Sequence[str] | None) -> None:
        self.client = Client(server, connect, timeout=QUESTION_TIMEOUT)
        try:
            self.scene: pb.Scene = self.client.scene()
            self.meshes: dict[str, Mesh] = self.client.meshes()
            self.obstacles: dict[str, Obstacle] = self.client.obstacles()
            if set(self.scene.objects) != set(self.meshes):
                raise ClientError("the server has not announced all its meshes")
            self._states = self.client.states(sorted(self.meshes))
            self._steps = self.client.steps()
            self._poses = self.client.poses(sorted(self.obstacles)) if self.obstacles else None
        except BaseException:
            self.client.close()
            raise
        self.incarnation = self.scene.header.incarnation
        self.status = pb.Status()
        self.parameters: list[pb.LiveParameter] = []
        self._new_meshes: dict[str, Mesh] | None = None  # with moduli that were set
        self._elastic: dict[str, str] | None = None  # values of the effects of objects
        self._cut, self._meshes_due = False, 0.0  # frames are of another mesh; when it may be asked for
        self._renew_at: float | None = None  # when the meshes are to be asked for again
        self.lost = ""  # why the connection is over; empty: it is not
        self._stop, self._asked = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._ask, name="status", daemon=True)
        self._thread.start()

    def frames(self) -> list[Frame]:
        """Returns new frames, of each object the newest. One of another mesh than ours has the meshes asked for."""
        frames = self._states.newest()
        if any(f.object in self.meshes and f.epoch != self.meshes[f.object].epoch for f in frames):
            self._cut = True
            self.ask_now()
        return frames

    def steps(self) -> list[pb.ObjectStep]:
        """Returns new steps of all objects."""
        return self._steps.new()

    def poses(self) -> list[ObstacleFrame]:
        """Returns new poses, of each obstacle the newest."""
        return self._poses.newest() if self._poses is not None else []

    def take_meshes(self) -> Literal["", "moduli", "cut"]:
        """Returns what is new of the meshes since the last call; `meshes` has it then."""
        new, self._new_meshes = self._new_meshes, None
        if new is None:
            return ""
        cut = any(mesh.epoch != self.meshes[name].epoch for name, mesh in new.items())
        self.meshes = new
        return "cut" if cut else "moduli"

    def ask_now(self) -> None:
        """Has status and parameters asked for at once."""
        self._asked.set()

    def close(self) -> None:
        self._stop.set()
        self._asked.set()
        with contextlib.suppress(Exception):  # zenoh's, of a session that is broken already
            self.client.close()

    def _ask(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                self.status = self.client.status()
                if self.status.header.incarnation != self.incarnation:
                    raise ClientError("the server was started again")
                failures = 0
                self._ask_meshes()
                self._ask_parameters()
                self._ask_moduli()
            except (ClientError, BadInput) as error:
                failures += 1
                if failures >= LOST_AFTER or self.status.header.incarnation not in (0, self.incarnation):
                    self.lost = str(error)
                    return
            except Exception:
                if not self._stop.is_set():
                    log.exception("the status of the server cannot be read")
                    self.lost = "its status cannot be read"
                return
            self._asked.wait(STATUS_PERIOD)
            self._asked.clear()

    def _ask_meshes(self) -> None:
        """Gets the meshes again after a cut."""
        if self._cut and time.monotonic() >= self._meshes_due:
            self._meshes_due = time.monotonic() + MESH_PERIOD
            self._cut = False  # before it is asked: a frame of a later cut may come until the answer does
            found = None
            with contextlib.suppress(ClientError):  # a late answer
                found = self.client.meshes()
            if found is not None and found.keys() == self.meshes.keys():
                self._new_meshes = found
            else:
                self._cut = True

    def _ask_parameters(self) -> None:
        """Gets the parameters; a replay of a log has none, and a late answer leaves those that are known."""
        try:
            self.parameters = self.client.parameters()
        except BadInput:
            self.parameters = []
        except ClientError:
            pass

    def _ask_moduli(self) -> None:
        """Gets the meshes again once parameters of the objects' effects have changed, and then rest for a while."""
        values = {p.now.key: p.now.value for p in self.parameters if p.now.key.startswith("object.")}
        known, self._elastic = self._elastic, values
        if not known or not values:
            return
        if values != known:
            self._renew_at = time.monotonic() + RENEWED_AFTER
        elif self._renew_at is not None and time.monotonic() >= self._renew_at:
            self._renew_at = None
            with contextlib.suppress(ClientError):  # a late answer: colours and springs stay as they are
                found = self.client.meshes()
                if _other_moduli(found, self.meshes):
                    self._new_meshes = found


def _other_moduli(new: Mapping[str, Mesh], old: Mapping[str, Mesh]) -> bool:
    """Returns True if the same objects have other moduli."""
    if new.keys() != old.keys() or any(len(new[name].young) != len(old[name].young) for name in old):
        return False
    return any(
        (new[name].young != mesh.young).any() or (new[name].poisson != mesh.poisson).any() for name, mesh in old.items()
    )


class Feed:
    """The link to the server while there is one. `error`: why there is none."""

    def __init__(self, server: str, connect: Sequence[str] | None) -> None:
        self.server, self.connect = server, connect
        self.link: Link | None = None
        self.error = ""
        self._due = 0.0

    def check(self) -> bool:
        """Connects if that is due, drops a link that is lost; True if the link is another one than before."""
        if self.link is not None:
            if not self.link.lost:
                return False
            self.error = self.link.lost
            self.link.close()
            self.link, self._due = None, time.monotonic() + RETRY_PERIOD
            return True
        if time.monotonic() < self._due:
            return False
        self._due = time.monotonic() + RETRY_PERIOD
        try:
            self.link = Link(self.server, self.connect)
        except ClientError as error:
            self.error = str(error)
            return False
        self.error = ""
        return True

    def drop(self, why: str) -> None:
        """Gives up a link that cannot be used, and waits longer than usual before the next one."""
        if self.link is not None:
            self.link.close()
        self.link, self.error, self._due = None, why, time.monotonic() + DROPPED_FOR

    def close(self) -> None:
        if self.link is not None:
            self.link.close()
