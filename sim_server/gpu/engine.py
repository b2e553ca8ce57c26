# SPDX-License-Identifier: MIT
"""The simulation loop on a GPU: one CUDA graph a step, results read back once per batch of steps.

The same face as engine.Engine. A step is a graph of the scene's launches with the persistent solver among them; the
stop test of the iteration is on the device, so the host only launches graphs. Between batches the host looks into its
mailboxes (factors, arguments, requests for matrices) and passes on what it finds by copies on the step's stream.
"""

import logging
import threading
import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.engine import RECORD
from sim_server.gpu.device import DeviceLaunch, DeviceModule, Gpu
from sim_server.gpu.expand import LIMIT, Expanded, Expansion
from sim_server.gpu.fuse import fused
from sim_server.gpu.solver import RESULT, Solver

log = logging.getLogger(__name__)

Reals = NDArray[np.float64]
CAPACITY = 256  # results kept on the device: steps per batch at most


class _Settings:
    """Solver settings of a body; what is set holds from its next batch on."""

    def __init__(self, row: NDArray[Any]):
        object.__setattr__(self, "_row", row)

    def __getattr__(self, name: str) -> Any:
        return self._row[name].item()

    def __setattr__(self, name: str, value: Any) -> None:
        if name != "budget":  # of wall time: not on a GPU
            self._row[name] = value


