# SPDX-License-Identifier: MIT
"""The engine of a GPU: one CUDA graph per step.

The graph holds the launches of the scene and the persistent solver, whose stop test is on the device. The native loop
(loop.cpp) launches graphs, copies mail to the device and reads results. This module gives it the graphs
(step_graphs.py) and posts settings, factors and arguments.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from itertools import repeat
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.base import ArrayChange, Capability, EngineInput, Launch
from sim_server.backends.cpu.structs import REACTION
from sim_server.backends.factors_together import FactorsTogether
from sim_server.backends.gpu.central_difference import ESTIMATE_EVERY
from sim_server.backends.gpu.copy_lists import ListedCopies
from sim_server.backends.gpu.cuda import CudaDevice
from sim_server.backends.gpu.cupy_types import Graph
from sim_server.backends.gpu.device import DeviceLaunch, Gpu
from sim_server.backends.gpu.factor_upload import FactorUpload
from sim_server.backends.gpu.helper import alone
from sim_server.backends.gpu.host_results import HostResults
from sim_server.backends.gpu.inverse.device_digits import is_large
from sim_server.backends.gpu.inverse.digits import planes_by, response_function
from sim_server.backends.gpu.known_patterns import KnownPatterns
from sim_server.backends.gpu.loop import CAPACITY, DeviceLoop
from sim_server.backends.gpu.mailbox import ChangeMailbox, DeviceMailbox
from sim_server.backends.gpu.pinned import pinned_array
from sim_server.backends.gpu.shared_device_memory import SharedDeviceMemory
from sim_server.backends.gpu.solver import PCG_BODY, SETTINGS_BYTES
from sim_server.backends.gpu.splits import Staged
from sim_server.backends.gpu.step_graphs import StepGraphs, handle
from sim_server.backends.gpu.step_records import StepRecords
from sim_server.backends.gpu.step_sequence import StepSequence
from sim_server.backends.gpu.structs import DeviceChanges, Mail
from sim_server.backends.gpu.upload.given_factor import Given
from sim_server.backends.state import StateArray

MOST_GRABS = 1024  # pushes and grabs at a time, of which forces are told
GRAB_BLOCKS, GRAB_THREADS = 32, 128  # of the kernel react (effects/touch.cu)
PREPARED_WITHIN = 1.0  # s in which an inverse that is prepared for a check is begun, else the check goes without
AT_A_TIME = 2  # factors of a body: one comes while the one before it is built
MEMORY_AHEAD = 4 << 20, 256 << 20  # bytes of factors for which memory is taken before they come


class DeviceSettings:
    """Solver settings of a body. An attribute that is set is valid from the next batch on."""

    def __init__(self, row: NDArray[Any], mailbox: DeviceMailbox):
        object.__setattr__(self, "_row", row)
        object.__setattr__(self, "_mailbox", mailbox)

    def __getattr__(self, name: str) -> Any:
        return self._row[name].item()

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "omega" or self._row[name] == value:  # no SSOR on a GPU
            return
        self._row[name] = value
        self._mailbox.post(self._row.tobytes()[:SETTINGS_BYTES])


class GpuEngine(DeviceLoop):
    """Runs the steps of a scene on a GPU.

    given: input from the scene
    records: capacity of the ring of records

    sequence: launches that make a step

    Raises errors that device.building translates, for lack of memory.
    """

    capabilities: frozenset[Capability] = frozenset()

    def __init__(self, gpu: Gpu, given: EngineInput, records: int | None = None):
        device, arrays, cut = CudaDevice(gpu.cp), given.arrays, given.cut
        self.gpu, self._arrays, self._steps = gpu, arrays, device.step_stream
        self._claim = ExitStack()  # of a second GPU, from the first to the second half of a step
        self.launches = cast(Sequence[DeviceLaunch], [*given.assemble, *given.integrate])
        results = HostResults.allocated(device, given)
        contact = results.contact
        self.sequence = StepSequence(gpu, device, given, results)
        self.solver, self._energies = self.sequence.solver, self.sequence.energies
        super().__init__(
            device, given.ranges, arrays["row_start"], given.dt, self._mailbox_targets(), results.timestamps,
            arrays["clock"], records, gpu.twin(arrays["values"]).dtype, results.newton, results.stages,
            contact.solves if contact else None, contact.reactions if contact else None, results.held,
            results.substeps, cut.most_blocks if cut else (), **self._addresses(),
        )  # fmt: skip
        if contact and contact.pairs:
            self.report_pairs(*contact.pairs)
        if results.measured is not None:
            self.report_measured(given.measured, results.measured)
        self._ties = given.contact.ties if given.contact else None
        self._broken = contact.broken if contact else None
        self._prepare_factors(given)
        self.begin: Sequence[Launch] = ()  # launches before the first step
        self._prepared = False
        self._changes, self._work_graphs = ChangeMailbox(self.loop), list[Graph]()
        self._known: Float64 = arrays["values"]  # as a factor is to know them
        writer = StepRecords(gpu, self.solver.results, self._energies.records, CAPACITY, self.loop)
        self._graphs = StepGraphs(self._steps, self.sequence, writer, ListedCopies(gpu), self)
        self._graphs.give_to(self)
        if given.touch is not None:
            self._report_grabs(device, cast(DeviceLaunch, given.touch))
        gpu.cp.cuda.get_current_stream().synchronize()  # arrays are complete for the streams of the loop

    def _addresses(self) -> dict[str, int]:
        """Returns the device addresses of what the loop copies to the host, by name."""
        found = {name: int(self.gpu.twin(self._arrays[name]).data.ptr) for name in ("values", "x", "v")}
        return found | ({"poses": self.sequence.contact.poses} if self.sequence.contact else {})

    def _mailbox_targets(self) -> list[tuple[int, int]]:
        """Returns device address and bytes of each mailbox: settings of the bodies, their factors, mailed launches."""
        row, first, bodies = PCG_BODY.itemsize, self.solver.bodies_device, range(len(self.solver.bodies))
        targets = [(first + row * k, SETTINGS_BYTES) for k in bodies]
        targets += [(first + row * k + SETTINGS_BYTES, row - SETTINGS_BYTES) for k in bodies]
        mailed = [k for k, launch in enumerate(self.launches) if launch.mailed]
        self._mailed = {k: len(targets) + i for i, k in enumerate(mailed)}
        return targets + [(self.launches[k].mail_address, self.launches[k].params.nbytes) for k in mailed]

    def _prepare_factors(self, given: EngineInput) -> None:
        """Posts the settings, and makes ready for factors."""
        bodies, arrays = len(given.ranges), given.arrays
        mailboxes = self.mailboxes_of_bodies(bodies)
        upload = FactorUpload(self.gpu, self.solver, self, given.names, mailboxes)
        kept = () if self.sequence.splits else given.ranges  # patterns of what is split change
        self._factor_upload = upload
        self._patterns = KnownPatterns(self.solver, upload.expect, kept, arrays["row_start"], arrays["columns"])
        self._expected: dict[int, Future[None]] = {}  # memory for factors that will come, by pattern
        every = np.arange(bodies)
        mailboxes.post(every, self.solver.factor_rows(every))
        for k in range(bodies):
            self.mailboxes[k].post(self.solver.bodies[k : k + 1].tobytes()[:SETTINGS_BYTES])

    # --- running ------------------------------------------------------------------------------------------------

    def run(self, steps: int) -> int:
        self._factor_upload.advance()
        self._make_ready()
        with alone(self.solver.features.helper):
            return super().run(steps)

    def _make_ready(self) -> None:
        """Runs the launches before the first step, and takes the initial state of the energy balance."""
        substeps = self.sequence.substeps
        begins = bool(self.begin or substeps) and self.step == 0 and not self._prepared
        if self.step == 0:
            self.take_changes()
        if begins:
            for launch in self.begin:
                launch()
            if substeps:
                substeps.start()
        if not self._energies.started:
            self._energies.start()
            begins = True
        if begins:
            self.gpu.cp.cuda.get_current_stream().synchronize()

    def prepare(self) -> None:
        """Makes the state before the first step now, and not again when it begins."""
        self._make_ready()
        self._prepared = True

    def state(self) -> list[StateArray]:
        """Returns what the device carries on beside the arrays that launches write."""
        return self.sequence.state()

    def resume(self, step: int, start_time: float) -> None:
        """Goes on from a state that was written, after `step` steps."""
        self.loop.step = self.loop.launched = step
        self.loop.start_time, self._prepared, self._energies.started = start_time, True, True
        self.sequence.counter[:] = step
        self._arrays["clock"][:] = self.gpu.twin(self._arrays["clock"]).get()
        self.gpu.cp.cuda.get_current_stream().synchronize()

    def restart(self, bodies: Sequence[int]) -> None:
        """Begins the energy balances of bodies anew after a reset, while the loop stands still."""
        self._energies.start(bodies)
        if self._ties and self._broken is not None:
            self._broken[:] = self._ties.broken[:] = self.gpu.twin(self._ties.broken, dtype=np.dtype(np.int32)).get()
        self.gpu.cp.cuda.get_current_stream().synchronize()

    def restart_energy(self) -> None:
        """Restarts the energy balance from the state at the beginning of the next step, after x or v were set."""
        self._energies.started = False

    def _report_grabs(self, device: CudaDevice, touch: DeviceLaunch) -> None:
        """Captures the kernel that writes the forces on grabs, which follows a step only while there are some."""
        reactions = device.pinned(CAPACITY * MOST_GRABS * REACTION.itemsize).view(REACTION)
        reactions = reactions.reshape(CAPACITY, MOST_GRABS)
        counts = device.pinned(CAPACITY * 8).view(np.int64)
        addresses = touch.mail_address, self.sequence.counter.data.ptr, reactions.ctypes.data, counts.ctypes.data
        arguments = (*map(np.uint64, addresses), np.int32(MOST_GRABS), np.int32(CAPACITY))
        kernel = touch.module.function("react")
        graph = self._graphs.captured(lambda: kernel((GRAB_BLOCKS,), (GRAB_THREADS,), arguments))
        self.report_grabs(handle(graph), self._mailed[self.launches.index(touch)], reactions, counts)

    def assemble(self) -> None:
        """Runs the first half of one step, and copies the system matrix to the host."""
        self._claim.close()
        with ExitStack() as claim:
            claim.enter_context(alone(self.solver.features.helper))  # refused here, no step is half made
            self._make_ready()
            self.open_step()
            with self._steps:
                self.sequence.assemble()
                values = self._arrays["values"]
                values[...] = self.gpu.twin(values).get(stream=self._steps)
            self._known = self.sequence.known(values)
            self._claim = claim.pop_all()

    def factor_matrix(self, body: int) -> Float64:
        """Returns the values of A as last assembled, with the contacts that a factor is to know, (blocks, 3, 3)."""
        first, last = self._ranges[body]
        start = self._arrays["row_start"]
        return cast(Float64, self._known[start[first] : start[last]])

    def restart_clock(self) -> None:
        """Has the time of the step begin anew, without its assembly, and that of the loop's thread."""
        with self._steps:
            self.sequence.begin()
        self.loop.cpu = time.thread_time()

    def solve(self) -> None:
        """Runs the second half: solve, integration, records."""
        graph = self._graphs.second_half
        with self._claim:
            self._factor_upload.settle()
            self.renew_mail()
            if graph:  # with branches, which only graphs have
                graph.launch(self._steps)
            else:
                with self._steps:
                    self.sequence.finish()
            self.close_step()

    # --- mailboxes ----------------------------------------------------------------------------------------------

    def settings(self, body: int) -> DeviceSettings:
        """Returns the solver settings of a body."""
        row = self.solver.bodies[body : body + 1].reshape(())
        return DeviceSettings(row, self.mailboxes[body])

    def post_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Builds the inverse of a factor beside the steps; it is used from the first batch after its completion on."""
        self._factor_upload.post(body, pattern, values, step)

    def post_factors(self, bodies: Sequence[int], factors: Sequence[Factor]) -> None:
        """Posts factors of different bodies, one of each; inverses of many are built beside the caller."""
        self._factor_upload.post_many(
            (body, f.pattern, f.values, f.step, 0) for body, f in zip(bodies, factors, strict=True)
        )

    def response_function(self) -> int:
        """Address of the function that finds the largest response of factors, where digits are chosen by it."""
        return response_function() if self.solver.planes is None else 0

    def planes_by(self, factors: FactorsTogether, responses: Float64) -> list[int] | None:
        """Returns how many float16 numbers an entry the inverse of each factor needs, by its largest response (k,);
        None: not known, as of large factors and of those that are not in float32."""
        values = factors.values[0]
        told = self.solver.planes is None and values.dtype == np.float32 and not is_large(values)
        return planes_by(responses) if told else None

    def prepare_together(self, bodies: Sequence[int], factors: FactorsTogether) -> None:
        """Begins to build the inverses of factors, beside steps and caller."""
        self._factor_upload.prepare_many(_given(bodies, factors))

    def post_together(self, bodies: Sequence[int], factors: FactorsTogether) -> None:
        """Posts factors that came together, as `post_factors`."""
        self._factor_upload.post_many(_given(bodies, factors))

    def prepare_for_factors(self) -> None:
        """Has the kernels that build inverses of factors compiled beside the caller, and the inverses planned whose
        patterns are known from earlier runs."""
        self.solver.compile_builder()
        self._patterns.plan()

    def prepare_factor(self, body: int, factor: Factor, r: Float64) -> Callable[[], Float64 | None]:
        """Builds the inverse of a factor beside caller and steps, and applies it to r; returns what waits for that."""
        coming = self._factor_upload.prepare(body, factor.pattern, factor.values, factor.step, r)

        def applied() -> Float64 | None:
            try:
                found = coming.result(PREPARED_WITHIN)
            except TimeoutError:  # a factor before it waits for a step, as in a pause
                return None
            return found.result() if found is not None else None

        return applied

    def may_prepare(self, body: int) -> bool:
        """False while the factor before waits to be used, or steps under way still read the one that it replaced."""
        return self._factor_upload.may_prepare(body)

    def drop_factor(self, body: int, factor: Factor) -> None:
        """Gives up a factor that may have been prepared, and is not posted."""
        self._factor_upload.drop(body, factor.values)

    def factor_memory(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Makes an array for values of a factor, from which the device copies them."""
        return pinned_array(self.gpu.cp, count, dtype)

    def shared_memory(self) -> SharedDeviceMemory:
        """Returns device memory that workers beside this process can open."""
        return SharedDeviceMemory(self.gpu)

    def expect_factors(self, body: int, pattern: FactorPattern) -> None:
        """Begins to plan the inverses of factors of a pattern that will come, and to take memory for such factors,
        beside the caller."""
        self._factor_upload.expect(body, pattern)
        if pattern.id not in self._expected and MEMORY_AHEAD[0] <= 4 * pattern.nonzeros <= MEMORY_AHEAD[1]:
            self._expected[pattern.id] = self.solver.beside(partial(self._take_memory, pattern.nonzeros))
        self._patterns.note(body, pattern)

    def _take_memory(self, count: int) -> None:
        """Has page-locked memory for factors of so many values in CuPy's pool, as many as are there at a time. While it
        is made all calls to CUDA wait."""
        together = [self.factor_memory(count, np.dtype(np.float32)) for _ in range(AT_A_TIME)]
        del together

    def expects_factors(self) -> bool:
        """True once the inverses of all factors that are expected are planned, and their memory is there."""
        return self.solver.plans_made and all(each.done() for each in self._expected.values())

    def resume_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Posts the factor that was in use when the state was saved."""
        self._factor_upload.post(body, pattern, values, step)

    @property
    def substeps(self) -> int:
        """Explicit substeps of the first step; 0: an implicit scheme, or not known yet. Those of later ones are in the
        records."""
        return self.sequence.substeps.first if self.sequence.substeps else 0

    def settle_factors(self) -> None:
        """Blocks until the next solve will use the posted factors (deterministic policies)."""
        self._factor_upload.settle()

    def factor_step(self, body: int) -> int:
        """Returns the step of the factor in use, -1 without one."""
        return self._factor_upload.step(body)

    def factor_bytes(self, body: int) -> int:
        """Returns the bytes of the inverse that one application reads."""
        return self.solver.factor_bytes(body)

    def correct(
        self, body: int, nodes: int, diagonal: Float64, double: bool = False, block: Float64 | None = None
    ) -> None:
        """Not on a GPU (Capability.LOW_RANK_UPDATE), whose solver corrects factors by itself (correction.py)."""
        raise NotImplementedError

    def replace(self, launch: int, new: Launch) -> Mail:
        """Replaces the arguments of a mailed launch from the next batch on.

        Its first step is the one after the result's `taken` steps, once that is not below 0.
        """
        self.gpu.cp.cuda.get_current_stream().synchronize()  # its arrays are complete
        return self.mailboxes[self._mailed[launch]].post(cast(DeviceLaunch, new).params.tobytes(), keep=new)

    def stage(self, changes: Sequence[ArrayChange]) -> list[Staged | None]:
        """Copies new contents to the device beside the arrays; None: no kernel has the array.

        Arrays of the host have them at once.
        """
        twins = [(self.gpu.known_twin(host), contents) for host, contents in changes]
        staged = [None if twin is None else Staged.of(self.gpu, [(twin, new)]) for twin, new in twins]
        if self.sequence.splits and (followed := self.sequence.splits.stage(changes)):
            rows = next(k for k, (host, _) in enumerate(changes) if host is self._arrays["row_start"])
            own = cast(Staged, staged[rows])
            staged[rows] = Staged([*own.copies, *followed.copies], (own.keep, followed.keep), followed.places)
        if not self._work_graphs:
            self._prepare_changes()
        self.gpu.cp.cuda.get_current_stream().synchronize()  # what is copied is complete
        for host, contents in changes:
            host[...] = contents
        return staged

    def _prepare_changes(self) -> None:
        """Captures what is launched before and after the copies of a change, in a stream of its own: steps are under
        way."""
        cp = self.gpu.cp
        self._energies.prepare_work()
        self._estimate_now = cp.asarray(np.array([ESTIMATE_EVERY], np.int32))
        stream = cp.cuda.Stream(non_blocking=True)
        graphs = []
        for after in (False, True):
            with stream:
                stream.begin_capture()
                if after and self.sequence.splits:
                    self.sequence.splits.launch()
                self._energies.launch_work(after)
                graphs.append(stream.end_capture())
        self._work_graphs = graphs

    def change(self, changes: Sequence[Staged | None]) -> DeviceChanges:
        """Copies new contents into the twins of arrays between two batches: those after the result's `taken` steps."""
        made = [each for each in changes if each is not None]
        copies = [copy for each in made for copy in each.copies]
        places = next((each.places for each in made if each.places is not None), None)
        if self.sequence.substeps:
            copies.append((self.sequence.substeps.since, int(self._estimate_now.data.ptr), 4))
        before, after = (handle(graph) for graph in self._work_graphs)
        return self._changes.post(copies, before, after, (changes, self._estimate_now), places)

    def take_changes(self) -> None:
        """Copies what waits at once, while the loop stands still."""
        cpu = self.loop.cpu  # of the loop's thread, which may be another
        super().take_changes()
        self._steps.synchronize()
        self.loop.cpu = cpu

    def withdraw_changes(self) -> bool:
        """Takes back what `change` was given last and the loop has not taken up; False if there is nothing."""
        return self._changes.withdraw()

    def records_and_reactions(self) -> tuple[NDArray[Any], Float64]:
        """Returns the records since the last call, oldest first, and reactions of obstacles (Reports); also begins to
        build inverses that were queued."""
        self._factor_upload.advance()
        if self._ties and self._broken is not None:
            self._ties.broken[:] = self._broken
        return super().records_and_reactions()


def _given(bodies: Sequence[int], factors: FactorsTogether) -> Iterator[Given]:
    """Returns factors as their inverses are built."""
    planes = factors.planes or repeat(0)
    return zip(bodies, repeat(factors.pattern), factors.values, factors.steps, planes)
