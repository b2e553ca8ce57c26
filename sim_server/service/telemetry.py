# SPDX-License-Identifier: MIT
"""What the loop reports, on its way to the log and to whoever listens."""

import os
import time
from collections import Counter, deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.method import Method
from sim_server.backends.kinds import BALANCE
from sim_server.mechanics.named_points import NamedPoints
from sim_server.network.link import ServerLink
from sim_server.recording import messages as describe
from sim_server.recording.recorder import Recorder
from sim_server.recording.replay_recorder import Trace
from sim_server.service.commands import Commands
from sim_server.updates.driver import Driver

STEPS_PERIOD = 0.05  # s between batches of step records
STATE_PERIOD = 1 / 30  # s between states for viewers
STATUS_PERIOD = 1.0  # s
LOOK_PERIOD = 0.02  # s between looks at whether somebody listens to states
BATCH = 4096  # steps sent together at most
WINDOW = 1000  # steps that percentiles are taken over
ENERGY_STEPS = 20  # between elastic energies in real time: one costs up to a fifth of a step
SLACK_OF_ENERGY: float = BALANCE.constant("SLACK_OF_ENERGY")


class Telemetry:
    """Turns records and frames of one run into messages. patient: the log may be waited for (no deadline to miss)."""

    def __init__(self, driver: Driver, link: ServerLink, recorder: Recorder | None, patient: bool):
        self.driver, self.link, self.recorder, self.patient = driver, link, recorder, patient
        self.simulation, self.engine = driver.simulation, driver.engine
        self.commands: Commands | None = None
        self.trace: Trace | None = None
        self.begun = time.monotonic()
        self.every = self.simulation.scene.record.every if recorder else 0
        self._batch: deque[pb.ObjectStep] = deque(maxlen=BATCH)
        self._window: list[deque[int]] = [deque(maxlen=WINDOW) for _ in self.simulation.world.bodies]  # iterations
        self.seconds: deque[float] = deque(maxlen=WINDOW)
        self._last: NDArray[Any] = np.zeros(len(self._window), self.engine.records_dtype)
        self._bad: set[str] = set()
        self.solves = 0
        self.pace = ""  # why the run does not keep pace with the clock; empty: it does, or need not
        self.unconverged: Counter[str] = Counter()  # solves by status, of those that did not converge
        self._energy: dict[int, float] = {}  # by body, kinetic + elastic + gravity of the last step with all three [J]
        self.runaways: Counter[int] = Counter()  # steps by body
        self._listened = False
        self._due = {"steps": 0.0, "state": 0.0, "status": 0.0, "look": 0.0}
        self._watched = False
        self._touched: dict[int, pb.Interaction] = {}
        self._points: list[NamedPoints] = []

    def open(self) -> None:
        """Scene, topologies and the initial state: first in the log, first on the network."""
        message = describe.scene(self.simulation)
        message.server = self.link.name
        self.link.set_scene(message)
        if self.recorder:
            self.recorder.scene(message)
        for body in self.simulation.world.bodies:
            topology = describe.topology(self.simulation, body)
            self.link.announce(topology)
            if self.recorder:
                self.recorder.topology(topology)
        if self.recorder:
            self._record_frame(0, self.simulation.world.x, self.simulation.world.v)
        self.publish_status("running")

    def _period(self, what: str, period: float) -> bool:
        now = time.monotonic()
        if now < self._due[what]:
            return False
        self._due[what] = now + period
        return True

    def records(self, records: NDArray[Any]) -> None:
        """Step records: all of them to the log, in batches to listeners."""
        if self.trace:
            self.trace.write(self.patient)
        if len(records):
            self.seconds.extend(records["whole"][records["body"] == 0].tolist())
            self._note(records)
            messages = self._messages(records)
            self._touch(messages)
            if self.recorder:
                for message in messages:
                    self.recorder.step(message, block=self.patient)
            self._batch.extend(messages)
        if self._period("steps", STEPS_PERIOD) and self._batch:
            if self.link.wants_steps():
                self.link.publish_steps(pb.Steps(steps=self._batch))
            self._batch.clear()

    def _note(self, records: NDArray[Any]) -> None:
        """For the status: the last record of each body, and iterations of those before."""
        order = np.argsort(records["body"], kind="stable")
        present, first = np.unique(records["body"][order], return_index=True)
        iterations = records["iterations"][order].tolist()
        ends = [*first[1:].tolist(), len(order)]
        self._last[present] = records[order[np.array(ends) - 1]]
        for body, begin, end in zip(present.tolist(), first.tolist(), ends, strict=True):
            self._window[body].extend(iterations[begin:end])
        for r in records[np.isfinite(records["elastic"])]:
            self._energy[int(r["body"])] = float(r["kinetic"] + r["elastic"] + r["gravity"])

    def _messages(self, records: NDArray[Any]) -> list[pb.ObjectStep]:
        """Those that somebody wants: to make one takes longer than all else that is done with a record."""
        wanted = records if self.recorder else records[-BATCH:] if self.link.wants_steps() else records[:0]
        messages = describe.steps(self.simulation, wanted, self._method)
        bound = self.driver.age_bound() if messages else -1
        for message in messages:
            message.excess = self.driver.by_name[message.header.object].solves.excess
            message.factor_age_bound = bound
        return messages

    def _method(self, body: int, step: int) -> Method | None:
        """How the factor of a step was made."""
        return self.driver.bodies[body].factors.method(step)

    def _latest(self, body: int, bound: int) -> pb.ObjectStep | None:
        if not self._window[body]:
            return None
        message = describe.steps(self.simulation, self._last[body : body + 1], self._method)[0]
        message.excess, message.factor_age_bound = self.driver.bodies[body].solves.excess, bound
        return message

    def _touch(self, messages: list[pb.ObjectStep]) -> None:
        """Adds to each step the interactions that acted in it."""
        if self.commands is None or self.simulation.touch is None:
            return
        known = {i.id: i for i in self.commands.applied()}
        clock, dt = float(self.simulation.system.clock[0]), self.simulation.world.dt
        for id in set(self._touched) - set(known):  # over or released: it acted up to the step under way at most
            self._touched[id].duration = min(self._touched[id].duration, max(clock + dt - self._touched[id].start, 0))
        self._touched.update(known)
        of: dict[str, list[pb.Interaction]] = {}
        for i in self._touched.values():
            of.setdefault(i.object, []).append(i)
        for message in messages:
            begin = message.time - dt
            mine = of.get(message.header.object, ())
            message.interactions.extend(i for i in mine if 0 <= i.start <= begin + 0.5 * dt < i.start + i.duration)
        for id in set(self._touched) - set(known):
            del self._touched[id]

    def frames(self) -> None:
        """States: to the log at the scene's rate, the newest one to viewers."""
        frames = self.engine.frames()
        for step, x, v in frames:
            if self.every and step % self.every == 0:
                self._record_frame(step, x, v)
        if frames and self._period("state", STATE_PERIOD):
            step, x, v = frames[-1]
            for body in self.simulation.world.bodies:
                if self.link.wants_state(body.name):
                    self.link.publish_state(describe.state(body, step, step * self.simulation.world.dt, x, v))

    def wanted_frames(self) -> int:
        """Steps between frames that the loop should copy out: 0 if nobody looks."""
        if self._period("look", LOOK_PERIOD):
            self._watched = self.link.wants_state()
            self._listened = self.link.wants_steps() or bool(self.link.clients())
        return self.every or (max(1, round(STATE_PERIOD / self.simulation.world.dt)) if self._watched else 0)

    def wanted_energies(self) -> int:
        """Steps between those whose elastic energy the loop should evaluate: 0 if nobody looks. Call `wanted_frames`
        before."""
        if self.recorder and self.patient:
            return self.every
        return ENERGY_STEPS if self.recorder or self._listened else 0

    def _record_frame(self, step: int, x: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        assert self.recorder is not None
        for body in self.simulation.world.bodies:
            message = describe.state(body, step, step * self.simulation.world.dt, x, v)
            self.recorder.state(message, block=self.patient)

    def publish_status(self, state: str, force: bool = True, where: bool = False) -> None:
        """The health of the whole scene. where: also where its objects are, which a GPU has to be asked for."""
        if not self._period("status", STATUS_PERIOD) and not force:
            return
        self._due["status"] = time.monotonic() + STATUS_PERIOD
        loop, world = self.engine.loop, self.simulation.world
        p50, p99, most = self.percentiles()
        status = pb.Status(
            scene=self.simulation.scene.name, state=state, step=self.engine.step, time=self.engine.step * world.dt,
            dt=world.dt, step_p50=p50, step_p99=p99, step_max=most, late_steps=loop.late_steps,
            device=self.simulation.world.backend.name,
            pid=os.getpid(), uptime=time.monotonic() - self.begun, pace=self.pace,
        )  # fmt: skip
        dropped = loop.frames_dropped + (self.recorder.dropped if self.recorder else 0)
        status.frames_dropped, status.records_dropped = dropped, loop.records_dropped
        status.records_lost = self.recorder.lost if self.recorder else 0
        status.recording_failure = self.recorder.failure[:400] if self.recorder else ""
        bound = self.driver.age_bound()
        for updates in self.driver.bodies:
            body, window = updates.body, self._window[updates.body.index]
            status.objects.append(
                pb.ObjectStatus(
                    object=body.name,
                    nodes=body.last - body.first,
                    tets=len(body.mesh.tets),
                    last=self._latest(body.index, bound),
                    mean_iterations=float(np.mean(window)) if window else 0.0,
                    excess=updates.solves.excess,
                    factors_used=updates.factors.used,
                    factors_refused=updates.failures.refused,
                    factors_mended=updates.factors.regularized,
                    refusal=updates.failures.reason[:400],
                    in_flight=updates.job.in_flight,
                    factor_age=updates.factors.age(status.step),
                    factor_age_max=updates.solves.max_factor_age,
                    factor_age_bound=bound,
                    runaway_steps=self.runaways[body.index],
                    total_energy=self._energy.get(body.index),
                )
            )
        if where:
            describe.places(self._places(), status)
        self.link.publish_status(status)

    def _places(self) -> list[NamedPoints]:
        """Of all objects, as they are now."""
        world = self.simulation.world
        self._points = self._points or [NamedPoints(world, body) for body in world.bodies]
        x = world.backend.fetch(world.x)
        for points in self._points:
            points.now(x)
        return self._points

    def percentiles(self) -> tuple[float, float, float]:
        """p50, p99 and maximum of the step time over the last steps [s]."""
        if not self.seconds:
            return 0.0, 0.0, 0.0
        seconds = np.array(self.seconds)
        return float(np.percentile(seconds, 50)), float(np.percentile(seconds, 99)), float(seconds.max())

    def count(self, records: NDArray[Any]) -> list[str]:
        """Counts statuses; one line for the first solve that did not converge."""
        self.solves += len(records)
        failed = records[(records["status"] != pb.CONVERGED) & (records["status"] != pb.RUNAWAY)]
        if not len(failed):
            return []
        first = not self.unconverged
        self.unconverged.update(pb.SolveStatus.Name(int(s)).lower() for s in failed["status"])
        if not first:
            return []
        r, status = failed[0], next(iter(self.unconverged))
        name = self.simulation.world.bodies[int(r["body"])].name
        return [
            f"object {name!r}, step {int(r['step'])}: not converged ({status}, residual {float(r['residual']):.1e}); "
            "further ones are counted"
        ]

    def count_runaways(self, records: NDArray[Any]) -> list[str]:
        """Counts steps of bodies that have run away; one line for each of them, with what showed it."""
        away, lines = records[records["status"] == pb.RUNAWAY], []
        for r in away[np.unique(away["body"], return_index=True)[1]]:
            body = self.simulation.world.bodies[int(r["body"])]
            if body.index not in self.runaways:
                frozen = self.simulation.energies.on_runaway == "freeze"
                then = "it is frozen where the step began" if frozen else "it goes on"
                lines.append(
                    f"object {body.name!r}, step {int(r['step'])}: runaway: {cause_of(r)}; {then} "
                    f"(solver.on_runaway = {self.simulation.scene.solver.on_runaway!r}). A smaller dt, more "
                    "linearizations or the scheme backward_euler may help"
                )
        self.runaways.update(away["body"].tolist())
        return lines

    def bad_steps(self, records: NDArray[Any]) -> list[str]:
        """One line for each object whose solve met numbers that are not finite for the first time."""
        lines = []
        for r in records[records["bad_node"] >= 0]:
            name = self.simulation.world.bodies[int(r["body"])].name
            if name not in self._bad:
                self._bad.add(name)
                begin = float(r["time"]) - self.simulation.world.dt / 2
                refused = [x for x in self.simulation.refusals() if x.body == int(r["body"]) and x.time < begin]
                latest = max(refused, key=lambda x: x.time, default=None)  # before, a line search may have tried one
                why = str(latest) if latest else f"force is not finite at node {int(r['bad_node'])}"
                lines.append(
                    f"object {name!r}, step {int(r['step'])}: {why}; "
                    "it goes back to where the step before began and rests there"
                )
        return lines


def cause_of(r: np.void) -> str:
    """What showed in a record (layouts.RECORD) that a body had run away."""
    if not (np.isfinite(r["kinetic"]) and np.isfinite(r["gravity"])):
        return "its positions or velocities are no finite numbers"
    if r["kinetic"] > SLACK_OF_ENERGY * max(r["budget"], 0.0):
        return f"kinetic energy {r['kinetic']:.3g} J, where start and loads account for {r['budget']:.3g} J"
    return f"two of its nodes moved {r['stride']:.3g} m apart within a step"
