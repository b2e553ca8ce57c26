# SPDX-License-Identifier: MIT
"""Passes records and frames of the loop to the log and to subscribers."""

import os
import time
from concurrent.futures import Future
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.log_file import KEPT_EVERY
from sim_server.arrays import Float64
from sim_server.backends.ring_buffers import as_bytes
from sim_server.checkpoint.file import Checkpoint
from sim_server.mechanics.named_points import NamedPoints
from sim_server.mechanics.world import Body
from sim_server.network.link import ServerLink
from sim_server.parameters import ParameterUpdate
from sim_server.recording import messages
from sim_server.recording.object_steps import Encoded, Reactions, Readings
from sim_server.recording.obstacles import pose_messages
from sim_server.recording.recorder import Recorder
from sim_server.recording.replay_recorder import ReplayRecorder
from sim_server.recording.wire import repeated
from sim_server.service.acting_interactions import ActingInteractions
from sim_server.service.commands import Commands
from sim_server.service.contact_telemetry import ContactTelemetry
from sim_server.service.cuts import CutTelemetry
from sim_server.service.log_thinning import LogThinning
from sim_server.service.reaction_telemetry import ReactionTelemetry
from sim_server.service.run_summary import RunSummary
from sim_server.service.step_warnings import StepWarnings
from sim_server.service.unsent_steps import UnsentSteps
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.driver import Driver

if TYPE_CHECKING:
    from sim_server.service.metrics import ServerMetrics  # prometheus_client is there only where it is wanted

STEPS_PERIOD = 0.05  # s between batches of step records
STATE_PERIOD = 1 / 30  # s between states for viewers
STATUS_PERIOD = 1.0  # s
LOOK_PERIOD = 0.02  # s between checks for subscribers
MAX_BATCH = 4096  # step records sent together at most
BEHIND = 0.5  # part of the loop's room for records that is full: the log does not follow
LARGE_NODES = 2000  # of an object whose tip takes more than a millisecond to find
ENERGY_STEPS = 20  # steps between elastic energies in real time: one costs up to a fifth of a step


