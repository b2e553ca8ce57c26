# SPDX-License-Identifier: MIT
"""The native GPU loop (loop.cpp) as seen from Python: its memory, its mailboxes and what comes home.

Nothing here knows CuPy: memory, events and the driver's functions come from a `LoopDevice`, which a test may play.
"""

import ctypes as c
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu import structs
from sim_server.backends.gpu.mailbox import DeviceMailbox, library
from sim_server.backends.gpu.structs import FRAME_COPIES
from sim_server.backends.ring_buffers import Reals, Reports
from sim_server.errors import DeviceLost

BATCH = 16  # steps read back together at most
MANY = 8  # steps of the larger graph
CAPACITY = 64  # steps whose results the device keeps: more than can be under way
FRAMES = 8
SPAN = 2e-3  # s that a batch lasts about: what asks for something waits two of them at most
POLL = 1e-5  # s


class LoopDevice(Protocol):
    """What the loop needs of a GPU: handles are integers."""

    functions: structs.CudaDriver
    context: int
    stream: int
    copies: int

    def pinned(self, size: int) -> NDArray[np.uint8]:
        """Host memory that the device can copy from and to beside other work, zero."""
        ...

    def memory(self, size: int) -> int:
        """Device memory, zero; it stays."""
        ...

    def event(self) -> int:
        """An event that a thread may sleep on; it stays."""
        ...

    def error(self, code: int) -> str:
        """What an error code of the driver means."""
        ...


