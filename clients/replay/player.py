# SPDX-License-Identifier: MIT
"""Publishes a log as if its server were live: same keys, same messages, at any speed."""

from __future__ import annotations

import math
import os
import time
from collections import Counter, deque

import numpy as np
import zenoh

from clients.errors import BadInput
from clients.log.scalars import ENUMS
from clients.replay.replay_server import ReplayServer
from clients.replay.timeline import Timeline
from protocol import messages_pb2 as pb

STEPS_PERIOD, STATE_PERIOD, STATUS_PERIOD = 0.05, 1 / 30, 1.0  # s, as of a server
POLL = 0.02  # s between two readings of the commands
WINDOW = 1000  # steps of means and percentiles
COUNTED = ("fallbacks", "halvings")  # fields above 0 in a step that the status counts, beside those not converged


class Player:
    """Plays `timeline` on `server`. speed: simulated seconds per second; inf: as fast as possible, nothing dropped.

    begin, end [s of simulation]: the part that is played. `states`, `steps`: numbers of messages sent.
    """

    def __init__(
        self, timeline: Timeline, server: ReplayServer, speed: float = 1.0, begin: float = 0, end: float = math.inf
    ):
        self.timeline, self.server, self.speed = timeline, server, speed
        self.begin, self.end = begin, min(end, timeline.end)
        if self.begin > timeline.end or self.begin > end:
            raise BadInput(
                f"{timeline.path}: --from {begin:g} --to {end:g}: nothing there; it holds 0 to {timeline.end:g} s"
            )
        self.states = self.steps = 0
        self.stopping = self.paused = False
        self._started = time.monotonic()
        self._time, self._at = self.begin, self._started  # simulated time, and when it is due
        self._due = {"steps": 0.0, "status": 0.0}
        self._batch: list[pb.ObjectStep] = []
        self._newest: dict[str, pb.State | pb.ObstaclePose] = {}  # not sent yet
        self._sent_at: dict[str, float] = {}
        self._status = pb.Status(scene=timeline.scene.name, dt=timeline.scene.dt, pid=os.getpid())
        self._status.device = f"replay of {timeline.path.name}"
        self._objects = {name: self._status.objects.add(object=name) for name in timeline.scene.objects}
        self._whole: dict[str, pb.Topology] = {}  # the last one of each object that has all elements
        self._events: dict[str, Counter[str]] = {name: Counter() for name in self._objects}
        self._iterations: dict[str, deque[int]] = {name: deque(maxlen=WINDOW) for name in self._objects}
        self._seconds: deque[float] = deque(maxlen=WINDOW)
        server.offer("scene", timeline.scene)
        for _, name, message in timeline.between(math.inf, 0):  # queryable from the start
            self._offer(name, message)
        self._publish_status("running")

    def play(self, loop: bool = False) -> None:
        """Sends all messages, again and again if `loop`; returns at the end or after a command `stop`."""
        try:
            while not self.stopping:
                self._once()
                if not loop:
                    break
                self._wait(self.end + self.timeline.scene.dt)  # the last state is shown as long as any other
        finally:
            self._publish_status("stopping")

    def _once(self) -> None:
        self._time, self._at = self.begin, time.monotonic()
        for name, found in self._objects.items():  # counts begin anew
            found.clipped = 0
            self._events[name].clear()
        for when, name, message in self.timeline.between(self.begin, self.end):
            if not self._wait(when):
                return
            if isinstance(message, pb.Topology | pb.Obstacle):
                self._offer(name, message)
            elif isinstance(message, pb.ObjectStep):
                self._step(name, message)
            elif isinstance(message, pb.State | pb.ObstaclePose):
                self._newest[name] = message
                self._send_states(hold=self.speed < math.inf)
        self._send_states(hold=False)
        self._send_steps()

    # --- time ---------------------------------------------------------------------------------------------------

    def _wait(self, when: float) -> bool:
        """Waits until `when` [s of simulation] is due; returns False if the replay is to stop."""
        if when > self._time:
            self._at += (when - self._time) / self.speed
            self._time = when
        while True:
            self._serve()
            if self.stopping:
                return False
            now = time.monotonic()
            if self.paused:
                self._at = max(self._at, now)
            elif now >= self._at:
                return True
            time.sleep(POLL if self.paused else min(POLL, self._at - now))

    def _serve(self) -> None:
        """Executes commands; sends steps, states and status when they are due."""
        for verb, query in self.server.commands():
            self._execute(verb, query)
        now = time.monotonic()
        if now >= self._due["steps"]:
            self._due["steps"] = now + STEPS_PERIOD
            self._send_steps()
            self._send_states(hold=True)
        if now >= self._due["status"]:
            self._publish_status("paused" if self.paused else "running")

    def _execute(self, verb: str, query: zenoh.Query) -> None:
        reply = pb.Reply()
        if verb in ("pause", "resume"):
            reply.unchanged = self.paused == (verb == "pause")
            self.paused = verb == "pause"
        elif verb == "stop":
            self.stopping = True
        elif verb != "status":
            reply.error = f"this is a replay of {self.timeline.path.name}: it takes pause, resume and stop, no {verb!r}"
        self._publish_status("stopping" if self.stopping else "paused" if self.paused else "running")
        if verb in ("pause", "resume", "stop"):
            reply.status.state, reply.status.step, reply.status.time = (
                self._status.state, self._status.step, self._status.time
            )  # fmt: skip
        self.server.answer(query, reply)

    # --- messages -----------------------------------------------------------------------------------------------

    def _offer(self, name: str, message: object) -> None:
        if isinstance(message, pb.Obstacle):
            self.server.offer("obstacle", message, object=name)
            return
        assert isinstance(message, pb.Topology)
        topology = self._complete(name, message)
        if topology is None:
            return
        self.server.offer("topology", topology, object=name)
        self.server.put("topology", topology, wait=True, object=name)
        if name in self._objects:
            left = len(topology.tets) // 16 - len(topology.removed) // 4
            self._objects[name].nodes, self._objects[name].tets = topology.nodes, max(left, 0)

    def _complete(self, name: str, message: pb.Topology) -> pb.Topology | None:
        """Returns a topology as a server tells it: of a cut the log has only what it changes.

        None: the mesh that was cut is not in the log.
        """
        if message.tets or not message.cut:
            self._whole[name] = message
            return message
        if name not in self._whole:
            return None
        topology = pb.Topology()
        topology.CopyFrom(self._whole[name])
        topology.cut, topology.removed = message.cut, message.removed
        topology.triangles, topology.skin_triangles = message.triangles, message.skin_triangles
        return topology

    def _step(self, name: str, message: pb.ObjectStep) -> None:
        self._batch.append(message)
        if name in self._objects:
            self._objects[name].last.CopyFrom(message)
            self._objects[name].clipped += message.clipped
            if message.status != pb.CONVERGED:
                self._events[name][ENUMS["status"].get(message.status, "unknown")] += 1
            self._events[name].update(field for field in COUNTED if getattr(message, field))
            self._iterations[name].append(message.iterations)
            if name == self.timeline.scene.objects[0]:
                self._seconds.append(message.step_seconds)
        self._status.step, self._status.time = message.step, message.time
        if len(self._batch) >= 4096:
            self._send_steps()

    def _send_steps(self) -> None:
        if self._batch:
            self.server.put("steps", pb.Steps(steps=self._batch), wait=self.speed == math.inf)
            self.steps += len(self._batch)
            self._batch = []

    def _send_states(self, hold: bool) -> None:
        """Sends the newest state of each object; hold: at most one per STATE_PERIOD and object, as a server does."""
        now = time.monotonic()
        for name, message in list(self._newest.items()):
            if hold and now - self._sent_at.get(name, -math.inf) < 0.9 * STATE_PERIOD:
                continue
            channel = "state" if isinstance(message, pb.State) else "pose"
            self.server.put(channel, message, wait=self.speed == math.inf, object=name)
            self.states += channel == "state"
            self._sent_at[name] = now
            del self._newest[name]

    def _publish_status(self, state: str) -> None:
        status = self._status
        self._due["status"] = time.monotonic() + STATUS_PERIOD
        status.state, status.uptime = state, time.monotonic() - self._started
        if self._seconds:
            status.step_p50, status.step_p99, status.step_max = np.percentile(self._seconds, [50, 99, 100]).tolist()
        for name, found in self._objects.items():
            del found.events[:]
            found.events.extend(pb.EventCount(event=e, steps=n) for e, n in self._events[name].most_common())
            if self._iterations[name]:
                found.mean_iterations = float(np.mean(self._iterations[name]))
        self.server.offer("status", status)
        self.server.put("status", status)


def speed_of(text: str) -> float:
    """Parses 'max' or a number above 0. Raises BadInput."""
    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0 < speed < math.inf:
        raise BadInput(f"--speed {text}: allowed are max or a number above 0, 1 being as fast as it was simulated")
    return speed
