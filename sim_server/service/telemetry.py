# SPDX-License-Identifier: MIT
"""Passes records and frames of the loop to the log and to subscribers."""

import os
import time
from collections import Counter, deque
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.log_file import KEPT_EVERY
from protocol.method import Method
from sim_server.arrays import Float64
from sim_server.backends.kinds import SLACK_OF_ENERGY
from sim_server.backends.ring_buffers import as_bytes
from sim_server.checkpoint.file import Checkpoint
from sim_server.mechanics.named_points import NamedPoints
from sim_server.mechanics.world import Body, World
from sim_server.network.link import ServerLink
from sim_server.parameters import ParameterUpdate
from sim_server.recording import messages
from sim_server.recording.object_steps import Additions, Encoded, Reactions, Readings
from sim_server.recording.obstacles import pose_messages
from sim_server.recording.recorder import Recorder
from sim_server.recording.replay_recorder import ReplayRecorder
from sim_server.recording.wire import repeated
from sim_server.service.commands import Commands
from sim_server.service.contact_telemetry import ContactTelemetry
from sim_server.service.cuts import CutTelemetry
from sim_server.service.event_counts import EventCounts
from sim_server.service.log_thinning import LogThinning
from sim_server.service.reaction_telemetry import ReactionTelemetry
from sim_server.service.unsent_steps import UnsentSteps
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver

if TYPE_CHECKING:
    from sim_server.service.metrics import ServerMetrics  # prometheus_client is there only where it is wanted

STEPS_PERIOD = 0.05  # s between batches of step records
STATE_PERIOD = 1 / 30  # s between states for viewers
STATUS_PERIOD = 1.0  # s
LOOK_PERIOD = 0.02  # s between checks for subscribers
MAX_BATCH = 4096  # step records sent together at most
BEHIND = 0.5  # part of the loop's room for records that is full: the log does not follow
STATISTICS_STEPS = 1000  # last steps that percentiles and means are taken over
MANY_SUBSTEPS = 10_000  # explicit ones of a step, of which it is told
ENERGY_STEPS = 20  # steps between elastic energies in real time: one costs up to a fifth of a step


