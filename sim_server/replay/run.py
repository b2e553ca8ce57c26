# SPDX-License-Identifier: MIT
"""Repeats a recorded run and compares it with its log, bit by bit.

Every step gets the input that the log has of it: the interactions as the loop had taken them up, for each solve the
preconditioner asked for, and the factor that it used, made here from the same step's matrix.
What is left (kernels, solver, factorization) is a pure function of these on one build.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.factor import Factor
from protocol.log_chunks import BadLog
from protocol.refused import Refused
from protocol.validate import array, check_range, checksum
from sim_server.arrays import Float64
from sim_server.checkpoint.content import SavedFactors, restore, saved_factors
from sim_server.checkpoint.file import from_bytes
from sim_server.errors import InputError
from sim_server.mechanics.world import Body
from sim_server.recording import messages
from sim_server.recording.obstacles import targets_of
from sim_server.replay.library import inline_source
from sim_server.replay.log import Recording
from sim_server.replay.rebuilding import check_meshes, check_obstacles, other_code, simulation_of
from sim_server.replay.report import Comparison
from sim_server.state.start import Start
from sim_server.updates.factor_source import Job
from sim_server.updates.worker_assembly import Assembly

if TYPE_CHECKING:
    from sim_server.effects.touch import Interaction


class Replay:
    """Repeats one recording. Raises BadLog if its scene cannot be built as it was."""

    def __init__(self, recording: Recording):
        self.recording = recording
        self.simulation = simulation_of(recording)
        self.engine, self.bodies = self.simulation.engine, self.simulation.world.bodies
        self.compared = Comparison(recording)
        check_obstacles(self.simulation, recording)
        self._list_inputs()
        self.engine.prepare()  # as a server, with the parameters of the scene
        self._start = Start(self.simulation) if self._resets else None
        self._saved = SavedFactors([], [])
        if recording.checkpoint:
            self._resume(recording)
        check_meshes(self.simulation, recording)
        self._nodes: dict[int, tuple[NDArray[np.int32], Float64]] = {}  # nodes and offsets of interactions, by id
        self._positions: dict[str, Float64] = {}  # sent instead of a matrix, and not those of its step, by body
        self._later: dict[str, Float64] = {}  # those at the end of the last step
        self._assemblies: dict[str, Assembly] = {}
        self._begin_factors()
        self.compared.notes += other_code(self.simulation, recording)

    def _list_inputs(self) -> None:
        """Lists what the log holds by the step in which it takes effect."""
        recording = self.recording
        self._taken = {b.name: taken_up(self._rows(b.name), recording.first) for b in self.bodies}
        self._last_use = self._last_uses()
        self._needed = set(self._last_use)  # (object, step) of matrices whose factor the loop used
        self._touch_sets: dict[int, pb.TouchSet] = {t.step: t for t in recording.touch}
        self._targets: dict[int, list[pb.ObstacleTargets]] = {}
        for t in recording.targets:
            self._targets.setdefault(t.step, []).append(t)
        self._resets: dict[int, list[tuple[str, int]]] = {}  # by step: objects, parameter sets before
        for r, sets in recording.resets:
            self._resets.setdefault(r.step, []).append((r.header.object, sets))

    def _begin_factors(self) -> None:
        """Has the library of the log make factors, beginning with those that were under way in a checkpoint."""
        self._inline, note = inline_source(self.simulation, self.recording)
        self.compared.notes += [note] if note else []
        self._factors: dict[tuple[str, int], Factor] = {(f.object, f.step): f for f in self._saved.factors}
        self._in_use: dict[str, int] = {}
        for job in self._saved.jobs:
            if (job.object, job.step) in self._needed:
                self._inline.submit(job)
        self._collect(self.recording.first)

    def _resume(self, recording: Recording) -> None:
        """Goes to where the recorded run began: the checkpoint of the log."""
        try:
            checkpoint = from_bytes(recording.checkpoint)
            manifest = restore(self.simulation, checkpoint)
            self._saved = saved_factors(self.simulation, checkpoint, manifest)
        except InputError as error:
            raise BadLog(f"{recording.path}: the checkpoint in the log: {error}") from error
        self.compared.notes.append(f"it went on from a checkpoint of step {manifest.step}, which the log holds")

    def run(self, progress: Callable[[int], None] = lambda _: None) -> Comparison:
        """Repeats all steps and compares them; calls `progress` with the number of steps done."""
        self._compare_frames(self.recording.first)
        for step in range(self.recording.first, self.recording.steps):
            self._fetch_later(step)
            sets = self._reset(step)
            self._restore_interactions(step)
            self._restore_targets(step)
            self._restore_parameters(step, slice(sets, None))
            for body in self.bodies:
                self._apply_settings(body.index, body.name, step)
                self._use_factor(body.index, body.name, step, fresh=False)
            self._request_positions(step)
            self.engine.assemble()
            self._make_factors(step)
            for body in self.bodies:
                self._use_factor(body.index, body.name, step, fresh=True)
            self.engine.solve()
            records, on_obstacles = self.engine.records_and_reactions()
            there = [b.index for b in self.bodies if not self._left_out(b.name, step)]
            rows = [self._row(b.name, step) if b.index in there else None for b in self.bodies]
            self.compared.solves(records, rows)
            if self.compared.kinds:
                exerted = messages.reactions(self.simulation, on_obstacles, self.engine.other_reactions())
                told = messages.readings(self.simulation, self.engine.readings)
                steps = messages.steps(self.simulation, records, reactions=exerted, readings=told)
                self.compared.reactions([steps[k] for k in there])
            self._compare_frames(step + 1)
            progress(step + 1)
        return self.compared

    def _rows(self, name: str) -> NDArray[np.void]:
        return self.recording.objects[name].rows[: self.recording.steps - self.recording.first]

    def _row(self, name: str, step: int) -> np.void:
        row: np.void = self._rows(name)[step - self.recording.first]
        return row

    def _left_out(self, name: str, step: int) -> bool:
        return bool(self.recording.objects[name].filled[step - self.recording.first])

    def _last_uses(self) -> dict[tuple[str, int], int]:
        uses: dict[tuple[str, int], int] = {}
        for body in self.bodies:
            for step, both in enumerate(self._taken[body.name].tolist(), self.recording.first):
                uses |= {(body.name, made): step for made in both if made >= 0}
        return uses

    # --- input of a step ----------------------------------------------------------------------------------------

    def _reset(self, step: int) -> int:
        """Puts back what was put back before this step; returns how many sets of parameters came before that."""
        done = 0
        for name, sets in self._resets.get(step, ()):
            self._restore_parameters(step, slice(done, sets))
            done = sets
            try:
                assert self._start is not None
                self._start.reset(name)
            except KeyError as error:
                raise BadLog(f"{self.recording.path}: reset at step {step}: {error}") from error
        return done

    def _restore_interactions(self, step: int) -> None:
        """Sets the interactions that the loop took up at this step."""
        if step not in self._touch_sets:
            return
        touch = self.simulation.touch
        if touch is None:
            raise BadLog(f"{self.recording.path}: pushes or grabs in a scene that takes none")
        try:
            touch.restore([self._interaction(m) for m in self._touch_sets[step].interactions])
        except Refused as error:
            raise BadLog(f"{self.recording.path}: interactions of step {step}: {error}") from error

    def _restore_targets(self, step: int) -> None:
        """Has obstacles and holders go where the loop had them go from this step on."""
        for targets in map(targets_of, self._targets.get(step, ())):
            mover = self.simulation.movable(next(iter(targets), ""))
            if mover is None:
                raise BadLog(f"{self.recording.path}: moved obstacles in a scene that has none")
            try:
                mover.restore(targets)
            except ValueError as error:
                raise BadLog(f"{self.recording.path}: obstacles moved at step {step}: {error}") from error

    def _restore_parameters(self, step: int, which: slice) -> None:
        """Sets the parameters that the loop took up at this step. which: of several sets"""
        for found in self.recording.parameters.get(step, [])[which]:
            try:
                self.simulation.parameters.set({p.key: p.value for p in found.parameters})
            except ValueError as error:
                raise BadLog(f"{self.recording.path}: parameters set at step {step}: {error}") from error

    def _interaction(self, m: pb.Interaction) -> Interaction:
        from sim_server.effects.touch import Interaction

        if m.held:
            nodes = array(m.held, np.int32, (m.nodes,), "Interaction.held")
            check_range(nodes, 0, self.simulation.world.nodes, "Interaction.held")
            offsets = array(m.offsets, np.float64, (m.nodes, 3), "Interaction.offsets", finite=True)
            self._nodes[m.id] = (nodes.astype(np.int32), offsets.astype(np.float64))
        if m.id not in self._nodes:
            raise Refused(f"the nodes of interaction {m.id} are not in the log")
        nodes, offsets = self._nodes[m.id]
        point, force, target = ((v.x, v.y, v.z) for v in (m.point, m.force, m.target))
        return Interaction(
            m.id, m.client, m.object, point, m.radius, nodes, offsets, m.duration, force, target, m.stiffness,
            m.max_force, m.start,
        )  # fmt: skip

    def _request_positions(self, step: int) -> None:
        """Requests extrapolated positions for the factors of this step that were made from such."""
        self._positions.clear()
        for body in self.bodies:
            use = self.recording.objects[body.name].factors.get(step)
            if use is not None and use.ahead > 0 and (body.name, step) in self._needed:
                self._positions[body.name] = np.empty((body.last - body.first, 3))
                self.engine.request_positions(body.index, self._positions[body.name], use.ahead)

    def _fetch_later(self, step: int) -> None:
        """Keeps the positions at the end of the last step that were sent for factors of it, before a reset."""
        for body in self.bodies:
            use = self.recording.objects[body.name].factors.get(step - 1)
            if use is not None and use.later and (body.name, step - 1) in self._needed:
                self._later[body.name] = self.simulation.fetch().x[body.nodes].copy()

    def _make_factors(self, step: int) -> None:
        """Makes the factors of this step, and those of the last one whose positions were sent at its end."""
        for body in self.bodies:
            for made in (step - 1, step):
                use = self.recording.objects[body.name].factors.get(made)
                later = use is not None and use.later
                if (body.name, made) in self._needed and later == (made < step):
                    if later:
                        self._positions[body.name] = self._later[body.name]
                    self._submit(body, made)
        self._collect(step)

    def _submit(self, body: Body, made: int) -> None:
        warped = body.index in self.simulation.warped
        values, solver = self.engine.factor_matrix(body.index), self.simulation.scene.solver
        if body.name in self._positions:
            if body.name not in self._assemblies:
                topology = messages.topology(self.simulation, body)
                self._assemblies[body.name] = Assembly(messages.scene(self.simulation), topology)
            values = self._assemblies[body.name].matrix(self._positions[body.name])
        use = self.recording.objects[body.name].factors.get(made)
        method = solver.method_named(use.method if use is not None else "")
        epoch = self.simulation.epoch(body.name, made)
        self._inline.submit(Job(body.name, epoch, made, warped, values, solver.factor_dtype, method))

    def _collect(self, step: int) -> None:
        for factor in self._inline.poll():
            self._factors[factor.object, factor.step] = factor
            self._check_factor(factor)
        for name, reason in self._inline.failures():
            self.compared.diverged(step, name, "factor", f"the matrix cannot be factorized: {reason}")

    def _check_factor(self, factor: Factor) -> None:
        then = self.recording.objects[factor.object].factors.get(factor.step)
        if then is None or (then.pattern, then.checksum) == (factor.pattern.id, checksum(factor.values)):
            return
        maker = f"{then.library or 'an unknown library'}, {then.threads} thread{'s' if then.threads != 1 else ''}"
        here = self._inline.library(factor.object, self.simulation.scene.solver.method_named(then.method))
        what = "values" if then.pattern == factor.pattern.id else "pattern"
        now = f"here by {here}" if here != then.library else "here by the same library"
        self.compared.factor(factor.step, factor.object, f"other {what}; made by {then.worker} ({maker}), {now}")

    def _apply_settings(self, index: int, name: str, step: int) -> None:
        """Sets the solver settings of one solve as they were."""
        row, settings, solver = self._row(name, step), self.engine.settings(index), self.simulation.scene.solver
        settings.kind, settings.probe = int(row["asked"]), int(row["probe"])
        cut = row["status"] == pb.BUDGET and bool(solver.budget or solver.step_budget)
        settings.budget = -float(row["iterations"] + 1) if cut else 0.0
        settings.step_budget, settings.most_linearizations = 0.0, int(row["linearizations"]) if cut else 0

    def _use_factor(self, index: int, name: str, step: int, fresh: bool) -> None:
        """Posts the factor that a step used. fresh: the one made from the matrix of this step; else one made before."""
        made = int(self._taken[name][step - self.recording.first, int(fresh)])
        if made < 0:
            return
        if self._in_use.get(name) != made:
            factor = self._factors.get((name, made))
            if factor is None:
                self.compared.diverged(step + 1, name, "factor", f"used that of step {made}, which there is not yet")
                return
            in_use_when_saved = step == self.recording.first and any(f is factor for f in self._saved.factors)
            post = self.engine.resume_factor if in_use_when_saved else self.engine.post_factor
            post(index, factor.pattern, factor.values, made)
            self._in_use[name] = made
        if self._last_use[name, made] == step:
            self._factors.pop((name, made), None)

    def _compare_frames(self, step: int) -> None:
        if not any(step in o.frames for o in self.recording.objects.values()):
            return
        world = self.simulation.fetch()
        for body in self.bodies:
            try:
                frame = self.recording.frame(body.name, step)
            except Refused as error:
                raise BadLog(f"{self.recording.path}: step {step} of {body.name!r}: {error}") from error
            if frame is not None and len(frame[0]) == body.last - body.first:
                self.compared.frame(step, body.name, frame, (world.x[body.nodes], world.v[body.nodes]))


def taken_up(rows: NDArray[np.void], first: int = 0) -> NDArray[np.int64]:
    """Finds of which steps the factors were that a body's solves used, (steps, 2): taken up before the step assembled,
    and made from the very step; -1: none. rows: of a log (log.ROW), one a step. first: steps before them."""
    used, fresh = rows["factor_step"], rows["factor_step"] == first + np.arange(len(rows))
    return np.stack([np.where(fresh, -1, used), np.where(fresh, used, -1)], axis=1)
