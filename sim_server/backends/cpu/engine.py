# SPDX-License-Identifier: MIT
"""The native simulation loop as seen from Python: its memory, its mailboxes and what it reports.

`Engine.run` lets go of Python's lock for as long as it runs. Everything else here only puts things into mailboxes or
reads what the loop has left in its rings, and may be called from another thread meanwhile. Layouts: structs.py.
"""

import ctypes as c
import time
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from sim_server.arrays import Float64, Int32, Int64
from sim_server.backends.base import ArrayChange, Capability, Due, EngineInput, Launch
from sim_server.backends.cpu import structs
from sim_server.backends.cpu.contact import NativeContact
from sim_server.backends.cpu.corrections import NativeCorrection, NativeCut, NativeRefresh
from sim_server.backends.cpu.device import CpuLaunch
from sim_server.backends.cpu.energies import NativeEnergies
from sim_server.backends.cpu.factors import FactorMailbox, NativeFactor
from sim_server.backends.cpu.halving import NativeHalving
from sim_server.backends.cpu.library import loop_library
from sim_server.backends.cpu.newton import NativeNewton
from sim_server.backends.cpu.processors import usable_threads
from sim_server.backends.cpu.schemes import NativeEuler, NativeStages, NativeSubsteps, tell_bodies_apart
from sim_server.backends.factors_together import FactorsTogether
from sim_server.backends.rank_one import RankOne
from sim_server.backends.ring_buffers import Reports
from sim_server.backends.state import StateArray, host_array

Reals = NDArray[np.float64]
REFRESHED_NODES = 500  # of a body from which on its factors may be refreshed


class _NativeRankOne:
    """Parts of A of rank one, attached to a loop."""

    def __init__(self, given: RankOne, rotation: Reals, loop: structs.Loop):
        self._arrays = {**vars(given), "rotation": rotation}
        self.native = structs.RankOne(**{name: array.ctypes.data for name, array in self._arrays.items()})
        loop.rank_one = c.addressof(self.native)


def _binding(launch: CpuLaunch) -> structs.Binding:
    """Arguments of a launch that the loop has not taken up yet."""
    return structs.Binding(params=c.addressof(launch.params), items=launch.items, taken=-1)


