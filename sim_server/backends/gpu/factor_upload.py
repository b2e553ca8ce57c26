# SPDX-License-Identifier: MIT
"""Upload of factors: a partitioned inverse is built beside the steps, then posted into the mailbox of the body.

Each body has two storages per pattern (double buffering). A build begins once the inverse before it is in use and no
step under way reads the other storage. A factor that arrives earlier is queued; a newer one replaces it.
"""

import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.backends.compiler import CompileError
from sim_server.backends.gpu.device import Gpu, no_memory_left
from sim_server.backends.gpu.inverse.build_inverse import InverseStorage, PartitionedInverse
from sim_server.backends.gpu.loop import DeviceLoop
from sim_server.backends.gpu.mailbox import DeviceMailbox
from sim_server.backends.gpu.solver import SETTINGS_BYTES, PcgSolver

log = logging.getLogger(__name__)

MAX_PATTERNS = 2  # of a body at a time; workers with different libraries send different patterns


class UploadedFactor(NamedTuple):
    """A factor on the device, complete once the event of its inverse is. step: of the matrix it was made from."""

    inverse: PartitionedInverse
    storage: InverseStorage
    step: int
    pattern: FactorPattern


@dataclass
class BodyUploads:
    """Factors of one body.

    storages: by id of the pattern
    leaving: the factor in use before, and the number of steps after whose completion no step reads it
    posted: not taken by the loop yet
    queued: pattern, values and step of a factor that waits for a storage
    warned: True after the first factor that could not be used
    """

    name: str
    mailbox: DeviceMailbox
    storages: dict[int, list[InverseStorage]] = field(default_factory=dict)
    in_use: UploadedFactor | None = None
    leaving: tuple[UploadedFactor, int] | None = None
    posted: UploadedFactor | None = None
    queued: tuple[FactorPattern, NDArray[Any], int] | None = None
    warned: bool = False


class FactorUpload:
    """Builds inverses of factors and posts them.

    solver: its rows of the bodies are what is posted
    names: of the bodies, for messages
    mailboxes: of the factors, one per body
    """

    def __init__(
        self, gpu: Gpu, solver: PcgSolver, loop: DeviceLoop, names: Sequence[str], mailboxes: Sequence[DeviceMailbox]
    ):
        self._gpu, self._solver, self._loop = gpu, solver, loop
        self._uploads = [BodyUploads(name, box) for name, box in zip(names, mailboxes, strict=True)]
        self._lock = threading.RLock()
        self._waiting: set[int] = set()  # bodies with a queued factor

    def post(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Takes a factor: begins to build its inverse now, or once a storage is free."""
        with self._lock:
            uploads = self._uploads[body]
            self._refresh(uploads)
            if uploads.posted is None and uploads.leaving is None:
                self._begin(body, pattern, values, step)
            else:
                uploads.queued = (pattern, values.copy(), step)
                self._waiting.add(body)

    def advance(self) -> None:
        """Begins the builds that have waited for a storage."""
        with self._lock:
            for body in sorted(self._waiting):
                uploads = self._uploads[body]
                self._refresh(uploads)
                if uploads.posted is None and uploads.leaving is None:
                    self._begin(body, *self._pop_queued(body))

    def settle(self) -> None:
        """Waits until the next step will use the newest factors. Only while the loop stands still."""
        with self._lock:
            for body, uploads in enumerate(self._uploads):
                self._refresh(uploads)
                if body in self._waiting:
                    if uploads.posted is not None and uploads.mailbox.withdraw():
                        uploads.posted.inverse.event.synchronize()  # its storage may be reused
                        uploads.posted = None
                    self._begin(body, *self._pop_queued(body))
                if uploads.posted is not None:
                    uploads.posted.inverse.event.synchronize()

    def _pop_queued(self, body: int) -> tuple[FactorPattern, NDArray[Any], int]:
        self._waiting.discard(body)
        uploads = self._uploads[body]
        queued, uploads.queued = uploads.queued, None
        assert queued is not None
        return queued

    def step(self, body: int) -> int:
        """Returns the step of the factor in use, -1 without one."""
        with self._lock:
            self._refresh(self._uploads[body])
            factor = self._uploads[body].in_use
            return factor.step if factor else -1

    def _refresh(self, uploads: BodyUploads) -> None:
        """Updates the state of the factors: taken by the loop, out of use."""
        if uploads.posted is not None and uploads.mailbox.taken:
            if uploads.in_use is not None:  # steps launched until now may still read it
                uploads.leaving = (uploads.in_use, int(self._loop.loop.launched))
            uploads.in_use, uploads.posted = uploads.posted, None
        if uploads.leaving is not None and self._loop.step >= uploads.leaving[1]:
            uploads.leaving = None

    def _begin(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        uploads = self._uploads[body]
        try:
            factor = self._build(body, pattern, values, step)
        except (ValueError, CompileError) as error:
            self._warn(uploads, str(error))
            return
        except Exception as error:
            if not no_memory_left(error):
                raise
            self._warn(uploads, f"not enough GPU memory: {error}")
            return
        uploads.posted = factor
        row = self._solver.bodies[body : body + 1].tobytes()[SETTINGS_BYTES:]
        self._gpu.cp.cuda.get_current_stream().synchronize()  # arrays that `use` may have made are complete
        uploads.mailbox.post(row, keep=factor, event=factor.inverse.event.ptr)

    def _build(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> UploadedFactor:
        uploads = self._uploads[body]
        builder = self._solver.inverse_builder(body, pattern)
        if pattern.id not in uploads.storages:
            in_use = uploads.in_use.pattern.id if uploads.in_use else None
            for old in [k for k in uploads.storages if k != in_use]:
                if len(uploads.storages) >= MAX_PATTERNS:
                    del uploads.storages[old]
            kept = {each for other in self._uploads for each in other.storages}
            self._solver.forget_plans({*kept, pattern.id})
        storages = uploads.storages.setdefault(pattern.id, [])
        used = uploads.in_use.storage if uploads.in_use else None
        storage = next((s for s in storages if s is not used), None)
        if storage is None:
            storage = builder.storage()
            storages.append(storage)
        self._gpu.cp.cuda.get_current_stream().synchronize()  # new arrays are complete for other streams
        inverse = builder.build(values, storage, self._solver.spared)  # beside the steps
        self._solver.use(body, pattern, inverse, step)
        return UploadedFactor(inverse, storage, step, pattern)

    def _warn(self, uploads: BodyUploads, reason: str) -> None:
        if not uploads.warned:
            uploads.warned = True
            held = "the factor that it has" if uploads.in_use else "block Jacobi"
            log.warning(
                "object %r: a factor cannot be used on the GPU: %s; it goes on with %s", uploads.name, reason, held
            )