class Telemetry:
    """Turns records and frames of one run into messages.

    patient: wait for the log; without it, drop
    commands: whose interactions are in the status; None: there are none

    contact: the part that tells of obstacles
    metrics: is given records and statuses; None: nobody asks for it
    reactions: the part that sends forces as they come
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
        self.commands = commands
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
        bodies = len(self.simulation.world.bodies)
        self._window = np.zeros((bodies, STATISTICS_STEPS), np.int32)  # iterations of the last steps
        self._told = np.zeros(bodies, np.int64)  # steps of each body
        self.seconds: deque[float] = deque(maxlen=STATISTICS_STEPS)
        self._last: NDArray[Any] = np.zeros(bodies, self.engine.records_dtype)
        self._last_reactions: dict[int, tuple[Reactions, int]] = {}  # by body, and the number of its record in them
        self._last_readings: dict[int, Readings] = {}  # by body, one record
        self._not_finite: set[str] = set()  # objects of which it was said
        self.solves = 0
        self.pace = ""  # why the run does not keep pace with the clock; empty: it does, or need not
        self.unconverged: Counter[str] = Counter()  # solves by status, of those that did not converge
        self._energy = np.full(bodies, np.nan)  # by body, of the last step with all of kinetic, elastic and gravity [J]
        self.runaways: Counter[int] = Counter()  # steps by body
        self.events = EventCounts()
        self._halved: set[int] = set()  # bodies of which it was said
        self._told_substeps = False
        self._gained: set[int] = set()  # bodies of which it was said that they have gained energy
        self._has_listeners = False
        self._due = {"steps": 0.0, "state": 0.0, "status": 0.0, "look": 0.0}
        self._has_viewers = False
        self._interactions: dict[int, pb.Interaction] = {}
        self._over: set[int] = set()  # ids of those of them that act no more
        self._points: list[NamedPoints] = []
        self._stale_moduli: set[str] = set()  # keys of parameters that were set
        self.simulation.parameters.on_set.append(self._on_set)
        self.metrics: ServerMetrics | None = None

    def open(self, resumed: Checkpoint | None = None) -> None:
        """Sends scene, topologies and the initial state, before anything else, to log and network.

        resumed: where the run goes on; the log has it, too, so that it can be repeated
        """
        import scipy.spatial  # noqa: F401  for tips; on a busy machine the first status would wait seconds for it

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
            world = self.simulation.fetch()
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
            self.seconds.extend(records["whole"][records["body"] == 0].tolist())
            self.update_summary(records, reactions, readings)
            self.reactions.publish(records, reactions)
            self._note_interactions()
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
            self._forget_interactions()

    def update_summary(
        self, records: NDArray[Any], reactions: Reactions | None = None, readings: Readings | None = None
    ) -> None:
        """Keeps what the status tells of steps: records, reactions and readings, iterations and energies."""
        order = np.argsort(records["body"], kind="stable")
        present, first, counts = np.unique(records["body"][order], return_index=True, return_counts=True)
        at = self._told[present].repeat(counts) + np.arange(len(order)) - first.repeat(counts)
        self._window[present.repeat(counts), at % STATISTICS_STEPS] = records["iterations"][order]
        self._told[present] += counts
        newest = order[first + counts - 1]
        as_bytes(self._last)[present] = as_bytes(records)[newest]
        self.events.add(records)
        if reactions is not None and reactions.any:
            for body, record in zip(present.tolist(), newest.tolist(), strict=True):
                self._last_reactions[body] = reactions, record
        if readings is not None and readings.measured:
            for body, record in zip(present.tolist(), newest.tolist(), strict=True):
                self._last_readings[body] = readings[record : record + 1]
        with np.errstate(all="ignore"):  # a body that blew up
            energy = records["kinetic"] + records["elastic"] + records["gravity"]
        evaluated = np.flatnonzero(np.isfinite(records["elastic"]))
        self._energy[records["body"][evaluated]] = energy[evaluated]

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
        additions = self._acting(records)
        return messages.encoded_steps(
            self.simulation, records, self._method, reactions, readings, excess, self.driver.age_bound(), additions,
            left_out,
        )  # fmt: skip

    def _method(self, body: int, step: int) -> Method | None:
        """Returns how the factor of a step was made."""
        return self.driver.bodies[body].factors.method(step)

    def _latest(self, bound: int) -> dict[int, pb.ObjectStep]:
        """Returns the last steps by body. bound: age that factors are to have at most"""
        bodies, additions = np.flatnonzero(self._told), Additions()
        records = self._last[bodies]
        for number, body in enumerate(bodies.tolist()):
            own, record = Additions(), records[number : number + 1]
            if body in self._last_reactions:
                reactions, at = self._last_reactions[body]
                reactions[at : at + 1].add_to(own, record)
            if body in self._last_readings:
                self._last_readings[body].add_to(own, [self.simulation.world.bodies[body].name])
            if own:
                additions[number] = own[0]
        excess = np.array([self.driver.bodies[body].solves.excess for body in bodies.tolist()])
        steps = messages.encoded_steps(
            self.simulation, records, self._method, excess=excess, age_bound=bound, additions=additions
        )
        return {body: pb.ObjectStep.FromString(s.data) for body, s in zip(bodies.tolist(), steps, strict=True)}

    def _note_interactions(self) -> None:
        """Takes note of the interactions that act in steps, of which messages tell."""
        if self.commands is None or self.simulation.touch is None:
            return
        known = {i.id: i for i in self.commands.interactions()}
        clock, dt = float(self.simulation.system.clock[0]), self.simulation.world.dt
        for id in set(self._interactions) - set(known) - self._over:  # it acted up to the step under way at most
            interaction = self._interactions[id]
            interaction.duration = min(interaction.duration, max(clock + dt - interaction.start, 0))
            self._over.add(id)
        self._interactions.update(known)

    def _forget_interactions(self) -> None:
        """Forgets those that are over: the messages of steps in which they acted are made."""
        for id in self._over:
            del self._interactions[id]
        self._over.clear()

    def _acting(self, records: NDArray[Any]) -> Additions:
        """Returns the interactions that acted in the steps of records."""
        additions, dt = Additions(), self.simulation.world.dt
        bodies = {body.name: body.index for body in self.simulation.world.bodies} if self._interactions else {}
        begin = records["time"] - dt
        for i in self._interactions.values():
            acted = (i.start <= begin + 0.5 * dt) & (begin + 0.5 * dt < i.start + i.duration)
            if i.start >= 0:
                for number in np.flatnonzero(acted & (records["body"] == bodies.get(i.object, -1))).tolist():
                    additions[number].interactions.append(i)
        return additions

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
                self.runaways.pop(body.index, None)
                self.events.clear(body.index)
                self._halved.discard(body.index)
                self._gained.discard(body.index)
                self._not_finite.discard(body.name)
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
        loop, world = self.engine.loop, self.simulation.world
        p50, p99, most = self.percentiles()
        status = pb.Status(
            scene=self.simulation.scene.name, state=state, step=self.engine.step, time=self.engine.step * world.dt,
            dt=world.dt, step_p50=p50, step_p99=p99, step_max=most, late_steps=loop.late_steps,
            device=self.simulation.world.backend.name,
            pid=os.getpid(), uptime=time.monotonic() - self.started, pace=self.pace,
        )  # fmt: skip
        dropped = loop.frames_dropped + (self.recorder.dropped if self.recorder else 0)
        status.frames_dropped, status.records_dropped = dropped, loop.records_dropped + loop.others_dropped
        status.records_lost = self.recorder.lost if self.recorder else 0
        status.records_thinned = self.thinning.count
        status.recording_failure = self.recorder.failure[:400] if self.recorder else ""
        bound = self.driver.age_bound()
        latest = self._latest(bound)
        means = self._window.sum(axis=1) / np.clip(self._told, 1, STATISTICS_STEPS)
        for updates in self.driver.bodies:
            body = updates.body
            status.objects.append(
                pb.ObjectStatus(
                    object=body.name,
                    nodes=body.last - body.first,
                    tets=len(body.mesh.tets) - self.cuts.removed.get(body.name, 0),
                    last=latest.get(body.index),
                    mean_iterations=float(means[body.index]),
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
                    total_energy=None if np.isnan(energy := self._energy[body.index]) else float(energy),
                    clipped=self.contact.clipped[body.index],
                    crowded=self.contact.crowded[body.index],
                    events=self.events.of(body.index),
                )
            )
        status.obstacles.extend(pose_messages(self.simulation, status.step, fixed=True))
        if where:
            messages.add_places(self._places(), status)
        self.link.publish_status(status)
        if self.metrics is not None:
            self.metrics.status = status

    def _places(self) -> list[NamedPoints]:
        """Returns the named points of all objects at their present positions."""
        world = self.simulation.world
        self._points = self._points or [NamedPoints(world, body) for body in world.bodies]
        x = world.backend.fetch(world.x)
        for points in self._points:
            points.now(x)
        return self._points

    def percentiles(self) -> tuple[float, float, float]:
        """Returns p50, p99 and maximum of the time [s] of the last steps."""
        if not self.seconds:
            return 0.0, 0.0, 0.0
        seconds = np.array(self.seconds)
        return float(np.percentile(seconds, 50)), float(np.percentile(seconds, 99)), float(seconds.max())

    def count_unconverged(self, records: NDArray[Any]) -> list[str]:
        """Counts solves that did not converge, by status; returns a line for the first."""
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
        column = "contact_residual" if r["status"] == pb.CONTACT else "residual"
        return [
            f"object {name!r}, step {int(r['step'])}: not converged ({status}, residual {float(r[column]):.1e}); "
            "further ones are counted"
        ]

    def not_finite(self, records: NDArray[Any]) -> list[str]:
        """Returns a line for each object whose solve met numbers that are not finite for the first time."""
        return not_finite_lines(self.simulation, records, self._not_finite)

    def count_runaways(self, records: NDArray[Any]) -> list[str]:
        """Counts steps of bodies that have run away; returns a line for each new one, with the cause."""
        away, lines = records[records["status"] == pb.RUNAWAY], []
        for r in away[np.unique(away["body"], return_index=True)[1]]:
            body = self.simulation.world.bodies[int(r["body"])]
            if body.index not in self.runaways:
                frozen = self.simulation.energies.freezes
                then = "it is frozen where the step began" if frozen else "it goes on"
                lines.append(
                    f"object {body.name!r}, step {int(r['step'])}: runaway: {cause_of(r)}; {then} "
                    f"(solver.on_runaway = {self.simulation.scene.solver.on_runaway!r}). A smaller dt, more "
                    "linearizations or the scheme backward_euler may help"
                )
        self.runaways.update(away["body"].tolist())
        return lines

    def gained_energy(self, records: NDArray[Any]) -> list[str]:
        """Returns a line for each object that has far more energy than it was given, kinetic and elastic together, for
        the first time. Steps whose elastic energy is known; what moves little is not found by its kinetic energy."""
        lines, world = [], self.simulation.world
        if world.explicit or (world.loading and world.backend.name == "gpu"):
            return []
        energy = records["kinetic"] + records["elastic"]
        for r in records[energy > SLACK_OF_ENERGY * np.maximum(records["budget"], 0.0)]:
            body = world.bodies[int(r["body"])]
            floor = least_energy(world, body)
            if world.loading and world.load[body.nodes].any():  # the work of loads is known to a part alone
                continue
            if body.index in self._gained or not r["kinetic"] + r["elastic"] > 2 * r["budget"] + floor:
                continue
            self._gained.add(body.index)
            lines.append(
                f"object {body.name!r}, step {int(r['step'])}: it has {r['kinetic'] + r['elastic']:.3g} J, kinetic and "
                f"elastic, where start and loads account for {r['budget']:.3g} J: an error of the time step. A smaller "
                "dt or more linearizations may help"
            )
        return lines

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

    def many_substeps(self) -> list[str]:
        """Returns a line, once, if a step makes very many explicit substeps: while the first one is under way."""
        count, dt = self.engine.substeps, self.simulation.world.dt
        if self._told_substeps or count <= MANY_SUBSTEPS:
            return []
        self._told_substeps = True
        return [
            f"a step of dt = {dt:g} s takes {count:,} explicit substeps of {dt / count:.2g} s, each of which evaluates "
            "all forces: the stiffest or smallest element allows none longer. What helps: softer material, no slivers, "
            'or integrator.scheme = "backward_euler" or "ros2", which have no such limit'
        ]

    def halved(self, records: NDArray[Any]) -> list[str]:
        """Returns a line for each object whose step was made again by short ones for the first time."""
        lines = []
        for r in records[records["halvings"] > 0]:
            body = self.simulation.world.bodies[int(r["body"])]
            if body.index not in self._halved:
                self._halved.add(body.index)
                lines.append(
                    f"object {body.name!r}, step {int(r['step'])}: ran away; made again by {2 ** int(r['halvings'])} "
                    "short steps, as the next ones are; further ones are counted"
                )
        return lines


def not_finite_lines(simulation: Simulation, records: NDArray[Any], known: set[str]) -> list[str]:
    """Returns a line for each object whose solve met numbers that are not finite for the first time.

    known: objects of which that was said before; the names of new ones are added
    """
    lines = []
    for r in records[records["bad_node"] >= 0]:
        name = simulation.world.bodies[int(r["body"])].name
        if name not in known:
            known.add(name)
            begin = float(r["time"]) - simulation.world.dt / 2
            refused = [x for x in simulation.refusals() if x.body == int(r["body"]) and x.time < begin]
            latest = max(refused, key=lambda x: x.time, default=None)  # before, a line search may have tried one
            why = str(latest) if latest else f"force is not finite at node {int(r['bad_node'])}"
            lines.append(
                f"object {name!r}, step {int(r['step'])}: {why}; "
                "it goes back to where the step before began and rests there"
            )
    return lines


def least_energy(world: World, body: Body) -> float:
    """Energy of a body all of whose nodes move by a thousandth of its size in a step, below which a balance may be
    rounding [J]; the floor of kernels/energy_balance.cuh."""
    size = float(np.linalg.norm(np.ptp(world.rest[body.nodes], axis=0)))
    return 0.5 * float(world.mass[body.nodes].sum()) * (1e-3 * size / world.dt) ** 2


def cause_of(r: np.void) -> str:
    """Says what a record (structs.RECORD) shows of a body that ran away."""
    if not (np.isfinite(r["kinetic"]) and np.isfinite(r["gravity"])):
        return "its positions or velocities are no finite numbers"
    if r["kinetic"] > SLACK_OF_ENERGY * max(r["budget"], 0.0):
        return f"kinetic energy {r['kinetic']:.3g} J, where start and loads account for {r['budget']:.3g} J"
    return f"two of its nodes moved {r['stride']:.3g} m apart within a step"
