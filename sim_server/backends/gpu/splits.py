# SPDX-License-Identifier: MIT
"""Bodies that are split while steps run on a GPU: what follows the pattern of A beside the arrays of the scene.

Between two steps the loop copies new contents into the arrays of the scene that follow its parameters, as with every
change of parameters, and with them lists of the solver, places of own blocks of the Newton iteration, and where the
blocks of each body begin. Then two kernels begin the copies of nodes (effects/cutting_split.cu) and note which bodies
got another pattern (note_splits.cu), so that the solver uses no older factor.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64
from sim_server.backends.base import ArrayChange, EngineInput
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, compiled, options
from sim_server.backends.gpu.followed_rows import changed_bodies
from sim_server.backends.gpu.newton import NewtonIteration
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.state import device_arrays
from sim_server.backends.state import StateArray

TEXT = Declarations("backends/gpu/note_splits.cu")
SPLIT_NOTES = TEXT.dtype("SplitNotes")
THREADS = 128  # of the only thread block


class Staged(NamedTuple):
    """New contents of an array, ready on the device.

    copies: device addresses of target and source, and bytes. keep: objects that own the memory. places: as of
    mailbox.ChangeMailbox.post
    """

    copies: list[tuple[int, int, int]]
    keep: Any
    places: NDArray[np.int64] | None = None

    @classmethod
    def of(cls, gpu: Gpu, contents: Sequence[tuple[DeviceArray, NDArray[Any]]]) -> "Staged":
        """Copies new contents of arrays to the device, beside them."""
        made = [(target, gpu.cp.asarray(new.astype(target.dtype))) for target, new in contents]
        copies = [(int(target.data.ptr), int(new.data.ptr), int(target.nbytes)) for target, new in made]
        return cls(copies, made)


class DeviceSplits:
    """What follows the pattern of A on the device.

    given: input of the engine. newton: None with one linearization a step. counter: (1,) completed steps
    """

    def __init__(
        self, gpu: Gpu, given: EngineInput, solver: PcgSolver, newton: NewtonIteration | None, counter: DeviceArray
    ):  # fmt: skip
        assert given.cut is not None and given.cut.spawn is not None
        self._gpu, self._solver, self._newton, self._ranges = gpu, solver, newton, given.ranges
        self._pattern = given.arrays["row_start"], given.arrays["columns"]
        self._block = 9 * gpu.twin(given.arrays["values"]).dtype.itemsize  # bytes
        self._spawn = cast(DeviceLaunch, given.cut.spawn)
        bodies, zeros = len(given.ranges), gpu.cp.zeros
        self._numbers = np.zeros(bodies, np.int64)  # of the patterns that were staged last
        self._known: tuple[Int32, Int32] = (self._pattern[0].copy(), self._pattern[1].copy())  # these patterns
        self._last: Staged | None = None  # what follows them
        self._memory: dict[str, DeviceArray] = {
            "number": zeros(bodies, np.int64), "noted": zeros(bodies, np.int64), "step": counter,
            "split_step": solver.split_step,
        }  # fmt: skip
        self._params = np.zeros((), SPLIT_NOTES)
        self._params["bodies"] = bodies
        for name, array in self._memory.items():
            self._params[name] = array.data.ptr
        module = gpu.cp.RawModule(code=TEXT.checked(), options=options(gpu.types), backend="nvrtc")
        self._note = compiled("note_splits.cu", module, "note_splits")

    def stage(self, changes: Sequence[ArrayChange]) -> Staged | None:
        """Makes ready what follows the new pattern; None: the pattern is not among these changes."""
        new = {id(host): contents for host, contents in changes}
        row_start, columns = (new.get(id(host)) for host in self._pattern)
        if row_start is None or columns is None:
            return None
        changed = changed_bodies(self._ranges, self._known, (row_start, columns))
        if self._last is None or changed.any():  # else what was staged last is the same, and may not have been taken up
            numbers = self._numbers + changed
            self._last = self._made(row_start, columns, numbers)  # may lack memory
            self._numbers, self._known = numbers, (row_start.copy(), columns.copy())
        return self._last

    def _made(self, row_start: Int32, columns: Int32, numbers: Int64) -> Staged:
        contents: list[tuple[DeviceArray, NDArray[Any]]] = [(self._memory["number"], numbers)]
        contents += self._solver.follow(row_start, columns)
        if self._newton:
            contents.append(self._newton.follow(row_start, columns))
        staged = Staged.of(self._gpu, contents)
        return staged._replace(places=places_of(self._ranges, row_start, self._block))

    def launch(self) -> None:
        """Appends what follows the copies of a change to the stream: copies of nodes begin, splits are noted."""
        self._spawn()
        self._note((1,), (THREADS,), (self._params,))

    def state(self) -> list[StateArray]:
        """Returns what steps carry on: which factors are too old."""
        return device_arrays("engine.splits", self._memory, "split_step")


def places_of(ranges: Sequence[tuple[int, int]], row_start: Int32, block: int) -> NDArray[np.int64]:
    """Returns the first byte of the blocks of each body, and their bytes, (bodies, 2). block: bytes of one"""
    first, last = np.array(ranges, np.int64).T
    begin, end = row_start[first].astype(np.int64), row_start[last].astype(np.int64)
    return np.ascontiguousarray(np.stack([begin, end - begin], axis=1) * block)
