# SPDX-License-Identifier: MIT
"""The server at work: one thread runs the loop, this one serves its mailboxes, the log and the network.

loop thread      Engine.run, native, without Python's lock (policies that wait by their nature run Driver.advance)
service thread   here: factors in, matrices out, commands, records to log and listeners, every millisecond or so
recorder, link   threads of their own for the disk and the network
"""

import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.process.nvidia import nvidia_device
from sim_server.network.link import ServerLink
from sim_server.recording.recorder import Recorder
from sim_server.recording.replay_recorder import Trace
from sim_server.service.commands import Commands
from sim_server.service.pace import LOOKS, Pace
from sim_server.service.telemetry import Telemetry
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver

log = logging.getLogger(__name__)

NAP = 1e-3  # s between rounds of the service thread
BESIDE = 0.02  # s between looks at local workers
STATUS_AGAIN = 0.02  # s between two statuses that clients ask for
STEP_ENDS = 1.0  # s that the answer to `pause` or `stop` waits at most for the end of the step under way
HALTS = 64  # such answers that may wait at once
LOOP_NICE = -5  # of the loop's thread in real time: before workers, clients and our own threads on a full machine
ENDLESS = 1 << 62


class Service:
    """Runs `simulation` on `link` until `steps` are done (None: until told to stop)."""

    def __init__(
        self, simulation: Simulation, link: ServerLink, recorder: Recorder | None = None, steps: int | None = None,
        realtime: bool = True,
    ):  # fmt: skip
        self.simulation, self.link, self.recorder, self.steps = simulation, link, recorder, steps
        self.engine = simulation.engine
        self.engine.loop.realtime, self.engine.loop.patient = int(realtime), int(not realtime)
        self.driver = Driver(simulation, link.dispatch)
        self.telemetry = Telemetry(self.driver, link, recorder, patient=not realtime)
        self.commands = Commands(simulation, self._accepted)
        self.commands.frozen = lambda name: name in self.driver.by_name and self.driver.by_name[name].frozen
        self.telemetry.commands = self.commands
        self.telemetry.trace = Trace(self.driver, link, recorder) if recorder else None
        self._ask_loop()
        self._waiting: deque[NDArray[Any]] = deque()
        self._failure: BaseException | None = None
        self._asked: list[Callable[[pb.Reply], None]] = []  # those who want a fresh status
        self._halts: list[tuple[float, Callable[[pb.Reply], None], pb.Reply]] = []  # pause and stop, until when to wait
        self._status_due = self._beside_due = self._pace_due = 0.0
        self.beside: Callable[[], None] = lambda: None  # called now and then: the supervisor of local workers
        self.pace = Pace(simulation.world.dt, self._advice, not self._on_gpu) if realtime else None
        self._alone = not self.driver.wants_factors or self.driver.free  # the loop needs no Python
        self.telemetry.open()

    def run(self) -> None:
        """Blocks until the run is over; KeyboardInterrupt passes through after a clean end of the loop."""
        loop = threading.Thread(target=self._loop, name="loop")
        loop.start()
        try:
            while loop.is_alive() and not self.commands.stopping:
                self.round()
                time.sleep(NAP)
        finally:
            self.engine.loop.stop = 1
            while loop.is_alive():  # it may wait for room in its rings
                self._drain()
                self._answer_halts()
                loop.join(0.01)
            self._answer_halts(ended=True)
            self._drain()
            self.telemetry.publish_status("stopping")
        if self._failure is not None:
            raise self._failure

    def _loop(self) -> None:
        if self.engine.loop.realtime:
            with contextlib.suppress(OSError, AttributeError):  # needs a privilege, and Linux
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOOP_NICE)
        try:
            if self._alone:
                self.engine.run(ENDLESS if self.steps is None else self.steps)
                return
            while not self.engine.loop.stop and (self.steps is None or self.engine.step < self.steps):
                self._waiting.append(self.driver.advance(1))
        except BaseException as error:
            self._failure = error

    def round(self) -> None:
        """One turn of the service thread: everything that is due, nothing that waits."""
        self._drain()
        if time.monotonic() >= self._beside_due:
            self._beside_due = time.monotonic() + BESIDE
            self.beside()
            self.link.check_name()
        self._carry_out()
        self._answer_halts()
        self._tell_status()
        self._look_at_pace()
        self.commands.gone(set(self.link.clients()))
        self.telemetry.publish_status(self._state(), force=False)

    def _carry_out(self) -> None:
        """All commands that wait; they are answered once the loop has what they change."""
        waiting = self.link.commands()
        if not waiting:
            return
        answers = []
        with self.commands.together():
            for command, reply in waiting:
                if command.verb == "status":
                    self._asked.append(reply)
                    continue
                answer = self.commands.carry_out(command)
                if command.verb in ("pause", "stop") and not answer.error and len(self._halts) < HALTS:
                    self._halts.append((time.monotonic() + STEP_ENDS, reply, answer))
                else:
                    answers.append((reply, answer))
        for reply, answer in answers:
            reply(answer)

    def _answer_halts(self, ended: bool = False) -> None:
        """Answers those who paused or stopped the loop once it has, with the number of its steps."""
        waiting = []
        for until, reply, answer in self._halts:
            stands = self.commands.engine_stands or not self.commands.engine_paused  # or it goes on already
            if (stands and answer.status.state == "paused") or ended or time.monotonic() >= until:
                self.commands.date(answer.status)
                reply(answer)
            else:
                waiting.append((until, reply, answer))
        self._halts = waiting

    def _tell_status(self) -> None:
        """A fresh one to all who asked since the last: it costs more than any other command."""
        if self._asked and time.monotonic() >= self._status_due:
            self.telemetry.publish_status(self._state(), where=True)
            self._status_due = time.monotonic() + STATUS_AGAIN
            for reply in self._asked:
                reply(pb.Reply())
            self._asked.clear()

    def _look_at_pace(self) -> None:
        """Says so if the run does not keep pace with the clock."""
        now = time.monotonic()
        if self.pace is None or now < self._pace_due:
            return
        self._pace_due = now + LOOKS
        warm = not self.driver.wants_factors or all(state.factors.used for state in self.driver.bodies)
        line = self.pace.look(now, self.engine.step, self._state() != "running", warm)
        if line:
            log.warning("%s", line)
        self.telemetry.pace = self.pace.verdict

    @property
    def _on_gpu(self) -> bool:
        return self.simulation.world.backend.name == "gpu"

    def _advice(self) -> str:
        """What makes steps take less time, or lets them take it."""
        ways = ["a larger dt (--set dt=...)", "a coarser mesh"]
        workers = len(self.link.dispatch.workers())
        if self.driver.wants_factors and workers < len(self.driver.bodies):
            ways.append("more workers" if workers else "a worker (--workers 1)")
        if not self._on_gpu and nvidia_device():
            ways.append("--device gpu")
        return f"What helps: {', '.join(ways)}; --free-run does without the clock"

    def _drain(self) -> None:
        if self._alone:
            records = self.driver.pump()
        else:
            batches = [self._waiting.popleft() for _ in range(len(self._waiting))]
            records = np.concatenate(batches) if batches else np.zeros(0, self.engine.records_dtype)
        for line in self.telemetry.count(records):
            log.warning("%s", line)
        for line in [*self.telemetry.count_runaways(records), *self.telemetry.bad_steps(records)]:
            log.error("%s", line)
        if self.pace is not None and len(records):
            self.pace.note(records)
        self.telemetry.records(records)
        self.telemetry.frames()
        self._ask_loop()

    def _ask_loop(self) -> None:
        """Has it make the frames and energies that somebody looks at."""
        self.engine.loop.frame_every = self.telemetry.wanted_frames()
        self.engine.loop.energy_every = self.telemetry.wanted_energies()

    def _state(self) -> str:
        if self.commands.stopping:
            return "stopping"
        return "paused" if self.commands.engine_paused else "running"

    def _accepted(self, interaction: pb.Interaction, time: float) -> None:
        if self.recorder:
            self.recorder.interaction(interaction, time)