class GpuEngine:
    """Arguments as engine.Engine's, launches from Gpu.module."""

    records_dtype = RECORD

    def __init__(
        self, gpu: Gpu, assemble: Sequence[DeviceLaunch], integrate: Sequence[DeviceLaunch],
        ranges: Sequence[tuple[int, int]], dt: float, batch: int = 16, **arrays: NDArray[Any],
    ):  # fmt: skip
        self.gpu, self.launches, self._before = gpu, [*assemble, *integrate], len(assemble)
        self._arrays, self.batch, self.dt = arrays, min(batch, CAPACITY), dt
        cp = gpu.cp
        self.stream = cp.cuda.Stream(non_blocking=True, priority=-5)
        self._counter = cp.zeros(1, np.int64)
        self.solver = Solver(gpu, ranges, arrays, self._counter, CAPACITY)
        self._bodies = self.solver.bodies
        self._tick = DeviceModule("gpu/tick.cu", gpu).function("tick")
        self._graphs: dict[int, Any] = {}
        self._fused = fused(gpu, self.launches[: self._before])
        self._lock = threading.Lock()
        self._factors: dict[int, tuple[int, Expanded]] = {}  # by body: step, and what is being made
        self._expansions: dict[tuple[int, int], Expansion] = {}
        self._too_large: set[int] = set()
        self._snapshots: dict[int, Reals] = {}
        self._copied: dict[int, int] = {}
        self._changed = True
        self._found: list[NDArray[Any]] = []
        self._frames: list[tuple[int, Reals, Reals]] = []
        self.loop = SimpleNamespace(
            realtime=0, patient=0, stop=0, pause=0, frame_every=0, late_steps=0, frames_dropped=0, records_dropped=0,
            deadline=0.0, late=0.0,
        )  # fmt: skip
        self.step = 0
        self._upload()

    # --- running ------------------------------------------------------------------------------------------------

    def _one_step(self) -> None:
        """Everything a step puts onto the stream."""
        for launch in self._fused:
            launch()
        self._finish_step()

    def _finish_step(self) -> None:
        """Solve, integrate, count."""
        self.solver.launch()
        for launch in self.launches[self._before :]:
            launch()
        clock, bodies = self.gpu.twin(self._arrays["clock"]), len(self._bodies)
        self._tick((1,), (256,), (clock, self._counter, np.float64(self.dt), self.solver.arrived, np.int32(bodies)))

    def _graph(self) -> Any:
        if 1 not in self._graphs:
            with self.stream:
                self.stream.begin_capture()
                self._one_step()
                self._graphs[1] = self.stream.end_capture()
        return self._graphs[1]

    def run(self, steps: int) -> int:
        """Up to `steps` steps; returns those done (fewer only after `stop`)."""
        done = 0
        with self.stream:
            if 1 not in self._graphs:  # compile and warm up outside of the capture
                self._graph()
            while done < steps and self.wait():
                size = min(self._batch_size(), steps - done)
                self._run_batch(size)
                done += size
        return done

    def _batch_size(self) -> int:
        size = 1 if self.loop.realtime or self._snapshots else self.batch
        every = self.loop.frame_every
        return min(size, every - self.step % every) if every > 0 else size

    def _run_batch(self, size: int) -> None:
        self._look_into_mail()
        begin = time.perf_counter()
        for _ in range(size):
            self._graphs[1].launch(self.stream)
        self.stream.synchronize()
        seconds = time.perf_counter() - begin
        self._report(size, begin, seconds / size)
        self._copy_matrices()
        self._copy_frame()

    def wait(self) -> bool:
        """Sleeps until the next step is due (real time) and while paused; False if the loop is to stop."""
        while self.loop.pause and not self.loop.stop:
            time.sleep(1e-3)
            self.loop.deadline = 0.0
        self.loop.late = 0.0
        if self.loop.realtime and not self.loop.stop:
            self._keep_pace()
        return not self.loop.stop

    def _keep_pace(self) -> None:
        now = time.monotonic()
        self.loop.deadline = self.loop.deadline or now
        if now < self.loop.deadline:
            time.sleep(self.loop.deadline - now)
        self.loop.late = max(0.0, now - self.loop.deadline)
        if self.loop.late > self.dt:
            self.loop.late_steps += 1
            self.loop.deadline = now  # do not chase lost time
        self.loop.deadline += self.dt

    def assemble(self) -> None:
        """First half of one step."""
        with self.stream:
            for launch in self.launches[: self._before]:
                launch()
            self.stream.synchronize()
        values = self._arrays["values"]
        values[:] = self.gpu.twin(values).get(stream=self.stream)

    def solve(self) -> None:
        """Second half: solve, integrate, report."""
        begin = time.perf_counter()
        with self.stream:
            self._look_into_mail(patient=True)
            self._finish_step()
            self.stream.synchronize()
            self._report(1, begin, time.perf_counter() - begin)
            self._copy_frame()

    def _report(self, size: int, begin: float, seconds: float) -> None:
        count = len(self._bodies)
        all_results = self.solver.results.get(stream=self.stream).view(RESULT).reshape(CAPACITY, count)
        found = all_results[np.arange(self.step, self.step + size) % CAPACITY]
        records = np.zeros((size, count), RECORD)
        records["step"] = np.arange(self.step + 1, self.step + size + 1)[:, None]
        records["time"] = records["step"] * self.dt
        records["body"] = np.arange(count)
        for name in ("factor_step", "residual", "iterations", "status", "kind", "asked", "fallbacks", "bad_node"):
            records[name] = found[name]
        records["solve"], records["whole"], records["late"], records["begin"] = (
            found["seconds"],
            seconds,
            self.loop.late,
            begin,
        )
        with self._lock:
            self._found.append(records.ravel())
        self.step += size
        self._arrays["clock"][0] = self.step * self.dt  # for those who ask the host

    # --- mailboxes ----------------------------------------------------------------------------------------------

    def settings(self, body: int) -> Any:
        """Solver settings of a body."""
        self._changed = True
        return _Settings(self._bodies[body : body + 1].reshape(()))

    def _upload(self) -> None:
        self.solver._rows.set(self._bodies.view(np.uint8), stream=self.stream)
        self._changed = False

    def _look_into_mail(self, patient: bool = False) -> None:
        """Takes up finished factors and changed settings. patient: waits for factors that are being expanded."""
        with self._lock:
            waiting = dict(self._factors)
        for body, (step, made) in waiting.items():
            if patient:
                made.event.synchronize()
            if not made.event.done:
                continue
            self.solver.use(body, made, step)
            self._changed = True
            with self._lock:
                if self._factors[body][1] is made:
                    del self._factors[body]
        if self._changed:
            self._upload()

    def post_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Has L expanded on a stream of its own; taken up between steps once that is done."""
        with self._lock:
            occupied = {int(self._bodies[body]["inverse"])}
            if body in self._factors:
                self._factors[body][1].event.synchronize()  # they share what they are made from
                occupied.add(self._factors[body][1].inverse)
        key = (body, pattern.id)
        if pattern.size > LIMIT:
            if body not in self._too_large:
                self._too_large.add(body)
                log.warning(
                    "body %d has %d degrees of freedom: beyond %d the GPU has no factors yet, it goes on with block "
                    "Jacobi", body, pattern.size, LIMIT,
                )  # fmt: skip
            return
        if key not in self._expansions:
            self._expansions[key] = Expansion(self.gpu, pattern)
        made = self._expansions[key].expand(values, occupied)
        with self._lock:
            self._factors[body] = (step, made)

    def settle_factors(self) -> None:
        """Sees to it that the next solve uses what was posted: waits until it is expanded (deterministic policies)."""
        self._look_into_mail(patient=True)

    def factor_step(self, body: int) -> int:
        """Step of the factor in use, -1 without one."""
        row = self._bodies[body]
        return int(row["factor_step"]) if row["inverse"] else -1

    def factor_bytes(self, body: int) -> int:
        """Of the inverse that an application reads."""
        return self.solver.factor_bytes(body)

    def request_matrix(self, body: int, target: Reals) -> None:
        """The values of A are copied into `target` after the next step."""
        self._copied[body] = -1
        self._snapshots[body] = target

    def matrix_step(self, body: int) -> int:
        """Step of the copy asked for last, -1 while it is not there."""
        return self._copied.get(body, -1)

    def _copy_matrices(self) -> None:
        for body, target in list(self._snapshots.items()):
            row, start = self._bodies[body], self._arrays["row_start"]
            begin, end = start[row["first"]], start[row["first"] + row["nodes"]]
            values = self.gpu.twin(self._arrays["values"])
            target[:] = values[begin:end].get(stream=self.stream)
            del self._snapshots[body]
            self._copied[body] = self.step - 1

    def replace(self, launch: int, new: DeviceLaunch) -> None:
        """Gives a mailed launch other arguments, from the next step on."""
        self.launches[launch].take(new)

    # --- reports ------------------------------------------------------------------------------------------------

    def records(self) -> NDArray[Any]:
        """New records since the last call, oldest first."""
        with self._lock:
            found, self._found = self._found, []
        return np.concatenate(found) if found else np.zeros(0, RECORD)

    def _copy_frame(self) -> None:
        every = self.loop.frame_every
        if every <= 0 or self.step % every:
            return
        x, v = (self.gpu.twin(self._arrays[name]).get(stream=self.stream) for name in ("x", "v"))
        self._frames.append((self.step, x, v))

    def frames(self) -> list[tuple[int, Reals, Reals]]:
        """New frames since the last call."""
        frames, self._frames = self._frames, []
        return frames