class DeviceLoop(Reports):
    """The loop over graphs that were captured elsewhere.

    row_start: of A. ranges: nodes [first, last) of each body. mailboxes: (device address, bytes) of each.
    results, stamps: host memory (CAPACITY, bodies) of PCG_RESULT and (CAPACITY,) of STEP_TIMESTAMP that the steps write
    to. found: likewise (CAPACITY, bodies) of NEWTON_RESULT; None: one linearization a step. energies: likewise of
    ENERGY_RECORD. clock: host array (1,). real: of values, x and v on the device, whose addresses these are.
    """

    def __init__(
        self, device: LoopDevice, ranges: Sequence[tuple[int, int]], row_start: NDArray[Any], dt: float,
        mailboxes: Sequence[tuple[int, int]], results: NDArray[Any], stamps: NDArray[Any], clock: Reals,
        records: int = 8192, real: Any = np.float64, found: NDArray[Any] | None = None,
        energies: NDArray[Any] | None = None, **addresses: int,
    ):  # fmt: skip
        self._device, self._ranges, bodies, nodes = device, ranges, len(ranges), len(row_start) - 1
        self._native = library()
        loop = structs.GpuLoop()
        frame = 3 * nodes * np.dtype(real).itemsize
        frames = device.pinned(FRAMES * 2 * frame).view(real).reshape(FRAMES, 2, nodes, 3)
        super().__init__(loop, bodies, dt, records, frames)
        self._box = (structs.MailSlot * max(len(mailboxes), 1))()
        for box, (target, size) in zip(self._box, mailboxes, strict=False):
            box.target, box.size = target, size
        self.mailboxes = [DeviceMailbox(loop, box) for box in self._box]
        self._body, block = (structs.BodyReadback * bodies)(), 9 * np.dtype(real).itemsize
        for entry, (first, last) in zip(self._body, ranges, strict=True):
            begin, end = block * int(row_start[first]), block * int(row_start[last])
            entry.values_begin, entry.values_bytes, entry.copied_step = begin, end - begin, -1
            entry.x_begin, entry.x_bytes = (3 * np.dtype(real).itemsize * k for k in (first, last - first))
        self._real, self._value_bytes = np.dtype(real), block * int(row_start[-1])
        self._targets: dict[int, Reals] = {}
        self._asked_of: dict[int, int] = {}  # bytes, of each body
        loop.driver = c.pointer(device.functions)
        loop.context, loop.stream, loop.copy_stream = device.context, device.stream, device.copies
        loop.mail_slots, loop.mail_slot_count, loop.readbacks, loop.bodies = (
            self._box,
            len(mailboxes),
            self._body,
            bodies,
        )
        for name, address in addresses.items():
            setattr(loop, name, address)
        loop.capacity, loop.batch, loop.many, loop.batch_seconds, loop.poll = CAPACITY, BATCH, MANY, SPAN, POLL
        loop.frame_bytes, loop.clock, loop.matrix_step = frame, clock.ctypes.data, -1
        loop.frame_staging = device.memory(FRAME_COPIES * 2 * frame)
        loop.results, loop.timestamps = results.ctypes.data, stamps.ctypes.data
        loop.newton_results = None if found is None else found.ctypes.data
        loop.energy_records = None if energies is None else energies.ctypes.data
        self._written = (results, stamps, clock, found, energies)
        self._pinned = self._events_and_memory(loop, sum(-(-size // 16) * 16 for _, size in mailboxes))

    def _events_and_memory(self, loop: structs.GpuLoop, upload: int) -> list[NDArray[np.uint8]]:
        memory = [self._device.pinned(max(upload, 16)) for _ in loop.batches]
        for batch, room in zip(loop.batches, memory, strict=True):
            batch.upload, batch.done = room.ctypes.data, self._device.event()
        for picture in loop.frame_copies:
            picture.taken, picture.arrived = self._device.event(), self._device.event()
        loop.staged_event, loop.copied_event = self._device.event(), self._device.event()
        return memory

    # --- running ------------------------------------------------------------------------------------------------

    def use_graphs(self, graphs: Sequence[int], account: int, elastic: int) -> None:
        """Handles of the graphs of one step and of MANY steps (0: none), then of the same with the time noted first; of
        the graphs that tell the energy of the last step and evaluate its elastic energy."""
        self.loop.graphs[:], self.loop.energy_balance, self.loop.elastic_energy = graphs, account, elastic

    def run(self, steps: int) -> int:
        """Runs up to `steps` steps without Python; returns those done (fewer only after `stop`).

        Raises DeviceLost.
        """
        done = int(self._native.wf_gpu_run(c.byref(self.loop), steps))
        self._check()
        return done

    def wait(self) -> bool:
        """Sleeps until the next step is due (real time) and while paused; False if the loop is to stop."""
        return bool(self._native.wf_gpu_wait(c.byref(self.loop)))

    def _open(self) -> None:
        """Begins a step whose kernels the caller puts onto the stream."""
        self._native.wf_gpu_open(c.byref(self.loop))
        self._check()

    def _renew(self) -> None:
        """Looks into the mailboxes within a step; the stream must be empty."""
        self._native.wf_gpu_renew(c.byref(self.loop))
        self._check()

    def _close(self) -> None:
        """Ends such a step: waits for it and reports."""
        self._native.wf_gpu_close(c.byref(self.loop))
        self._check()

    def _check(self) -> None:
        if self.loop.error:
            call = self.loop.failed_call.decode()
            raise DeviceLost(f"the GPU failed at step {self.step}: {call}: {self._device.error(self.loop.error)}")

    # --- matrices -----------------------------------------------------------------------------------------------

    def request_matrix(self, body: int, target: Reals) -> None:
        """The values of A of the next step are copied into `target`; it is filled once `matrix_step` says so."""
        self._request(body, target, 1)

    def request_positions(self, body: int, target: Reals, ahead: float = 0.0) -> None:
        """Likewise the positions, (nodes, 3), those at the end of the step. ahead: must be 0 here."""
        if ahead:
            raise ValueError(f"positions of a GPU are copied as they are, not {ahead:g} s ahead")
        self._request(body, target, 2)

    def _request(self, body: int, target: Reals, what: int) -> None:
        if not self.loop.staged:  # made once, when the first one is asked for
            self.loop.staged = self._device.memory(self._value_bytes)
            self._pinned_values = self._device.pinned(self._value_bytes)
            self.loop.host_matrices = self._pinned_values.ctypes.data
        self._targets[body] = target
        entry = self._body[body]
        entry.copied_step, entry.requested = -1, what
        self._asked_of[body] = entry.values_bytes if what == 1 else entry.x_bytes
        self.loop.requested = 1

    def matrix_step(self, body: int) -> int:
        """Step of the copy asked for last, -1 while it is not there. `step` counts the steps completed before it."""
        entry = self._body[body]
        step = int(entry.copied_step)
        if step >= 0 and body in self._targets:
            data = self._pinned_values[entry.values_begin : entry.values_begin + self._asked_of[body]]
            target = self._targets.pop(body)
            target[...] = data.view(self._real).reshape(target.shape)
        return step
