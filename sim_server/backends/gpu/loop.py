# SPDX-License-Identifier: MIT
"""The native GPU loop (loop.cpp) as seen from Python: its memory, its mailboxes, records and copies to the host.

Nothing here depends on CuPy: memory, events and the functions of the driver come from a `LoopDevice`, also a fake one.
"""

import ctypes as c
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from protocol.shared_memory.located import Located, address
from sim_server.arrays import Float64, Int64
from sim_server.backends.base import Due
from sim_server.backends.gpu import structs
from sim_server.backends.gpu.mailbox import DeviceMailbox, Mailboxes, library
from sim_server.backends.gpu.structs import COPY_LIST, DEVICE_COPY, FRAME_COPIES, RECORD_TARGET
from sim_server.backends.measured import Measured
from sim_server.backends.ring_buffers import Reports
from sim_server.errors import DeviceLost

BATCH = 16  # most steps whose results are read together
GRAPH_STEPS = (1, 2, 8)  # of which there are graphs
CAPACITY = 64  # steps whose results are kept; more than can be under way
FRAMES = 8  # in the ring
BATCH_SECONDS = 2e-3  # aim for the duration of a batch [s]; requests wait for two batches at most
EXCHANGE_SECONDS = 5e-4  # likewise while matrices and factors come and go
DOUBLED = 512 << 20  # bytes of the matrices of all bodies, up to which each has two places for copies
POLL = 1e-5  # interval between queries of an event [s]
LEAD = 3e-4  # before the end of a batch the next one is launched then [s]
COPY_POLL = 1e-4  # likewise of the one behind copies to the host, while their steps are over


def places_of_copies(size: int) -> int:
    """Returns for how many copies of the matrix of each body the loop has page-locked memory. size: bytes of the
    matrices of all bodies"""
    return 2 if size <= DOUBLED else 1


def bytes_of_copies(blocks: Sequence[float], real: DTypeLike) -> float:
    """Returns the bytes of that memory. blocks: of 3x3 numbers of type `real` in the matrix of each body"""
    size = 9 * np.dtype(real).itemsize * sum(blocks)
    return places_of_copies(int(size)) * size


class LoopDevice(Protocol):
    """A GPU as the loop uses it; handles are integers.

    context: CUDA context. stream: stream of the steps. copies: stream of copies to the host.
    """

    functions: structs.CudaDriver
    context: int
    stream: int
    copies: int

    def pinned(self, size: int) -> NDArray[np.uint8]:
        """Allocates page-locked host memory, set to zero: copies from and to it run beside other work."""
        ...

    def memory(self, size: int) -> int:
        """Allocates device memory, set to zero, that is kept as long as this object; returns its address."""
        ...

    def event(self) -> int:
        """Creates an event that is kept as long as this object; a thread that waits for it sleeps."""
        ...

    def error(self, code: int) -> str:
        """Returns the meaning of an error code of the driver."""
        ...


