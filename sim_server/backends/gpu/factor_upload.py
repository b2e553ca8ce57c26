# SPDX-License-Identifier: MIT
"""Factors on their way into the GPU loop: expanded beside the steps, then posted into the body's mailbox.

Per body and pattern there are two targets, front and back: an expansion begins when the one before it is in use and
nothing under way reads the other target any more. A factor that comes earlier waits, and a newer one takes its place.
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
from sim_server.backends.gpu.loop import DeviceLoop
from sim_server.backends.gpu.mailbox import DeviceMailbox
from sim_server.backends.gpu.solver import SETTINGS_BYTES

log = logging.getLogger(__name__)

MAX_PATTERNS = 2  # of a body at a time: workers with different libraries send different ones


class UploadedFactor(NamedTuple):
    """An expanded factor. used: the target that it occupies."""

    expanded: Any
    target: Any
    step: int
    pattern: FactorPattern


@dataclass
class BodyUploads:
    """Of one body. targets: by pattern."""

    name: str
    mailbox: DeviceMailbox
    targets: dict[int, list[Any]] = field(default_factory=dict)
    in_use: UploadedFactor | None = None
    leaving: tuple[UploadedFactor, int] | None = None  # out of use once so many steps are completed
    posted: UploadedFactor | None = None
    queued: tuple[FactorPattern, NDArray[Any], int] | None = None
    told: bool = False


class FactorUpload:
    """solver: of solver.PcgSolver; its rows are posted through the mailboxes given, one per body."""

    def __init__(
        self, gpu: Gpu, solver: Any, loop: DeviceLoop, names: Sequence[str], mailboxes: Sequence[DeviceMailbox]
    ):
        self._gpu, self._solver, self._loop = gpu, solver, loop
        self._tracks = [BodyUploads(name, box) for name, box in zip(names, mailboxes, strict=True)]
        self._lock = threading.RLock()
        self._waiting: set[int] = set()  # bodies with something queued

    def post(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Takes a factor; it is expanded now or when there is room, and used once that is done."""
        with self._lock:
            track = self._tracks[body]
            self._look(track)
            if track.posted is None and track.leaving is None:
                self._expand(body, pattern, values, step)
            else:
                track.queued = (pattern, values.copy(), step)
                self._waiting.add(body)

    def advance(self) -> None:
        """Begins what has waited for room."""
        with self._lock:
            for body in sorted(self._waiting):
                track = self._tracks[body]
                self._look(track)
                if track.posted is None and track.leaving is None:
                    self._expand(body, *self._queued(body))

    def settle(self) -> None:
        """The newest factors will be used by the next step: waits for them. Only while the loop stands still."""
        with self._lock:
            for body, track in enumerate(self._tracks):
                self._look(track)
                if body in self._waiting:
                    if track.posted is not None and track.mailbox.withdraw():
                        track.posted.expanded.event.synchronize()  # its target may be given away
                        track.posted = None
                    self._expand(body, *self._queued(body))
                if track.posted is not None:
                    track.posted.expanded.event.synchronize()

    def _queued(self, body: int) -> tuple[FactorPattern, NDArray[Any], int]:
        self._waiting.discard(body)
        track = self._tracks[body]
        queued, track.queued = track.queued, None
        assert queued is not None
        return queued

    def step(self, body: int) -> int:
        """Step of the factor in use, -1 without one."""
        with self._lock:
            self._look(self._tracks[body])
            made = self._tracks[body].in_use
            return made.step if made else -1

    def _look(self, track: BodyUploads) -> None:
        """Notes what the loop has taken up and finished with."""
        if track.posted is not None and track.mailbox.taken:
            if track.in_use is not None:  # what was launched until now may still read it
                track.leaving = (track.in_use, int(self._loop.loop.launched))
            track.in_use, track.posted = track.posted, None
        if track.leaving is not None and self._loop.step >= track.leaving[1]:
            track.leaving = None

    def _expand(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        track = self._tracks[body]
        try:
            made = self._made(body, pattern, values, step)
        except (ValueError, CompileError) as error:
            self._tell(track, str(error))
            return
        except Exception as error:
            if not no_memory_left(error):
                raise
            self._tell(track, f"not enough GPU memory: {error}")
            return
        track.posted = made
        row = self._solver.bodies[body : body + 1].tobytes()[SETTINGS_BYTES:]
        self._gpu.cp.cuda.get_current_stream().synchronize()  # what `use` may have made is there
        track.mailbox.post(row, keep=made, event=made.expanded.event.ptr)

    def _made(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> UploadedFactor:
        track = self._tracks[body]
        expansion = self._solver.expansion(body, pattern)
        if pattern.id not in track.targets:
            for old in [k for k in track.targets if track.in_use is None or k != track.in_use.pattern.id]:
                if len(track.targets) >= MAX_PATTERNS:
                    del track.targets[old]
        targets = track.targets.setdefault(pattern.id, [])
        used = track.in_use.target if track.in_use else None
        target = next((t for t in targets if t is not used), None)
        if target is None:
            target = expansion.target()
            targets.append(target)
        self._gpu.cp.cuda.get_current_stream().synchronize()  # what was made for it is there for other streams
        expanded = expansion.expand(values, target, self._solver.spared)  # beside the steps
        self._solver.use(body, pattern, expanded, step)
        return UploadedFactor(expanded, target, step, pattern)

    def _tell(self, track: BodyUploads, reason: str) -> None:
        if not track.told:
            track.told = True
            held = "the factor that it has" if track.in_use else "block Jacobi"
            log.warning(
                "object %r: a factor cannot be used on the GPU: %s; it goes on with %s", track.name, reason, held
            )
