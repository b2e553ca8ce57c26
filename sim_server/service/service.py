# SPDX-License-Identifier: MIT
"""Serves a running simulation: its mailboxes, the log, commands and the network.

Threads:
    loop: Engine.run, native, without Python's lock; Driver.advance for policies that wait for factors
    service: every millisecond or so, and as soon as a matrix or a factor is there, factors, matrices, commands, and
        records for log and subscribers
    recorder and link: have threads of their own for the disk and the network
"""

import contextlib
import logging
import os
import shlex
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.process.notify import Notifier
from protocol.process.nvidia import nvidia_device
from protocol.process.version import version
from sim_server.arrays import Float64
from sim_server.backends.cpu.structs import REACTION
from sim_server.checkpoint.content import capture, restore, restore_driver, saved_factors
from sim_server.checkpoint.file import Checkpoint
from sim_server.network.link import ServerLink
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.service.between_steps import BetweenSteps
from sim_server.service.blades import Blades
from sim_server.service.commands import Commands
from sim_server.service.halts import Halts
from sim_server.service.health import Health
from sim_server.service.need import NeedMeter
from sim_server.service.pace import LOOK_PERIOD, PaceMonitor
from sim_server.service.status_requests import StatusRequests
from sim_server.service.tearing import Tearing
from sim_server.service.telemetry import Telemetry
from sim_server.service.wake import Wake
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from sim_server.updates.first_factors import FirstFactors, few

if TYPE_CHECKING:
    from sim_server.service.supervisor import Supervisor

log = logging.getLogger(__name__)

ROUND_PERIOD = 1e-3  # s that the service thread sleeps between rounds, unless it is woken
HOLD_PERIOD = 1e-4  # the same while the loop is to stand still
WORKERS_PERIOD = 0.02  # s between checks of local workers
SILENT_WAIT = 0.5  # s of waiting for first factors before a line tells of it
MAX_SETS = 64  # commands that wait to set parameters
LOOP_NICE = -5  # of the loop's thread in real time: before workers, clients and our own threads on a full machine
ENDLESS = 1 << 62
SETS = ("set", "cut")  # verbs that set parameters, which takes as long as many rounds
AFTER_SETS = ("step", "resume", "reset", "save")  # verbs that wait for parameters that were to be set before

Change = Callable[[Callable[[pb.Reply], None], pb.Reply], None]
"""A command that waits until the loop stands still; it gives the answer to the reply function."""


