# SPDX-License-Identifier: MIT
"""preconditioner = "auto": block Jacobi or a factor, whichever costs less per solve (tune_factorization.py: which one).

At small time steps the matrix is easy and block Jacobi beats any factor; at large ones the factor wins many times
over. Neither is known beforehand, so both are measured. The one not in use is tried again now and then by a *probe*: a
solve that begins with it and goes over to the other after as many iterations as that one's whole solve costs, so that a
probe at worst doubles one solve. A pure state machine over (kind, iterations, cost, reached); whoever drives it decides
whether cost is seconds or, where runs must repeat exactly, bytes moved.

A solve that is cut off before it converged (max_iterations, budget) is cheap for nothing. So what converges is
preferred to what does not, whatever either costs; if neither does, the smaller cost of a decade of the residual
decides. A probe of block Jacobi leaves enough of what is allowed for the factor to converge after it, or is not made.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from protocol.method import Method
from sim_server.backends.cpu.engine import Kind
from sim_server.updates.convergence import CONVERGED, Reached
from sim_server.updates.tune_factorization import Making

MEMORY = 0.2  # weight of the newest solve in the running means
EVERY = 200  # solves between probes, doubled after each probe that was no gain ...
RARELY = 6400  # ... up to so many
HARDER = 2.0  # probe at once when solves cost so many times what they did at the last one
MARGIN = 1.1  # switch only for a clear gain
FAILING = 0.3  # running mean of solves not converged from which a kind does not converge: two in a row
ROOM = 1.5  # times what a solve uses of what it is allowed is left to it by a probe of block Jacobi
CUT_OFF = 100.0  # times its cost is at least what counts for a solve not converged, among factors
KINDS = tuple(Kind)  # by number
Made = tuple[Method | None, int]  # a factor: how it was made (None: not known), and of which step's matrix


@dataclass
class _Mean:
    cost: float = -1.0  # of a solve
    per_iteration: float = -1.0
    full: float = -1.0  # as if the solves not converged had gone on at their pace
    failed: float = 0.0  # solves not converged
    used: float = 0.0  # of the iterations or time allowed

    @classmethod
    def of(cls, iterations: float, cost: float, reached: Reached) -> "_Mean":
        """Of one solve."""
        full, failed = cost * max(reached.lack, 1.0), float(reached.lack > 0)
        return cls(cost, cost / max(iterations, 1), full, failed, reached.used)

    def add(self, iterations: float, cost: float, reached: Reached) -> None:
        new = self.of(iterations, cost, reached)
        if self.cost < 0:
            self.cost, self.per_iteration, self.full, self.used = new.cost, new.per_iteration, new.full, new.used
        for name in ("cost", "per_iteration", "full", "failed", "used"):
            before = getattr(self, name)
            setattr(self, name, before + MEMORY * (getattr(new, name) - before))

    @property
    def failing(self) -> bool:
        return self.failed > FAILING

    def beats(self, other: "_Mean") -> bool:
        """Clearly."""
        if self.failing != other.failing:
            return other.failing
        return self.full * MARGIN < other.full if self.failing else self.cost * MARGIN < other.cost

    def harder_than(self, before: "_Mean") -> bool:
        """Than at the last probe."""
        return self.cost > HARDER * before.cost or (self.failing and not before.failing)


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
        self._reference: _Mean | None = None
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

    def factor_dropped(self) -> None:
        """The factor is of no use: block Jacobi until another one comes, which is tried out."""
        self.kind, self.probe, self._pending, self._has_factor = Kind.BLOCK_JACOBI, 0, None, False

    def observe(
        self, kind: Kind, iterations: float, cost: float, asked: Kind | None = None,
        factor: Made | None = None, waited: float = 0.0, reached: Reached = CONVERGED, fallbacks: int = 0,
    ) -> None:  # fmt: skip
        """A solve was made that ended with `kind`. asked: the one it began with; what is reported late may be older
        than the settings made last (None: it is not). factor: None where it is not told; made -1: the loop had none.
        waited: cost of the making of the factor that falls to each solve, as the steps wait for it. fallbacks: 1 where
        the factor was left in the solve."""
        if not iterations or (asked is Kind.CHOLESKY and kind is not asked and factor is not None and factor[1] < 0):
            return  # nothing was to be solved, or the factor asked for is still on its way: it says nothing
        if self._pending is not None and asked in (None, self.kind):
            self._end_probe(kind, _Mean.of(iterations, cost, reached), factor)
            return
        if asked not in (None, kind):
            if not fallbacks:
                return  # of a probe that is over: partly one, partly the other
            kind = Kind.CHOLESKY  # what it costs to ask for a factor that is left
        if kind not in self._means:
            return
        method, made = factor or (None, -1)
        if method is not None and kind is Kind.CHOLESKY:
            counted = cost + waited if reached.lack == 0 else CUT_OFF * reached.lack * (cost + waited)
            if self.making.observe(method, made, counted):  # from now on by this method
                self._means[kind] = _Mean.of(iterations, cost, reached)
                self._reference = replace(self._means[kind])
            elif method != self.making.decided:
                return  # a trial, which says nothing of what is in use
        mean = self._means[kind]
        mean.add(iterations, cost, reached)
        self._since += 1
        self._reference = self._reference or replace(mean)
        if self._pending is not None or kind is not self.kind:
            return  # reported late
        if self._has_factor and (self._since >= self._every or mean.harder_than(self._reference)):
            self._begin_probe(Kind.CHOLESKY if self.kind is Kind.BLOCK_JACOBI else Kind.BLOCK_JACOBI)

    def observe_steps(
        self, kinds: Sequence[int], iterations: Sequence[float], costs: Sequence[float], asked: Sequence[int],
        lack: Sequence[float], used: Sequence[float], fallbacks: Sequence[int], factors: Sequence[Made],
    ) -> None:  # fmt: skip
        """As `observe` of each of many solves."""
        columns = zip(kinds, iterations, costs, asked, lack, used, fallbacks, factors, strict=True)
        for kind, n, cost, began, short, share, left, factor in columns:
            self.observe(KINDS[kind], n, cost, KINDS[began], factor, 0.0, Reached(short, share), left)

    def _begin_probe(self, other: Kind) -> None:
        if (limit := self._limit(other)) is None:
            self._since, self._reference = 0, replace(self._means[self.kind])
            return
        self.probe = limit
        self._pending, self.kind = self.kind, other

    def _limit(self, other: Kind) -> int | None:
        """Iterations of a solve after which a probe of `other` goes back to what is in use. 0: it does not, as nothing
        is lost. None: no room for a probe."""
        known, probed = self._means[self.kind], self._means[other]
        each = probed.per_iteration if probed.per_iteration > 0 else known.per_iteration
        if known.failing or known.cost <= 0 or each <= 0:
            return 0
        limit = max(2, int(known.cost / each))
        share = known.used * max(each, known.per_iteration) / known.cost  # of what is allowed, at most, per iteration
        if other is Kind.CHOLESKY or share <= 0:
            return limit  # where block Jacobi uses nearly all it is allowed, a factor is to be tried all the more
        room = int((1 - ROOM * known.used) / share)
        return min(limit, room) if room >= 2 else None

    def _end_probe(self, kind: Kind, found: _Mean, factor: Made | None) -> None:
        before, tried = self._pending, self.kind
        assert before is not None
        self._pending, self.probe, self._since = None, 0, 0
        gave_up = kind is not tried
        if not gave_up:
            self._means[tried] = found
        better = not gave_up and (self._means[before].cost < 0 or found.beats(self._means[before]))
        self.kind = tried if better else before
        if tried is Kind.CHOLESKY:
            if not better:
                self.making.alternate()
            elif factor is not None and factor[0] is not None:
                self.making.decide(factor[0])
        self._every = EVERY if better else min(2 * self._every, RARELY)
        self._reference = replace(self._means[self.kind])
