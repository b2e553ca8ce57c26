# SPDX-License-Identifier: MIT
"""Posts inverses into the mailboxes of their bodies, and tells of factors that cannot be used."""

import logging
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from sim_server.backends.compiler import CompileError
from sim_server.backends.gpu.device import no_memory_left
from sim_server.backends.gpu.mailbox import Mailboxes
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.upload.body_inverses import BodyInverses, InverseKind
from sim_server.backends.gpu.upload.inverse_builds import BuiltInverses

log = logging.getLogger(__name__)


class InversePosts:
    """Posts inverses, for one thread at a time.

    inverses: of the bodies
    mailboxes: of the solver's rows that tell factors, one per body
    names: of the bodies, for messages
    coming: returns the ids of the patterns of factors that wait, or are being built

    planes: float16 numbers per entry of the last inverse of each body, or of the first one as expected
    """

    def __init__(
        self, solver: PcgSolver, inverses: BodyInverses, mailboxes: Mailboxes, names: Sequence[str],
        coming: Callable[[], Iterable[int]],
    ):  # fmt: skip
        self._solver, self._inverses, self._mailboxes, self._names = solver, inverses, mailboxes, names
        self.planes = np.full(len(names), solver.planes or 1)
        self._coming, self._known = coming, set[InverseKind]()  # known: of which storages were made
        self._warned: set[int] = set()  # bodies, after the first factor that could not be used

    def keep(self, built: BuiltInverses) -> None:
        """Keeps new storages, and forgets plans of kinds that no body has any more."""
        if built.new:
            storages = [built.storages[row] for row in built.new]
            outdated = self._inverses.keep(built.bodies[built.new], built.kind, storages, built.event)
            if outdated or built.kind not in self._known:
                coming = {(pattern, planes) for pattern in self._coming() for planes in (1, 2)}
                self._known = {built.kind} | self._inverses.kinds() | coming
                self._solver.forget_plans(self._known)

    def post(self, built: BuiltInverses) -> list[Exception]:
        """Posts inverses; returns errors as `unusable` does."""
        bodies, given, planes = built.bodies, built.given, built.kind[1]
        steps = [each.step for each in given]
        try:
            rows = self._solver.use(bodies, built.planned, built.storages, planes, steps)
        except Exception as error:
            if len(given) == 1:
                return self.unusable(int(bodies[0]), error)
            return [each for row in range(len(given)) for each in self.post(built.of([row]))]  # those that can be used
        self._mailboxes.post(bodies, rows, built.event, built.planned)
        self._inverses.post(bodies, built.kind, steps, built.event)
        for body in bodies[self.planes[bodies] != planes].tolist():
            self.planes[body] = planes
            log.info(
                "object %r: its factors keep %d binary digits on the GPU from now on", self._names[body], 11 * planes
            )
        return []

    def unusable(self, body: int, error: Exception) -> list[Exception]:
        """Warns that a factor of a body cannot be used; returns the error if it is neither of the factor nor lack of
        memory."""
        if isinstance(error, ValueError | CompileError):
            self._warn(body, str(error))
        elif no_memory_left(error):
            self._warn(body, f"not enough GPU memory: {error}")
        else:
            return [error]
        return []

    def _warn(self, body: int, reason: str) -> None:
        if body not in self._warned:
            self._warned.add(body)
            held = "the factor that it has" if self._inverses.has_any(body) else "block Jacobi"
            name = self._names[body]
            log.warning("object %r: a factor cannot be used on the GPU: %s; it goes on with %s", name, reason, held)