class CpuEngine(Reports):
    """The loop over one system. records, frames: numbers of them that its rings hold."""

    capabilities = frozenset(Capability)

    def __init__(self, given: EngineInput, records: int | None = None, frames: int = 8):
        self._native = loop_library()
        arrays, nodes, bodies = given.arrays, len(given.arrays["x"]), len(given.ranges)
        super().__init__(structs.Loop(), bodies, given.dt, records, np.zeros((frames, 2, nodes, 3)))
        self._arrays = arrays
        self._list_launches(given)
        self._make_loop(given)
        self._attach_schemes(given)
        self._attach_contact(given)
        self._attach_corrections(given)
        self._report(given)
        self._energies = NativeEnergies(given.energies)
        self.loop.energies = c.addressof(self._energies.native)
        self._mail = [FactorMailbox(body, self.loop) for body in self._body]
        self._copies: list[Reals | None] = [None] * bodies
        self._posted: dict[int, Any] = {}
        self._changes: list[Any] = []  # those posted last, and what they point to
        self.begin: Sequence[Launch] = ()  # before the first step
        self._begun = False

    def _list_launches(self, given: EngineInput) -> None:
        """Lists the launches of all parts of a step, those of assembly and integration first."""
        spawn = given.cut.spawn if given.cut else None
        others = [part.launches for part in (given.stages, given.euler, given.substeps, given.halving) if part]
        listed = [*given.assemble, *given.integrate, *(x for part in others for x in part), *given.history]
        listed += [spawn] if spawn else []
        launches = list({id(x): x for x in cast(list[CpuLaunch], listed)}.values())  # some take part in several stages
        self.launches = launches
        self._number = {id(launch): k for k, launch in enumerate(launches)}
        self._bindings = [_binding(x) for x in launches]
        self._launch = (structs.Launch * max(len(launches), 1))()
        for entry, launch, binding in zip(self._launch, launches, self._bindings, strict=False):
            entry.kernel, entry.binding = launch.function, c.addressof(binding)

    def _make_loop(self, given: EngineInput) -> None:
        """Sets what every scene has: launches, bodies, arrays and threads."""
        loop, arrays, nodes = self.loop, given.arrays, len(given.arrays["x"])
        self._body = (structs.Body * len(given.ranges))()
        for body, (first, last) in zip(self._body, given.ranges, strict=True):
            body.first, body.last, body.snapshot_step = first, last, -1
        self._work = np.zeros(structs.WORK * nodes)
        self._history = np.array([self._number[id(launch)] for launch in given.history], np.int32)
        loop.before, loop.launches = len(given.assemble), len(given.assemble) + len(given.integrate)
        loop.launch = c.addressof(self._launch)
        loop.bodies, loop.nodes, loop.body = len(given.ranges), nodes, c.addressof(self._body)
        for name in ("row_start", "columns", "values", "b", "y", "x", "v", "clock", "moving"):
            setattr(loop, name, arrays[name].ctypes.data)
        loop.work, loop.threads = self._work.ctypes.data, usable_threads(given.solver.threads)
        loop.history, loop.histories, loop.advanced = self._history.ctypes.data, len(self._history), -1
        self._rank_one = given.rank_one and _NativeRankOne(given.rank_one, arrays["rotation"], loop)
        if given.touch is not None:
            touch = cast(CpuLaunch, given.touch)
            loop.touch = c.addressof(self._launch[self._number[id(touch)]])
            loop.react = touch.module.address("react")
        if given.cut and given.cut.spawn:
            self._let_nodes_appear(given.cut.spawn)

    def _let_nodes_appear(self, spawn: Launch) -> None:
        """Has cuts add nodes: launches over blocks have as many items as there are blocks then."""
        loop, starts = self.loop, self._arrays["row_start"]
        loop.spawn = c.addressof(self._launch[self._number[id(spawn)]])
        blocks = [k for k, launch in enumerate(self.launches) if launch.domain == "blocks"]
        self._of_blocks: Int32 = np.array(blocks, np.int32)
        loop.of_blocks, loop.blocks_launches = self._of_blocks.ctypes.data, len(blocks)
        for k in blocks:
            self._bindings[k].items = (int(starts[loop.nodes]) - loop.nodes) // 2

    def _attach_schemes(self, given: EngineInput) -> None:
        """Adds what the scheme of time integration needs."""
        loop, number = self.loop, self._number
        self._newton = None
        if given.newton:
            late = [x.domain == "blocks" and given.held is None for x in given.assemble]  # holders take forces from A
            self._newton = NativeNewton(given.newton, late, loop, self._launch)
        self._stages = given.stages and NativeStages(given.stages, loop, self._launch, number)
        self._euler = given.euler and NativeEuler(given.euler, loop, self._launch, number)
        self._substeps = given.substeps and NativeSubsteps(given.substeps, loop, number)
        self._halving = given.halving and NativeHalving(given.halving, loop, number)
        if given.halving:
            tell_bodies_apart(given.halving.parts, self._launch, number)

    def _attach_contact(self, given: EngineInput) -> None:
        self._contact = given.contact and NativeContact(given.contact, self.loop, given.arrays)
        if self._contact and given.euler:  # bodies whose step is made have the velocities of its end
            self._contact.native.predictor = given.euler.start_v.ctypes.data
        elif self._contact and self._newton:
            self._contact.native.predictor = self._newton.search_in_contact(len(given.ranges)).ctypes.data

    def _attach_corrections(self, given: EngineInput) -> None:
        """Adds what corrects factors for changes of A since their matrix."""
        self._corrections: dict[int, NativeCorrection] = {}
        starts = given.arrays["row_start"]
        self._refresh = {
            i: NativeRefresh(body, int(starts[body.last] - starts[body.first]))
            for i, body in enumerate(self._body)
            if body.last - body.first >= REFRESHED_NODES and given.solver.preconditioner in ("auto", "cholesky")
        }
        self._cut: dict[int, NativeCut] = {}
        if given.cut and given.solver.wants_factors:
            self._cut = {i: NativeCut(given.cut, self._body[i], given.dt, given.arrays) for i in given.cut.bodies}

    def _report(self, given: EngineInput) -> None:
        """Has records come with forces on obstacles and holders, and with readings."""
        loop, self._held = self.loop, given.held
        obstacles = len(given.contact.obstacles.kind) if given.contact else 0
        if given.held is not None:
            loop.holders, loop.held_reaction = given.held.shape[1], given.held.ctypes.data
        self.report_reactions(obstacles + loop.holders, obstacles)
        if given.measured:
            self._measured_first = self.report_readings(given.measured, len(given.ranges))
            addresses = [m.array.ctypes.data + m.array.itemsize * m.index for m in given.measured]
            self._measured = np.array(addresses, np.uint64)
            loop.measured, loop.measured_first = self._measured.ctypes.data, self._measured_first.ctypes.data

    # --- running ------------------------------------------------------------------------------------------------

    def run(self, steps: int) -> int:
        """Runs up to `steps` steps without Python; returns those done (fewer only after `stop`)."""
        self._begin()
        return int(self._native.wf_run(c.byref(self.loop), steps))

    def assemble(self) -> None:
        """First half of one step: the system matrix and right-hand side."""
        self._begin()
        self._native.wf_assemble(c.byref(self.loop))

    def factor_matrix(self, body: int) -> Reals:
        """Returns the values of A as last assembled, with the contacts that a factor is to know, (blocks, 3, 3).

        To be called between `assemble` and `solve`.
        """
        entry, start = self._body[body], self._arrays["row_start"]
        self._native.wf_note_matrix(c.byref(self.loop), body)
        values: Reals = self._arrays["values"][start[entry.first] : start[entry.last]]
        if not self._contact:
            return values
        out = np.empty_like(values)
        self._native.wf_copy_matrix(c.byref(self.loop), body, out.ctypes.data)
        return out[:]  # a view, which is not recycled as the copies that were asked for are (updates/snapshots.py)

    def solve(self) -> None:
        """Second half: solve, integrate, report."""
        self._native.wf_solve(c.byref(self.loop))

    def restart_clock(self) -> None:
        """Takes what was waited for since `assemble` out of the time of the step."""
        self.loop.assemble_begin = time.monotonic() - self.loop.assemble_seconds
        self.loop.cpu_begin = time.thread_time() - self.loop.assemble_seconds

    def _begin(self) -> None:
        """Runs the launches of the scheme that come before the first step."""
        if self.step == 0:
            self.take_changes()
        if self.step == 0 and not self._begun:
            for launch in self.begin:
                launch()

    def prepare(self) -> None:
        """Makes the state before the first step now, and not again when it begins."""
        self._begin()
        self._begun = True

    # --- what steps carry on --------------------------------------------------------------------------------------

    def state(self) -> list[StateArray]:
        """Returns what native code carries on beside the arrays that launches write."""
        listed = (self._stages, self._euler, self._substeps, self._halving, self._contact)
        parts = [part.state() for part in listed if part]
        corrections = [correction.state(f"engine.correction{k}") for k, correction in self._corrections.items()]
        own = [
            host_array("engine.balance", self._energies.balance.view(np.uint8), resets=False),
            host_array("engine.clock", self._arrays["clock"], resets=False),
        ]
        known = [refresh.state(f"engine.known{k}") for k, refresh in self._refresh.items()]
        return [*own, *(a for part in (*parts, *corrections, *known) for a in part)]

    def resume(self, step: int, start_time: float) -> None:
        """Goes on from a state that was written, after `step` steps."""
        self.loop.step, self.loop.start_time, self.loop.advanced, self._begun = step, start_time, -1, True
        for cut in self._cut.values():
            cut.native.start_time = start_time
        for entry in self._body:
            entry.steps = step
        self._energies.resume(self._arrays["x"], self._arrays["v"])
        for number, (*_, (binding, _)) in self._posted.items():  # what was posted is what the loop had: no news
            if self._native.wf_post_binding(c.byref(self._launch[number]), None):
                self._launch[number].binding, binding.taken = c.addressof(binding), step

    def restart(self, bodies: Sequence[int]) -> None:
        """Begins the energy balances of bodies anew."""
        given = np.array(bodies, np.int32)
        self._native.wf_restart(c.byref(self.loop), given.ctypes.data, len(given))

    def wait(self) -> Due:
        """Sleeps until the next step is due (real time) and while paused, as `run` does before each step."""
        return Due(self._native.wf_wait(c.byref(self.loop)))

    def settings(self, body: int) -> structs.SolveSettings:
        """Solver settings of a body; what is set holds from its next solve on."""
        settings: structs.SolveSettings = self._body[body].settings
        return settings

    def correct(self, body: int, nodes: int, diagonal: Reals, double: bool = False, block: Reals | None = None) -> None:
        """Factors of the body are corrected for what has come onto the diagonal since their matrix, or has left it, at
        so many nodes at most (backends/cpu/native/woodbury.h).

        nodes: 1 to 64. diagonal: (nodes of the scene,) [kg], as assembled. double: also factors in float64. block: as
        in base.Engine. Before the first step only.
        """
        surface = self._contact.surface_nodes(body) if self._contact else None
        self._corrections[body] = NativeCorrection(self._body[body], nodes, diagonal, double, block, surface)

    def corrected(self, body: int) -> int:
        """Number of nodes at which the last solve corrected the factor in use. A probe for tests; only while the loop
        stands still."""
        return int(self._body[body].correction.used)

    def forget_matrices(self, body: int) -> None:
        """Has no factor of the body refreshed from now on. For benchmarks; only while the loop stands still."""
        self._body[body].correction.known = None

    def refreshed(self, body: int) -> int:
        """Number of nodes on which the last solve was exact beside its factor. A probe for tests; only while the loop
        stands still."""
        return int(self._refresh[body].native.refreshed) if body in self._refresh else 0

    def cut_nodes(self, body: int) -> tuple[int, int, int]:
        """Nodes that lost elements since the matrix of the factor in use, with neighbours; those that the last solve
        treated; nodes without elements. A probe for tests; only while the loop stands still."""
        native = self._cut[body].native
        return native.wanted, native.count, native.gone

    def precondition(self, body: int, r: Reals) -> Reals:
        """P^-1 r, (3 nodes of the body,), with its factor as the next solve has it. A probe for tests. Needs a factor
        and an assembled matrix; r must not be 0."""
        r = np.ascontiguousarray(r, dtype=np.float64)
        z, work = np.empty_like(r), np.empty(2 * len(r))
        self._native.wf_precondition(c.byref(self.loop), body, r.ctypes.data, z.ctypes.data, work.ctypes.data)
        return z

    # --- mailboxes ----------------------------------------------------------------------------------------------

    def post_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Puts a factor into a free buffer; the loop takes it up before its next solve of the body."""
        buffer = self._mail[body].free_buffer(pattern, values.dtype)
        buffer.fill(values, step)
        self._mail[body].post(buffer)

    def post_factors(self, bodies: Sequence[int], factors: Sequence[Factor]) -> None:
        """Posts factors of different bodies, one of each, whose values the loop reads in place."""
        for body, factor in zip(bodies, factors, strict=True):
            buffer = self._mail[body].free_buffer(factor.pattern, factor.values.dtype)
            buffer.take(factor.values, factor.step)
            self._mail[body].post(buffer)

    def response_function(self) -> int:
        """Returns 0: there are no inverses."""
        return 0

    def planes_by(self, factors: FactorsTogether, responses: Float64) -> None:
        """Returns None: there are no inverses."""

    def prepare_together(self, bodies: Sequence[int], factors: FactorsTogether) -> None:
        """Does nothing: factors are applied as they come."""

    def post_together(self, bodies: Sequence[int], factors: FactorsTogether) -> None:
        """Posts factors that came together, as `post_factors`."""
        self.post_factors(bodies, factors)

    def prepare_for_factors(self) -> None:
        """Does nothing."""

    def prepare_factor(self, body: int, factor: Factor, r: Float64) -> None:
        """Returns None: a factor is applied as it comes."""

    def may_prepare(self, body: int) -> bool:
        """Returns True: nothing is prepared on a CPU."""
        return True

    def drop_factor(self, body: int, factor: Factor) -> None:
        """Does nothing."""

    def shared_memory(self) -> None:
        """Returns None: matrices and factors are on the host."""
        return

    def staged_matrix(self, body: int) -> int:
        """Returns 0, likewise."""
        return 0

    def staged_matrices(self, bodies: Int64) -> Int64:
        """Returns 0 of each of some bodies."""
        return np.zeros(len(bodies), np.int64)

    def factor_memory(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Makes an array for values of a factor."""
        return np.empty(count, dtype)

    def expect_factors(self, body: int, pattern: FactorPattern) -> None:
        """Does nothing: a factor is applied as it comes."""

    def expects_factors(self) -> bool:
        """Returns True."""
        return True

    def resume_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Posts the factor that was in use when the state was saved; what is known of its correction holds."""
        buffer = self._mail[body].free_buffer(pattern, values.dtype)
        buffer.fill(values, step)
        self._mail[body].post(buffer)
        if body in self._corrections:
            self._corrections[body].resume(buffer.address)

    @property
    def substeps(self) -> int:
        """Explicit substeps of the step under way, or of the last one; 0: an implicit scheme, or not known yet."""
        return int(self._substeps.native.state.substeps) if self._substeps else 0

    def settle_factors(self) -> None:
        """Blocks until posted factors are in use. No-op on the CPU."""

    def factor_step(self, body: int) -> int:
        """Step of the factor in use, -1 without one."""
        address = self._body[body].factor
        return int(c.cast(address, c.POINTER(structs.Factor)).contents.step) if address else -1

    def factor_buffers(self, body: int) -> list[NativeFactor]:
        """Returns all factors of a body that are in memory. A probe for tests."""
        return self._mail[body].buffers

    def factor_bytes(self, body: int) -> int:
        """Returns the bytes of values and rows that one application of the newest factor reads; 0 without one."""
        return self._mail[body].bytes_read()

    def request_matrix(self, body: int, target: Reals) -> None:
        """The loop copies the values of A into `target` once they are next assembled."""
        self._request(body, target, -1.0)

    def request_positions(self, body: int, target: Reals, ahead: float = 0.0) -> None:
        """The loop copies x + ahead v, (nodes, 3), into `target` when it next assembles; ahead: 0 or more [s].

        In all else like `request_matrix`; each replaces what the other asked for.
        """
        self._request(body, target, ahead)

    def _request(self, body: int, target: Reals, ahead: float) -> None:
        entry = self._body[body]
        entry.snapshot = None  # or the loop might take one request for the other
        self._copies[body] = target
        entry.snapshot_step, entry.ahead = -1, ahead
        entry.snapshot = target.ctypes.data

    def matrix_step(self, body: int) -> int:
        """Step of the copy asked for last, -1 while it is not there. `step` counts the steps completed before it."""
        return int(self._body[body].snapshot_step)

    def matrix_steps(self, bodies: Int64) -> Int64:
        """The same of some bodies."""
        return np.array([self._body[body].snapshot_step for body in bodies.tolist()], np.int64)

    def prepare_copies(self) -> None:
        """Does nothing: who asks for a copy gives its memory."""

    def copy_memory(self, body: int) -> None:
        """The loop copies to where it is told."""
        return None

    def request_matrices(self, bodies: Int64) -> None:
        """Does nothing, as there is no such memory."""
        return None

    def stage(self, changes: Sequence[ArrayChange]) -> list[ArrayChange]:
        """Returns the changes, which are ready."""
        return list(changes)

    def change(self, changes: Sequence[ArrayChange]) -> structs.Changes:
        """Has the loop copy new contents into arrays between two steps: those after the result's `taken` steps, once it
        is not below 0."""
        copies = (structs.Copy * max(len(changes), 1))()
        for copy, (target, source) in zip(copies, changes, strict=False):
            copy.target, copy.source, copy.bytes = target.ctypes.data, source.ctypes.data, target.nbytes
        posted = structs.Changes(copies=c.addressof(copies), count=len(changes), taken=-1)
        under_way = [each for each in self._changes if each[0].taken < 0]
        self._changes = [*under_way, (posted, copies, changes)]
        self._native.wf_post_changes(c.byref(self.loop), c.addressof(posted))
        return posted

    def withdraw_changes(self) -> bool:
        """Takes back what `change` posted and the loop has not taken up; False if there was nothing."""
        back = bool(self._native.wf_post_changes(c.byref(self.loop), None))
        if back:
            self._changes.pop()
        return back

    def take_changes(self) -> None:
        """Copies what waits at once, while the loop stands still."""
        self._native.wf_take_changes(c.byref(self.loop))

    def replace(self, launch: int, new: Launch) -> structs.Binding:
        """Gives a launch other arguments, from the next step on: the one after the result's `taken` steps, once it is
        not below 0."""
        binding = _binding(cast(CpuLaunch, new))
        displaced = self._native.wf_post_binding(c.byref(self._launch[launch]), c.addressof(binding))
        kept = self._posted.setdefault(launch, [])  # in use, waiting
        if displaced:
            kept.pop()  # it was never taken up; what is in use must live on
        else:
            del kept[:-1]  # the last one was taken up, so those before are done with
        kept.append((binding, new))
        return binding
