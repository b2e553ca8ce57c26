# SPDX-License-Identifier: MIT
"""preconditioner = "auto": block Jacobi or a factor, whichever costs less time per solve. Which factor: making.py.

At small time steps the matrix is easy and block Jacobi beats any factor; at large ones the factor wins many times
over. Neither is known beforehand, so both are measured. The one not in use is tried again now and then by a *probe*: a
solve that begins with it and goes over to the other after as many iterations as that one's whole solve costs, so that a
probe at worst doubles one solve. A pure state machine over (kind, iterations, cost); whoever drives it decides whether
cost is seconds or, where runs must repeat exactly, bytes moved.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.method import Method
from sim_server.engine import Kind
from sim_server.making import Making

MEMORY = 0.2  # weight of the newest solve in the running means
EVERY = 200  # solves between probes, doubled after each probe that was no gain ...
RARELY = 6400  # ... up to so many
HARDER = 2.0  # probe at once when solves cost so many times what they did at the last one
MARGIN = 1.1  # switch only for a clear gain
KINDS = tuple(Kind)  # by number
Made = tuple[Method | None, int]  # a factor: how it was made (None: not known), and of which step's matrix


@dataclass
class _Mean:
    cost: float = -1.0  # of a solve
    per_iteration: float = -1.0

    def add(self, iterations: int, cost: float) -> None:
        each = cost / max(iterations, 1)
        if self.cost < 0:
            self.cost, self.per_iteration = cost, each
        self.cost += MEMORY * (cost - self.cost)
        self.per_iteration += MEMORY * (each - self.per_iteration)


class Choice:
    """Of one body. `kind` and `probe` (iterations, 0: none) are the settings of its next solve.

    methods: by which its factors may be made, the one to begin with first.
    """

    def __init__(self, methods: Sequence[Method] = (Method(),)) -> None:
        self.making = Making(methods)
        self.kind = Kind.BLOCK_JACOBI
        self.probe = 0
        self._means = {Kind.BLOCK_JACOBI: _Mean(), Kind.CHOLESKY: _Mean()}
        self._since = 0
        self._every = EVERY
        self._reference = -1.0
        self._has_factor = False
        self._untried = set(methods)
        self._pending: Kind | None = None  # what the next solve goes back to if its probe is no gain

    @property
    def wants_another(self) -> bool:
        """Block Jacobi is in use and will soon be compared with the factor: better with one that is not old."""
        return self.kind is Kind.BLOCK_JACOBI and self._pending is None and self._since >= self._every // 2

    def factor_arrived(self, method: Method | None = None) -> None:
        """The first factor of a method is tried out; later ones only make the next probe sooner if block Jacobi is in
        use. method: None where there is one alone."""
        self.making.answered()
        first, self._has_factor = not self._has_factor, True
        soon = method in self._untried or self._since > EVERY // 4
        self._untried.discard(method or self.making.method)
        if first or (soon and self.kind is Kind.BLOCK_JACOBI and self._pending is None):
            self._begin_probe(Kind.CHOLESKY)

    def observe(
        self, kind: Kind, iterations: int, cost: float, asked: Kind | None = None,
        factor: Made = (None, -1), waited: float = 0.0,
    ) -> None:  # fmt: skip
        """A solve was made that ended with `kind`. asked: the one it began with; what is reported late may be older
        than the settings made last (None: it is not). waited: cost of the making of the factor that falls to each
        solve, as the steps wait for it."""
        if self._pending is not None and asked in (None, self.kind):
            self._end_probe(kind, iterations, cost, factor)
            return
        if kind not in self._means:
            return
        method, made = factor
        if method is not None and kind is Kind.CHOLESKY:
            if self.making.observe(method, made, cost + waited):  # from now on by this method
                self._means[kind] = _Mean(cost, cost / max(iterations, 1))
                self._reference = cost
            elif method != self.making.decided:
                return  # a trial, which says nothing of what is in use
        self._means[kind].add(iterations, cost)
        self._since += 1
        mean = self._means[kind].cost
        if self._reference < 0:
            self._reference = mean
        if self._has_factor and (self._since >= self._every or mean > HARDER * self._reference):
            self._begin_probe(Kind.CHOLESKY if self.kind is Kind.BLOCK_JACOBI else Kind.BLOCK_JACOBI)

    def observe_steps(
        self, kinds: Sequence[int], iterations: Sequence[int], costs: Sequence[float], asked: Sequence[int],
        factors: Sequence[Made],
    ) -> None:  # fmt: skip
        """As `observe` of each of many solves."""
        for kind, n, cost, began, factor in zip(kinds, iterations, costs, asked, factors, strict=True):
            self.observe(KINDS[kind], n, cost, KINDS[began], factor)

    def _begin_probe(self, other: Kind) -> None:
        known, probed = self._means[self.kind], self._means[other]
        each = probed.per_iteration if probed.per_iteration > 0 else known.per_iteration
        self.probe = max(2, int(known.cost / each)) if known.cost > 0 and each > 0 else 0
        self._pending, self.kind = self.kind, other

    def _end_probe(self, kind: Kind, iterations: int, cost: float, factor: Made) -> None:
        before, tried = self._pending, self.kind
        assert before is not None
        self._pending, self.probe, self._since = None, 0, 0
        gave_up = kind is not tried
        if not gave_up:
            self._means[tried] = _Mean(cost, cost / max(iterations, 1))
        better = not gave_up and (self._means[before].cost < 0 or cost * MARGIN < self._means[before].cost)
        self.kind = tried if better else before
        if tried is Kind.CHOLESKY:
            if not better:
                self.making.alternate()
            elif factor[0] is not None:
                self.making.decide(factor[0])
        self._every = EVERY if better else min(2 * self._every, RARELY)
        self._reference = self._means[self.kind].cost