class Service:
    """Runs `simulation` on `link` until `steps` are done (None: until told to stop).

    resume: where it goes on; None: at the start. Raises InputError if that is of another scene, or damaged
    """

    def __init__(
        self, simulation: Simulation, link: ServerLink, recorder: Recorder | None = None, steps: int | None = None,
        realtime: bool = True, resume: Checkpoint | None = None,
    ):  # fmt: skip
        self.simulation, self.link, self.recorder, self.steps = simulation, link, recorder, steps
        self.engine = simulation.engine
        self.engine.loop.realtime, self.engine.loop.patient = int(realtime), int(not realtime)
        self.driver = Driver(simulation, link.dispatch)
        self._share_device()
        self.commands = Commands(simulation, self._record_interaction, self._frozen, link.counters)
        self.driver.counters = link.counters
        self.telemetry = Telemetry(self.driver, link, recorder, not realtime, self.commands)
        self._set_intervals()
        self._wake = Wake()
        self.engine.loop.wake, self.driver.wake = self._wake.fd, self._wake.set
        link.dispatch.wake_by(self._wake.set)
        self._batches: deque[tuple[NDArray[Any], ...]] = deque()  # records and what comes with them
        self._failure: BaseException | None = None
        self._status_requests = StatusRequests(
            lambda where: self.telemetry.publish_status(self._state(), where=where), self.telemetry.fetch_places
        )
        self._halts = Halts(self.commands)
        self._between = BetweenSteps(self.engine.loop)
        self._start = Start(simulation)
        self._tearing, self._blades = Tearing(simulation), Blades(simulation)
        self._sets: deque[tuple[pb.Command, Callable[[pb.Reply], None]]] = deque()  # that set parameters
        self._workers_due = self._pace_due = self._set_due = 0.0
        self.check_workers: Callable[[], None] = lambda: None  # called every WORKERS_PERIOD
        self.check_page: Callable[[], None] = lambda: None  # as often
        self.pace = PaceMonitor(simulation.world.dt, self._advice, not self._on_gpu) if realtime else None
        self._loop_alone = not self.driver.wants_factors or self.driver.policy.free  # no step waits for Python
        self._first = self._first_factors(realtime)
        self.say: Callable[[str], None] = lambda text: None  # tells of progress on the terminal
        self._told_of_wait = False
        if resume is not None:
            manifest = restore(simulation, resume)
            restore_driver(self.driver, manifest, saved_factors(simulation, resume, manifest))
        self._last = None if steps is None else self.engine.step + steps
        self.telemetry.open(resume)
        self.health = Health(Notifier())
        self.need = NeedMeter(self.driver)

    def _share_device(self) -> None:
        """Has matrices and factors stay on the device where workers can open its memory, and no step waits for them."""
        if self.driver.wants_factors and self.driver.policy.free and (memory := self.engine.shared_memory()):
            memory.sums = self.recorder is not None
            self.link.share_device(memory)

    def _first_factors(self, realtime: bool) -> FirstFactors | None:
        """Returns the first factors that the first step waits for; None: it goes without."""
        driver, wish = self.driver, self.simulation.scene.solver.first_factor
        if not (driver.wants_factors and driver.policy.free and (wish or ("wait" if realtime else "go")) == "wait"):
            return None
        return FirstFactors(driver)

    def ready(self) -> bool:
        """False while a worker, shared memory or the device is made ready for the first factors. Takes in what workers
        tell of them."""
        if not self.driver.wants_factors:
            return True
        dispatch = self.link.dispatch
        self.driver.expect_factors(dispatch)
        idle = any(worker.idle for worker in dispatch.workers())
        return idle and not dispatch.makes_slots() and self.engine.expects_factors()

    def supervise(self, supervisor: "Supervisor") -> None:
        """Has the local workers of `supervisor` restarted, shown in the status, added and killed by clients."""
        self.check_workers, self.link.local_workers = supervisor.check, supervisor.local_workers
        self.commands.supervisor = supervisor

    def _frozen(self, name: str) -> bool:
        """Returns True for an object that has run away and is frozen."""
        return name in self.driver.by_name and self.driver.by_name[name].frozen

    def run(self, is_told_to_end: Callable[[], bool] = lambda: False) -> None:
        """Blocks until the run is over.

        is_told_to_end: looked at between rounds; what a round has taken from the loop is in the log then. An exception
        in the middle of one, such as KeyboardInterrupt, ends the loop, too, and is then raised
        """
        if not self.link.dispatch.workers():
            self._first = None  # nobody makes any
        loop = threading.Thread(target=self._loop, name="loop")
        if self._loop_alone:
            self._drain()  # asks for the matrices of the first step, and not of the one that is due dt later
        try:
            loop.start()  # inside: a signal may come before it returns, when the thread runs already
            while loop.is_alive() and not (self.commands.stopping or is_told_to_end()):
                begin = time.monotonic()
                self.round()
                if self._between.waits and self._first is None:
                    time.sleep(HOLD_PERIOD)
                else:
                    self._wake.rest(begin, ROUND_PERIOD)
        finally:
            self.engine.loop.stop, self.engine.loop.wake = 1, 0
            while loop.is_alive():  # it may wait for room in its rings
                self._drain()
                self._halts.answer()
                loop.join(0.01)
            self._between.run()
            self._halts.answer(ended=True)
            for _, reply in self._sets:
                reply(pb.Reply(error="the server stops: nothing was set"))
            self._sets.clear()
            self._drain()
            self.telemetry.publish_status("stopping")
        if self._failure is not None:
            raise self._failure

    def _loop(self) -> None:
        if self.engine.loop.realtime:
            with contextlib.suppress(OSError, AttributeError):  # needs a privilege, and Linux
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOOP_NICE)
        try:
            if self._loop_alone:
                first = self._first if self._last is None or self.engine.step < self._last else None
                if first is None or ((due := self.engine.wait()) and first.run(due)):
                    self.engine.run(ENDLESS if self._last is None else self._last - self.engine.step)
                return
            while not self.engine.loop.stop and (self._last is None or self.engine.step < self._last):
                self._batches.append((self.driver.advance(1), *self.driver.beside_records))
        except BaseException as error:
            self._failure = error

    def round(self) -> None:
        """Does all that is due, without waiting."""
        self._drain()
        if time.monotonic() >= self._workers_due:
            self._workers_due = time.monotonic() + WORKERS_PERIOD
            self.check_workers()
            self.check_page()
            self.link.check_name()
        self._carry_out()
        self._set_parameters()
        self._tearing.look()
        self._blades.look()
        if self._between.may_run:
            self._drain()
            self._between.run()
        self._halts.answer()
        self._status_requests.answer()
        if not self._awaits_factors():
            self._check_pace()
        self.commands.release_absent(set(self.link.clients()))
        self.health.look(self.engine.step, self.commands.engine_paused or self._first is not None)
        self.telemetry.publish_status(self._state(), force=False)
        if self.need.look():
            self.link.publish_need(self.need.lost)

    def _carry_out(self) -> None:
        """Carries out all commands that wait; answers them once the loop has what they change."""
        waiting = self.link.commands()
        if not waiting:
            return
        answers: list[tuple[Callable[[pb.Reply], None], pb.Reply]] = []
        done: list[pb.Command] = []
        with self.commands.together():
            for command, reply in waiting:
                if command.verb in SETS:
                    self._defer(command, reply)
                    continue
                if command.verb == "status":
                    self._status_requests.add(reply)
                    continue
                while self._sets and command.verb in AFTER_SETS:
                    self._set_oldest()
                answer = self.commands.carry_out(command)
                if self._halts.add(command, reply, answer):
                    continue
                if command.verb in ("reset", "save") and not answer.error:
                    change = self._save if command.verb == "save" else self._resetting(command.object)
                    self._between.add(partial(self._carry_out_between, change, reply, answer))
                    continue
                answers.append((reply, answer))
                if not answer.error:
                    done.append(command)
        self.telemetry.reactions.moved(done)
        for reply, answer in answers:
            reply(answer)

    def _defer(self, command: pb.Command, reply: Callable[[pb.Reply], None]) -> None:
        """Has parameters set in one of the next rounds."""
        if len(self._sets) < MAX_SETS:
            self._sets.append((command, reply))
        else:
            reply(pb.Reply(error=f"the server is busy: {MAX_SETS} commands wait to set parameters"))

    def _set_parameters(self) -> None:
        """Carries out the oldest command that sets parameters. With large bodies one takes as long as many rounds, so
        that half of the time is kept for all else."""
        begin = time.monotonic()
        if self._sets and begin >= self._set_due:
            self._set_oldest()
            end = time.monotonic()
            self._set_due = 2 * end - begin

    def _set_oldest(self) -> None:
        command, reply = self._sets.popleft()
        reply(self.commands.carry_out(command))

    def _carry_out_between(self, change: Change, reply: Callable[[pb.Reply], None], answer: pb.Reply) -> None:
        """Carries out what was to wait until the loop stands still. If it fails the client is told; others go on."""
        if self._failure is not None:
            reply(pb.Reply(error="the loop has failed"))
            return
        try:
            change(reply, answer)
        except Exception as error:
            log.exception("a command between two steps failed")
            reply(pb.Reply(error=f"it failed: {error}"))

    def _save(self, reply: Callable[[pb.Reply], None], answer: pb.Reply) -> None:
        """Copies the state while the loop stands still; a thread makes the file of it, offers it and answers."""
        self.commands.stamp(answer.status)
        checkpoint = capture(self.simulation, self.driver, f"warpfactor {version()}")

        def offer() -> None:
            try:
                self.link.set_checkpoint(pb.Checkpoint(step=answer.status.step, data=checkpoint.to_bytes()))
            except ValueError as error:  # too large
                reply(pb.Reply(error=str(error)))
                return
            reply(answer)

        threading.Thread(target=offer, name="checkpoint", daemon=True).start()

    def _resetting(self, name: str) -> Change:
        """Returns the reset of an object or all. What clients push and move until it is carried out comes after it."""
        touch = self.simulation.touch
        known = {a.id for a in touch.alive()} if touch is not None else set[int]()
        return partial(self._reset, name, known, [m.targets for m in self.simulation.movers])

    def _reset(
        self, name: str, touching: set[int], targets: list[dict[str, Float64]], reply: Callable[[pb.Reply], None],
        answer: pb.Reply,
    ) -> None:  # fmt: skip
        """Puts an object or all back to the start, while the loop stands still.

        touching, targets: ids of pushes and grabs, and poses that were wanted, when it was commanded
        """
        if self.simulation.touch is not None:
            self.simulation.touch.release_of(name, touching)
        now = [m.targets for m in self.simulation.movers]
        self._start.reset(name)
        self._blades.restart()
        for mover, old, new in zip(self.simulation.movers, targets, now, strict=True):
            if moved := {k: pose for k, pose in new.items() if not np.array_equal(pose, old[k])}:
                mover.restore(moved)
        for state in self.driver.bodies:
            if name in ("", state.body.name):
                state.frozen = False
        self.telemetry.on_reset(name, self.commands.engine_paused)
        self.commands.stamp(answer.status)
        reply(answer)

    def _awaits_factors(self) -> bool:
        """Returns True while the first step waits for factors. Tells of it: in the status, and if it lasts, a line."""
        first = self._first
        if first is None:
            return False
        if not first.done:
            text = f"waiting for the first factor of {few(first.missing)}"
            begins = not self.telemetry.pace
            self.telemetry.pace = text if first.missing else self.telemetry.pace
            if begins:
                self.telemetry.publish_status(self._state())
            if not self._told_of_wait and first.begun and time.monotonic() - first.begun > SILENT_WAIT:
                self._told_of_wait = True
                self.say(text)
            return True
        self._first, self.telemetry.pace = None, ""
        if self._told_of_wait:
            self.say(f"waited {first.seconds:.1f} s for first factors")
        if first.missing:
            log.warning("no first factor of %s after %.0f s: it goes on without", few(first.missing), first.seconds)
        self.telemetry.publish_status(self._state())
        return False

    def _check_pace(self) -> None:
        """Logs a line if the run does not keep pace with the clock."""
        now = time.monotonic()
        if self.pace is None or now < self._pace_due:
            return
        self._pace_due = now + LOOK_PERIOD
        warm = not self.driver.wants_factors or all(state.factors.used for state in self.driver.bodies)
        line = self.pace.check(now, self.engine.step, self._state() != "running", warm)
        if line:
            log.warning("%s", line)
        self.telemetry.pace = self.pace.verdict

    @property
    def _on_gpu(self) -> bool:
        return self.simulation.world.backend.name == "gpu"

    def _advice(self) -> str:
        """Returns what makes steps shorter, or gives them more time."""
        ways = ["a larger dt (--set dt=...)", "a coarser mesh"]
        workers = len(self.link.dispatch.workers())
        if self.driver.wants_factors and workers < len(self.driver.bodies):
            ways.append("more workers" if workers else "a worker (--workers 1)")
        if not self._on_gpu and nvidia_device():
            ways.append("--device gpu")
        scene, dt = shlex.quote(str(self.simulation.scene.path)), 1e3 * self.simulation.world.dt
        ways.append(f"other settings (sim-client plan {scene} --budget-ms {dt:g})")
        return f"What helps: {', '.join(ways)}; --free-run does without the clock"

    def _drain(self) -> None:
        if self._first is not None and not self._first.done:
            return  # no step is made yet, and the policy is not to act
        if self._loop_alone:
            self._report(self.driver.pump(), *self.driver.beside_records)
            return
        batches = [self._batches.popleft() for _ in range(len(self._batches))]
        if batches:
            self._report(*(np.concatenate(part) for part in zip(*batches, strict=True)))
        else:
            none = np.zeros((0, len(self.simulation.world.obstacles), 6))
            self._report(np.zeros(0, self.engine.records_dtype), none, np.zeros(0, REACTION), np.zeros((0, 0)))

    def _report(
        self, records: NDArray[Any], on_obstacles: Float64, others: NDArray[Any], readings: Float64
    ) -> None:  # fmt: skip
        """Passes on new step records with what objects exerted on obstacles and others, readings, and new frames."""
        contact = self.telemetry.contact
        undone = [*contact.count_clipped(records), *contact.crowded_nodes(), *contact.broken_ties()]
        for line in [*self.telemetry.warnings.warnings(records), *self.telemetry.losses(), *undone]:
            log.warning("%s", line)
        for line in self.telemetry.warnings.errors(records):
            log.error("%s", line)
        if self.pace is not None and len(records):
            self.pace.add(records)
        exerted = messages.reactions(self.simulation, on_obstacles, others)
        self.telemetry.records(records, exerted, messages.readings(self.simulation, readings))
        self.telemetry.frames()
        self._set_intervals()

    def _set_intervals(self) -> None:
        """Sets how often the loop copies frames and evaluates elastic energies: as subscribers and the log need."""
        self.engine.loop.frame_every = self.telemetry.frame_interval()
        self.engine.loop.energy_every = self.telemetry.energy_interval()

    def _state(self) -> str:
        if self.commands.stopping:
            return "stopping"
        return "paused" if self.commands.engine_paused else "running"

    def _record_interaction(self, interaction: pb.Interaction, time: float) -> None:
        if self.recorder:
            self.recorder.interaction(interaction, time)