class DeviceLoop(Reports):
    """Runs the native loop over CUDA graphs that were captured elsewhere.

    ranges: nodes [first, last) of each body
    row_start: of A
    dt: time step [s]
    mailboxes: (device address, bytes) of each
    timestamps: host memory (CAPACITY,) of STEP_TIMESTAMP that the steps write to
    newton_results: likewise (CAPACITY, bodies) of NEWTON_RESULT; None: one linearization a step
    stage_results: likewise (CAPACITY, bodies) of STAGE_RESULT; None: no scheme with stages
    substep_results: likewise (CAPACITY, bodies) of SUBSTEP_RESULT; None: an implicit scheme
    contact_results: likewise (CAPACITY, bodies) of CONTACT_RESULT; None: no contact
    contact_reactions: likewise (CAPACITY, bodies, obstacles, 6) of float64
    held_reactions: likewise (CAPACITY, bodies, holders, 6); None: no holders
    clock: host array (1,), time of the simulation [s]
    records: capacity of the ring of records
    real: type of values, x and v on the device
    most_blocks: of A of each body, however it is split (`places` of mailbox.ChangeMailbox.post); none: those of
        row_start, which stay
    addresses: device addresses of values, x and v, and with contact poses (obstacles, 7) of float64

    targets: addresses of the RecordTarget (step_results.cuh) of each batch that may be under way
    copy_launches: lists of copies of each of them, of mail, and the one of matrices (loop.h)
    """

    def __init__(
        self, device: LoopDevice, ranges: Sequence[tuple[int, int]], row_start: NDArray[Any], dt: float,
        mailboxes: Sequence[tuple[int, int]], timestamps: NDArray[Any], clock: Float64,
        records: int | None = None, real: DTypeLike = np.float64, newton_results: NDArray[Any] | None = None,
        stage_results: NDArray[Any] | None = None,
        contact_results: NDArray[Any] | None = None, contact_reactions: NDArray[Any] | None = None,
        held_reactions: NDArray[Any] | None = None, substep_results: NDArray[Any] | None = None,
        most_blocks: Sequence[int] = (), **addresses: int,
    ):  # fmt: skip
        self._device, self._ranges, bodies, nodes = device, ranges, len(ranges), len(row_start) - 1
        self._native = library()
        loop = structs.GpuLoop()
        frame = 3 * nodes * np.dtype(real).itemsize
        frames = device.pinned(FRAMES * 2 * frame).view(real).reshape(FRAMES, 2, nodes, 3)
        super().__init__(loop, bodies, dt, records, frames, device.pinned)
        self._slots = (structs.MailSlot * max(len(mailboxes), 1))()
        for slot, (target, size) in zip(self._slots, mailboxes, strict=False):
            slot.target, slot.size = target, size
        self.mailboxes = [DeviceMailbox(loop, slot, place) for place, slot in enumerate(self._slots)]
        self._readbacks, block = (structs.BodyReadback * bodies)(), 9 * np.dtype(real).itemsize
        most = most_blocks or [int(row_start[last] - row_start[first]) for first, last in ranges]
        self._room = [block * count for count in most]  # bytes of the blocks of each body at most
        places = places_of_copies(sum(self._room))
        self._doubled = places == 2
        staged = np.cumsum([0, *self._room])  # first places of all, and then the second ones: neighbours adjoin
        self._first_places, self._second = staged[:-1].astype(np.int64), int(staged[-1])
        for entry, (first, last), own in zip(self._readbacks, ranges, staged, strict=False):
            begin, end = block * int(row_start[first]), block * int(row_start[last])
            entry.values_begin, entry.values_bytes, entry.copied_step = begin, end - begin, -1
            entry.staged_begin = int(own)
            entry.x_begin, entry.x_bytes = (3 * np.dtype(real).itemsize * k for k in (first, last - first))
        self._real, self._value_bytes = np.dtype(real), places * self._second
        self._targets: dict[int, Float64] = {}
        self._own_memory: dict[int, Float64] = {}  # by its place
        entries = np.ctypeslib.as_array(self._readbacks)
        self._copied_steps, self._requests = entries["copied_step"], entries["requested"]
        self._staged_at = entries["staged_begin"]
        loop.driver = c.addressof(device.functions)
        loop.context, loop.stream, loop.copy_stream = device.context, device.stream, device.copies
        loop.mail_slots, loop.mail_slot_count = c.addressof(self._slots), len(mailboxes)
        loop.readbacks, loop.bodies = c.addressof(self._readbacks), bodies
        for name, where in addresses.items():
            setattr(loop, name, where)
        loop.capacity, loop.batch, loop.batch_seconds, loop.poll = CAPACITY, BATCH, BATCH_SECONDS, POLL
        loop.exchange_seconds, loop.lead, loop.copy_poll = EXCHANGE_SECONDS, LEAD, COPY_POLL
        loop.sizes[:] = GRAPH_STEPS
        loop.frame_bytes, loop.clock, loop.matrix_step = frame, clock.ctypes.data, -1
        loop.frame_staging = device.memory(FRAME_COPIES * 2 * frame)
        loop.timestamps = timestamps.ctypes.data
        loop.newton_results = None if newton_results is None else newton_results.ctypes.data
        loop.stage_results = None if stage_results is None else stage_results.ctypes.data
        self._written = (timestamps, clock, newton_results, stage_results)
        loop.substep_results = None if substep_results is None else substep_results.ctypes.data
        self._substeps_written = substep_results
        self._contact_written = (contact_results, contact_reactions, held_reactions)
        poses = None
        if contact_results is not None and contact_reactions is not None:
            loop.contact_results, loop.contact_reactions = contact_results.ctypes.data, contact_reactions.ctypes.data
            loop.obstacles = contact_reactions.shape[2]
            loop.pose_bytes = 56 * loop.obstacles
            loop.pose_staging = device.memory(max(FRAME_COPIES * loop.pose_bytes, 16))
            poses = device.pinned(FRAMES * loop.obstacles * 56).view(np.float64).reshape(FRAMES, loop.obstacles, 7)
        if held_reactions is not None:
            loop.held_reactions, loop.holders = held_reactions.ctypes.data, held_reactions.shape[2]
        self.report_reactions(loop.obstacles + loop.holders, loop.obstacles, poses)
        assert all(size % 4 == 0 for _, size in mailboxes)  # as copy_list.cu copies
        self._pinned = self._events_and_memory(loop)
        self._pinned += self._lists_of_copies(loop, sum(-(-size // 16) * 16 for _, size in mailboxes))

    def _events_and_memory(self, loop: structs.GpuLoop) -> list[NDArray[np.uint8]]:
        targets = [self._device.pinned(RECORD_TARGET.itemsize) for _ in loop.batches]
        self.targets = [target.ctypes.data for target in targets]
        for batch, target in zip(loop.batches, self.targets, strict=True):
            batch.target, batch.done = target, self._device.event()
        for copy in loop.frame_copies:
            copy.taken, copy.arrived = self._device.event(), self._device.event()
        loop.staged_event, loop.copied_event = self._device.event(), self._device.event()
        return targets

    def _lists_of_copies(self, loop: structs.GpuLoop, contents: int) -> list[NDArray[np.uint8]]:
        """Makes room for the lists. contents: bytes of one mail of every slot"""
        self.copy_launches = [*(batch.mail for batch in loop.batches), loop.matrices]
        mail = contents + loop.mail_slot_count * DEVICE_COPY.itemsize
        sizes = [mail] * len(loop.batches) + [loop.bodies * DEVICE_COPY.itemsize]
        lists = [self._device.pinned(COPY_LIST.itemsize + size) for size in sizes]
        for launch, memory in zip(self.copy_launches, lists, strict=True):
            launch.list, launch.target = memory.ctypes.data, self._device.memory(len(memory))
        return lists

    def report_grabs(self, graph: int, mailbox: int, reactions: NDArray[Any], counts: NDArray[Any]) -> None:
        """Has records come with what bodies exert on grabs.

        graph: handle of the CUDA graph that writes it after a step. mailbox: number of that of pushes and grabs.
        reactions: (CAPACITY, most) of structs.REACTION in host memory. counts: (CAPACITY,) likewise
        """
        loop, self._grabs_written = self.loop, (reactions, counts)
        loop.grabs, loop.touch = graph, c.addressof(self._slots[mailbox])
        loop.grab_reactions, loop.grab_counts = reactions.ctypes.data, counts.ctypes.data
        loop.most_grabs = reactions.shape[1]

    def report_measured(self, measured: Sequence[Measured], results: Float64) -> None:
        """Has records come with numbers of their bodies. results: host memory (CAPACITY, measured) that steps write."""
        self._measured_written, self._measured_first = results, self.report_readings(measured, self.loop.bodies)
        self.loop.measured, self.loop.measured_first = results.ctypes.data, self._measured_first.ctypes.data
        self.loop.measured_count = len(measured)

    def report_pairs(self, sums: NDArray[Any], counts: NDArray[Any]) -> None:
        """Has records come with what bodies exert on each other.

        sums: host memory (CAPACITY, bodies, most) of structs.PAIR_SUM that the steps write to, by other body. counts:
        likewise (CAPACITY, bodies), how many each body has
        """
        self._pairs_written = sums, counts
        self.loop.pair_sums, self.loop.pair_counts = sums.ctypes.data, counts.ctypes.data
        self.loop.most_pairs = sums.shape[2]

    def mailboxes_of_bodies(self, first: int) -> Mailboxes:
        """Returns the mailboxes from number `first` on, one per body, in place of those that stand alone."""
        return Mailboxes(self.loop, self._slots, first, len(self._ranges))

    # --- running ------------------------------------------------------------------------------------------------

    def use_graphs(
        self, graphs: Sequence[int], records: Sequence[int], copies: Sequence[int], energy_balance: int,
        elastic_energy: int, matrix: int = 0,
    ) -> None:  # fmt: skip
        """Sets the handles of the CUDA graphs.

        graphs: of GRAPH_STEPS (0: none), then the same beginning with the kernel that writes the time
        records: for each of `targets`, settles the energy balance of the last step and writes the records asked for
        copies: for each of `copy_launches`, makes its copies
        energy_balance: settles the energy balance of the last step
        elastic_energy: adds the elastic energy to it
        matrix: makes A of the next step, for a copy; 0: each step makes its own
        """
        self.loop.graphs[0][:], self.loop.graphs[1][:] = graphs[: len(GRAPH_STEPS)], graphs[len(GRAPH_STEPS) :]
        for batch, graph in zip(self.loop.batches, records, strict=True):
            batch.records = graph
        for launch, graph in zip(self.copy_launches, copies, strict=True):
            launch.graph = graph
        self.loop.energy_balance, self.loop.elastic_energy = energy_balance, elastic_energy
        self.loop.matrix = matrix

    def run(self, steps: int) -> int:
        """Runs up to `steps` steps without Python; returns the number done, which is smaller only after `stop`.

        Raises DeviceLost.
        """
        done = int(self._native.wf_gpu_run(c.byref(self.loop), steps))
        self._check()
        return done

    def wait(self) -> Due:
        """Sleeps while paused and, in real time, until the next step is due."""
        return Due(self._native.wf_gpu_wait(c.byref(self.loop)))

    def open_step(self) -> None:
        """Begins a step whose kernels the caller launches."""
        self._native.wf_gpu_open(c.byref(self.loop))
        self._check()

    def take_changes(self) -> None:
        """Makes the changes of parameters that wait, while no step is under way."""
        self._native.wf_gpu_take_changes(c.byref(self.loop))
        self._check()

    def renew_mail(self) -> None:
        """Reads the mailboxes of settings and factors again within such a step; the stream must be empty."""
        self._native.wf_gpu_renew(c.byref(self.loop))
        self._check()

    def close_step(self) -> None:
        """Ends such a step: waits for it and writes its records."""
        self._native.wf_gpu_close(c.byref(self.loop))
        self._check()

    def _check(self) -> None:
        if self.loop.error:
            call = self.loop.failed_call.decode()
            raise DeviceLost(f"the GPU failed at step {self.step}: {call}: {self._device.error(self.loop.error)}")

    # --- matrices -----------------------------------------------------------------------------------------------

    def request_matrix(self, body: int, target: Float64) -> None:
        """Copies the values of A of the next step into `target`; complete once `matrix_step` returns a step.

        target: (blocks, 3, 3), with room for all blocks that the body may have; what is behind those of that step has
        no meaning
        """
        self._request(body, target, structs.REQUEST_VALUES)

    def request_positions(self, body: int, target: Float64, ahead: float = 0.0) -> None:
        """Copies the positions at the end of the next step, (nodes, 3), likewise. ahead [s]: must be 0 on a GPU."""
        if ahead:
            raise ValueError(f"positions of a GPU are copied as they are, not {ahead:g} s ahead")
        self._request(body, target, structs.REQUEST_POSITIONS)

    def copy_memory(self, body: int) -> Float64 | None:
        """Returns page-locked memory that the next copy of a body's matrix is brought to, (blocks, 3, 3), and that the
        one behind it leaves alone; None: where matrices are large, or of another type."""
        return self._memory_at(body, self._other_place(body)) if self._has_copy_memory else None

    def request_matrices(self, bodies: Int64) -> tuple[list[Float64], Int64] | None:
        """Requests the matrices of some bodies, each as `request_matrix` does for its `copy_memory`, and returns that
        memory and its addresses; None, and requests none: where there is no such memory."""
        if not self._has_copy_memory:
            return None
        begin = address(self._staging())
        places = self._other_places(bodies)
        self._staged_at[bodies] = places
        self._copied_steps[bodies] = -1
        self._requests[bodies] = structs.REQUEST_VALUES  # last, as in `_request`
        self.loop.requested = 1
        each = zip(bodies.tolist(), places.tolist(), strict=True)
        return [self._memory_at(body, place) for body, place in each], begin + places

    @property
    def _has_copy_memory(self) -> bool:
        return self._doubled and self._real == np.float64

    def _memory_at(self, body: int, place: int) -> Float64:
        """Returns the memory of copies of a body's matrix from byte `place` on."""
        if (own := self._own_memory.get(place)) is None:
            staging = self._staging()
            memory = staging[place : place + self._room[body]].view(np.float64).reshape(-1, 3, 3).view(Located)
            memory.address = address(staging) + place
            own = self._own_memory[place] = memory
        return own

    def _other_place(self, body: int) -> int:
        """First byte of the place for a copy that the last one was not brought to: who has that may still read it."""
        begin = int(self._first_places[body])
        return begin + self._second if self._staged_at[body] == begin else begin

    def _other_places(self, bodies: Int64) -> Int64:
        """Returns the same of each of some bodies."""
        begin = self._first_places[bodies]
        places: Int64 = np.where(self._staged_at[bodies] == begin, begin + self._second, begin)
        return places

    def prepare_copies(self) -> None:
        """Makes the memory of copies, which is page-locked: while it is made all calls to CUDA wait."""
        self._staging()

    def _staging(self) -> NDArray[Any]:
        """Returns the page-locked memory of copies, made at the first request at the latest."""
        if not self.loop.staged:
            self.loop.staged = self._device.memory(self._value_bytes)
            self._pinned_values = self._device.pinned(self._value_bytes)
            self.loop.host_matrices = self._pinned_values.ctypes.data
        return self._pinned_values

    def _request(self, body: int, target: Float64, request: int) -> None:
        self._staging()
        if target is not self.copy_memory(body):
            self._targets[body] = target
        if self._doubled:
            self._staged_at[body] = self._other_place(body)
        self._copied_steps[body] = -1
        self._requests[body] = request  # last: from then on the loop copies
        self.loop.requested = 1

    def matrix_step(self, body: int) -> int:
        """Returns the step (steps completed before) of the copy requested last, -1 until it is complete."""
        step = int(self._copied_steps[body])
        if step >= 0 and body in self._targets:
            entry, target = self._readbacks[body], self._targets.pop(body)
            data = self._pinned_values[entry.staged_begin :][: target.size * self._real.itemsize]
            target[...] = data.view(self._real).reshape(target.shape)
        return step

    def matrix_steps(self, bodies: Int64) -> Int64:
        """Returns the same of each of some bodies."""
        if not self._targets:
            steps: Int64 = self._copied_steps[bodies]
            return steps
        return np.array([self.matrix_step(body) for body in bodies.tolist()], np.int64)

    def staged_matrix(self, body: int) -> int:
        """Returns the device address of the copy requested last, once it is complete: the same float64 values
        (blocks, 3, 3), until the next request. 0: there is none."""
        return int(self.staged_matrices(np.array([body]))[0])

    def staged_matrices(self, bodies: Int64) -> Int64:
        """Returns the same of each of some bodies."""
        if not self.loop.staged or self._real != np.float64:
            return np.zeros(len(bodies), np.int64)
        at: Int64 = np.where(self._copied_steps[bodies] < 0, 0, int(self.loop.staged) + self._staged_at[bodies])
        return at