class Telemetry:
    """Turns records and frames of one run into messages.

    patient: wait for the log; without it, drop
    commands: whose interactions are in the status; None: there are none

    contact: the part that tells of obstacles
    metrics: is given records and statuses; None: nobody asks for it
    reactions: the part that sends forces as they come
    summary: what the status tells of steps
    warnings: what went wrong
    """

    def __init__(
        self,
        driver: Driver,
        link: ServerLink,
        recorder: Recorder | None,
        patient: bool,
        commands: Commands | None = None,
    ):
        self.driver, self.link, self.recorder, self.patient = driver, link, recorder, patient
        self.simulation, self.engine = driver.simulation, driver.engine
        self.contact = ContactTelemetry(self.simulation, link, recorder)
        self.reactions = ReactionTelemetry(self.simulation, link)
        self.cuts = CutTelemetry(self.simulation, link, recorder, patient)
        driver.on_epoch.append(self.cuts.announce)
        self.replay_recorder = ReplayRecorder(driver, link, recorder) if recorder and commands else None
        self.started = time.monotonic()
        self.record_every = self.simulation.scene.record.every if recorder else 0
        self._unsent = UnsentSteps(MAX_BATCH)
        self.thinning = LogThinning(len(self.simulation.world.bodies))
        self._told_losses: set[str] = set()
        self.summary, self.warnings = RunSummary(driver), StepWarnings(self.simulation)
        self.acting = ActingInteractions(self.simulation, commands)
        self.pace = ""  # why the run does not keep pace with the clock; empty: it does, or need not
        self._has_listeners = False
        self._due = {"steps": 0.0, "state": 0.0, "status": 0.0, "look": 0.0}
        self._has_viewers = False
        self._points: list[NamedPoints] = []
        self._positions: Future[Float64] | None = None  # for the next status with places
        self._stale_moduli: set[str] = set()  # keys of parameters that were set
        self.simulation.parameters.on_set.append(self._on_set)
        self.metrics: ServerMetrics | None = None

    def open(self, resumed: Checkpoint | None = None) -> None:
        """Sends scene, topologies and the initial state, before anything else, to log and network.

        resumed: where the run goes on; the log has it, too, so that it can be repeated
        """
        import scipy.spatial  # noqa: F401  for tips; on a busy machine the first status would wait seconds for it

        world = self.simulation.world
        self._points = [NamedPoints(world, body) for body in world.bodies]
        for points in self._points:  # of a large one it takes as long as a dozen answers
            if len(points.body.mesh.rest) >= LARGE_NODES:
                _ = points.tip_node
        message = messages.scene(self.simulation)
        message.server = self.link.name
        self.link.set_scene(messages.published(message))
        if self.recorder:
            self.recorder.scene(message)
        for body in self.simulation.world.bodies:
            topology = messages.topology(self.simulation, body)
            self.link.announce(topology)
            if self.recorder:
                self.recorder.topology(topology)
        self.contact.open()
        self.cuts.open()
        if self.recorder:
            if resumed is not None:
                start = pb.Checkpoint(step=self.engine.step, data=resumed.to_bytes())
                self.recorder.checkpoint(start, self.engine.step * self.simulation.world.dt)
            self.simulation.fetch()
            self._record_frame(self.engine.step, world.x, world.v)
        self.publish_status("running")

    def _is_due(self, what: str, period: float) -> bool:
        now = time.monotonic()
        if now < self._due[what]:
            return False
        self._due[what] = now + period
        return True

    def records(self, records: NDArray[Any], reactions: Reactions, readings: Readings | None = None) -> None:
        """Sends step records, each to the log, in batches to subscribers. reactions, readings: of these records."""
        if self.replay_recorder:
            self.replay_recorder.write(self.patient)
        if len(records):
            if self.metrics is not None:
                self.metrics.add(records)
            self.summary.seconds.extend(records["whole"][records["body"] == 0].tolist())
            self.summary.update(records, reactions, readings)
            self.reactions.publish(records, reactions)
            self.acting.note()
            if self.recorder:
                self.recorder.steps(self._logged(self.recorder, records, reactions, readings), block=self.patient)
            if self.link.wants_steps():
                self._unsent.add(records, reactions, readings)
        if self._is_due("steps", STEPS_PERIOD):
            batches, left_out = self._unsent.take()
            if batches and self.link.wants_steps():
                steps = [step.data for each in batches for step in self._encoded(*each)]
                sent = pb.Steps.FromString(repeated(pb.Steps.STEPS_FIELD_NUMBER, steps))
                sent.left_out = left_out
                self.link.publish_steps(sent)
            self.acting.forget()

    def _logged(
        self, recorder: Recorder, records: NDArray[Any], reactions: Reactions, readings: Readings | None
    ) -> list[Encoded]:  # fmt: skip
        """Makes messages for the log: of all records, or in real time of what it can follow."""
        if self.patient:
            return self._encoded(records, reactions, readings)
        behind = recorder.behind or len(records) > BEHIND * self.engine.loop.record_capacity
        chosen, left_out = self.thinning.choose(records, behind)
        recorder.thinned = self.thinning.count
        told = None if readings is None else readings[chosen]
        return self._encoded(as_bytes(records)[chosen].view(records.dtype), reactions[chosen], told, left_out)

    def _encoded(
        self, records: NDArray[Any], reactions: Reactions, readings: Readings | None,
        left_out: NDArray[np.int64] | None = None,
    ) -> list[Encoded]:  # fmt: skip
        """Makes messages for the log and for subscribers only: it is the most expensive part of telemetry."""
        excess = np.array([state.solves.excess for state in self.driver.bodies])[records["body"]]
        additions = self.acting.acting(records)
        return messages.encoded_steps(
            self.simulation, records, self.driver.method, reactions, readings, excess, self.driver.age_bound(),
            additions, left_out,
        )  # fmt: skip

    def frames(self) -> None:
        """Sends states and poses of obstacles, to the log at the scene's rate, the newest ones to viewers."""
        frames = self.engine.frames()
        if frames:
            self.cuts.take()
        for step, x, v in frames:
            if self.record_every and step % self.record_every == 0:
                self._record_frame(step, x, v, self.engine.frame_poses[step])
        if frames and self._is_due("state", STATE_PERIOD):
            step, x, v = frames[-1]
            self._publish_frame(step, x, v)
            self.contact.publish_poses(step, self.engine.frame_poses[step])

    def _publish_frame(self, step: int, x: Float64, v: Float64, shown: int | None = None) -> None:
        for body in self.simulation.world.bodies if self.link.wants_state() else ():
            if self.link.wants_state(body.name):
                self.link.publish_state(self._state(body, step, x, v, shown))

    def _state(self, body: Body, step: int, x: Float64, v: Float64, shown: int | None = None) -> pb.State:
        """shown: step whose surface it has, that of the frame if left out."""
        cut, epoch = self.cuts.number(body.name, step if shown is None else shown)
        return messages.state(body, step, step * self.simulation.world.dt, x, v, cut, epoch)

    def on_reset(self, name: str, show: bool) -> None:
        """Takes note that an object, or all, were put back to the start. show: to viewers, as no step follows soon."""
        world, step = self.simulation.world, self.engine.step
        for body in world.bodies:
            if name in ("", body.name):
                self.warnings.on_reset(body)
                self.summary.events.clear(body.index)
        self.contact.on_reset()
        if self.replay_recorder:
            self.replay_recorder.write(self.patient)  # parameters that the loop had before
        if self.recorder:
            message = pb.Reset(header=pb.Header(object=name), step=step)
            self.recorder.reset(message, step * world.dt, block=self.patient)
        if show:
            self.simulation.fetch()
            self.cuts.take()
            self._publish_frame(step, world.x, world.v, shown=step + 1)

    def frame_interval(self) -> int:
        """Returns the steps between frames that the loop should copy out; 0 for none."""
        if self._is_due("look", LOOK_PERIOD):
            self.reactions.look()
            wants_poses = self.contact.look()
            self._has_viewers = self.link.wants_state() or wants_poses
            self._has_listeners = self.link.wants_steps() or bool(self.link.clients())
        return self.record_every or (max(1, round(STATE_PERIOD / self.simulation.world.dt)) if self._has_viewers else 0)

    def energy_interval(self) -> int:
        """Returns the steps between those whose elastic energy the loop should evaluate; 0 for none.

        Call `frame_interval` first: it checks for subscribers.
        """
        if self.recorder and self.patient:
            return self.record_every
        return ENERGY_STEPS if self.recorder or self._has_listeners else 0

    def _record_frame(self, step: int, x: Float64, v: Float64, poses: Float64 | None = None) -> None:
        assert self.recorder is not None
        time, states = step * self.simulation.world.dt, []
        for body in self.simulation.world.bodies:
            if self.cuts.written(body.name, step):
                data = self._state(body, step, x, v).SerializeToString()
                states.append(Encoded(body.name, step, time, data))
            else:
                self.recorder.skip_frame()
        self.recorder.states(states, block=self.patient)
        self.contact.record_poses(step, poses, block=self.patient)

    def _on_set(self, update: ParameterUpdate) -> None:
        self._stale_moduli.update(update.values)
        if update.replaces is not None:  # some of its values may have been taken back
            self._stale_moduli.update(update.replaces.values)

    def _renew_moduli(self) -> None:
        """Tells those who ask for topologies from now on of moduli that were set."""
        stale, self._stale_moduli = self._stale_moduli, set()
        for body in self.simulation.world.bodies:
            if any(key.startswith(f"object.{body.name}.effects.") for key in stale):
                self.link.renew_topology(body.name, partial(messages.moduli, self.simulation, body))

    def publish_status(self, state: str, force: bool = True, where: bool = False) -> None:
        """Publishes the status of the scene. where: with the places of its objects, which are fetched from a GPU."""
        if not self._is_due("status", STATUS_PERIOD) and not force:
            return
        self._due["status"] = time.monotonic() + STATUS_PERIOD
        self._renew_moduli()
        self.cuts.take()
        status = self._status_of_run(state)
        bound = self.driver.age_bound()
        latest, means = self.summary.latest(bound), self.summary.mean_iterations()
        for updates in self.driver.bodies:
            body = updates.body
            found = self._status_of(updates, status.step)
            found.mean_iterations, found.factor_age_bound = float(means[body.index]), bound
            if body.index in latest:
                found.last.CopyFrom(latest[body.index])
            status.objects.append(found)
        status.obstacles.extend(pose_messages(self.simulation, status.step, fixed=True))
        if where:
            messages.add_places(self._places(), status)
        self._positions = None  # those that come later would be old in the next status
        self.link.publish_status(status)
        if self.metrics is not None:
            self.metrics.status = status

    def _status_of_run(self, state: str) -> pb.Status:
        """Returns a status without objects."""
        loop, world = self.engine.loop, self.simulation.world
        p50, p99, most = self.summary.percentiles()
        status = pb.Status(
            scene=self.simulation.scene.name, state=state, step=self.engine.step, time=self.engine.step * world.dt,
            dt=world.dt, step_p50=p50, step_p99=p99, step_max=most, late_steps=loop.late_steps,
            device=world.backend.name, pid=os.getpid(), uptime=time.monotonic() - self.started, pace=self.pace,
        )  # fmt: skip
        status.frames_dropped, status.records_dropped = loop.frames_dropped, loop.records_dropped + loop.others_dropped
        status.records_thinned = self.thinning.count
        if self.recorder:
            status.frames_dropped += self.recorder.dropped
            status.records_lost = self.recorder.lost
            status.recording_failure = self.recorder.failure[:400]
        return status

    def _status_of(self, updates: BodyUpdateState, step: int) -> pb.ObjectStatus:
        """Returns what the status tells of an object, but for what `summary` knows of all together."""
        body, factors, failures = updates.body, updates.factors, updates.failures
        return pb.ObjectStatus(
            object=body.name,
            nodes=body.last - body.first,
            tets=len(body.mesh.tets) - self.cuts.removed.get(body.name, 0),
            excess=updates.solves.excess,
            factors_used=factors.used,
            factors_refused=failures.refused,
            factors_mended=factors.regularized,
            refusal=failures.reason[:400],
            in_flight=updates.job.in_flight,
            factor_age=factors.age(step),
            factor_age_max=updates.solves.max_factor_age,
            runaway_steps=self.warnings.runaways[body.index],
            total_energy=self.summary.total_energy(body.index),
            clipped=self.contact.clipped[body.index],
            crowded=self.contact.crowded[body.index],
            events=self.summary.events.of(body.index),
        )

    def fetch_places(self) -> bool:
        """Begins to fetch the positions of all nodes for the next status; True once they are there."""
        if self._positions is None:
            self._positions = self.simulation.world.backend.begin_fetch(self.simulation.world.x)
            self._positions.add_done_callback(lambda _: self.driver.wake())
        return self._positions.done()

    def _places(self) -> list[NamedPoints]:
        """Returns the named points of all objects at the positions that were fetched, else the present ones."""
        self.fetch_places()
        assert self._positions is not None
        x = self._positions.result()
        for points in self._points:
            points.now(x)
        return self._points

    def losses(self) -> list[str]:
        """Returns a line when records are missing for the first time, of each kind."""
        found, losses = [], (
            (self.thinning.count, "the log cannot follow: of steps in which nothing changes it has, until it can, the "
             f"records of every {KEPT_EVERY}th alone; a replay repeats all of them"),
            (self.engine.loop.records_dropped, "records of whole steps were not read in time and are lost" + (
                ", for the log, too: a replay ends before them" if self.recorder else "")),
        )  # fmt: skip
        for count, line in losses:
            if count and line not in self._told_losses:
                self._told_losses.add(line)
                found.append(f"step {self.engine.step}: {line}; further ones are counted")
        return found
