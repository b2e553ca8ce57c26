# SPDX-License-Identifier: MIT
"""preconditioner = "auto": block Jacobi or a factor, whichever costs less per solve (factorization.py: which factor).

At small time steps the matrix is easy and block Jacobi beats any factor; at large ones the factor wins many times
over. Neither is known beforehand, so both are measured. A trial is one solve, a *probe*: it begins with the
preconditioner that is not in use and goes over to the other after as many iterations as that one's whole solve costs,
so that a probe at worst doubles the cost of one solve. A pure state machine over (kind, iterations, cost, convergence);
the caller decides whether cost is seconds or, where runs must repeat exactly, bytes moved.

A solve that is cut off before it converged (max_iterations, budget) is cheap for nothing. So what converges is
preferred to what does not, whatever either costs; if neither does, the smaller cost of a decade of the residual
decides. A probe of block Jacobi leaves enough of what is allowed for the factor to converge after it, or is not made.
"""

from collections.abc import Sequence
from typing import NamedTuple

from protocol.method import Method
from sim_server.backends.kinds import Kind
from sim_server.updates.autotune.convergence import CONVERGED, Convergence
from sim_server.updates.autotune.factorization import FactorizationTuner
from sim_server.updates.autotune.tuner import MARGIN, TRIAL_INTERVAL, Tuner
from sim_server.updates.stats import MEMORY

HARDER = 2.0  # cost of a solve by that at the last probe from which the next probe is made at once
MAX_UNCONVERGED = 0.3  # running mean of solves not converged above which a kind counts as not converging: two in a row
RESERVE = 1.5  # times what a solve uses of what it is allowed is left to it by a probe of block Jacobi
UNCONVERGED_WEIGHT = 100.0  # times its cost and shortfall counts a solve that did not converge, among factors
MIN_FACTOR_INTERVAL = TRIAL_INTERVAL // 4  # solves since the last probe after which a new factor is probed
KINDS = tuple(Kind)  # by number
FactorId = tuple[Method | None, int]  # method (None: not known) and step of the matrix (-1: no factor)


class SolveCost(NamedTuple):
    """Running means over the solves with a kind of preconditioner."""

    cost: float = -1.0  # of a solve; below 0: not known
    per_iteration: float = -1.0
    full: float = -1.0  # as if the solves not converged had gone on at their pace
    unconverged: float = 0.0  # part of the solves
    used: float = 0.0  # part of the iterations or time allowed

    @classmethod
    def of(cls, iterations: float, cost: float, convergence: Convergence) -> "SolveCost":
        """Returns those of one solve."""
        shortfall, used = convergence
        return cls(cost, cost / max(iterations, 1), cost * max(shortfall, 1.0), float(shortfall > 0), used)

    def with_solve(self, new: "SolveCost") -> "SolveCost":
        """Returns the means after one more solve."""
        cost, each, full, unconverged, used = self
        if cost < 0:
            cost, each, full, _, used = new
        return SolveCost(
            cost + MEMORY * (new.cost - cost),
            each + MEMORY * (new.per_iteration - each),
            full + MEMORY * (new.full - full),
            unconverged + MEMORY * (new.unconverged - unconverged),
            used + MEMORY * (new.used - used),
        )

    @property
    def fails(self) -> bool:
        """True if solves with this kind do not converge."""
        return self.unconverged > MAX_UNCONVERGED

    def beats(self, other: "SolveCost") -> bool:
        """True if solves cost less than those of `other` by MARGIN, or converge where those do not."""
        if other.cost < 0:
            return True
        if self.fails != other.fails:
            return other.fails
        return self.full * MARGIN < other.full if self.fails else self.cost * MARGIN < other.cost

    def harder_than(self, before: "SolveCost") -> bool:
        """True if solves have become so much harder that the choice is to be tried again."""
        return self.cost > HARDER * before.cost or (self.fails and not before.fails)


class PreconditionerTuner(Tuner[Kind, SolveCost]):
    """Chooses `kind` and `probe`, the settings of the next solve of one body.

    methods: by which its factors may be made, the one to begin with first
    """

    def __init__(self, methods: Sequence[Method] = (Method(),)) -> None:
        super().__init__((Kind.BLOCK_JACOBI, Kind.CHOLESKY), SolveCost)
        self.factorization = FactorizationTuner(methods)
        self.probe = 0  # iterations after which the next solve goes over to the kind in use; 0: it does not
        self._reference: SolveCost | None = None  # cost of the kind in use at the last probe
        self._has_factor = False
        self._untried = set(methods)

    @property
    def kind(self) -> Kind:
        """The preconditioner with which the next solve begins."""
        return self.active

    @property
    def wants_factor(self) -> bool:
        """True if block Jacobi is in use and will soon be compared with the factor: better with a fresh one."""
        return self.active is Kind.BLOCK_JACOBI and self.candidate is None and self.solves >= self.wait // 2

    def on_factor(self, method: Method | None = None) -> None:
        """Takes note of a new factor. method: None if there is only one.

        The first factor of a method is probed at once; later ones only make the next probe sooner if block Jacobi is
        in use.
        """
        self.factorization.on_factor()
        first, self._has_factor = not self._has_factor, True
        soon = method in self._untried or self.solves > MIN_FACTOR_INTERVAL
        self._untried.discard(method or self.factorization.method)
        if first or (soon and self.active is Kind.BLOCK_JACOBI and self.candidate is None):
            self._begin_probe(Kind.CHOLESKY)

    def on_drop(self) -> None:
        """Goes back to block Jacobi since the factor is useless; the next one is probed."""
        self.current, self.candidate, self.probe, self._has_factor = Kind.BLOCK_JACOBI, None, 0, False

    def observe(
        self, kind: Kind, iterations: float, cost: float, requested: Kind | None = None, factor: FactorId | None = None,
        waiting: float = 0.0, convergence: Convergence = CONVERGED, fallbacks: int = 0,
    ) -> None:  # fmt: skip
        """Takes note of a solve.

        kind: with which it ended
        requested: with which it began. Solves that are reported late may be older than the last settings. None: not
        factor: the one that the loop had; None: not known
        waiting: cost of making the factor that falls to each solve, where steps wait for it
        fallbacks: 1 if the solve abandoned the factor
        """
        # Ignore solves that had nothing to do, or began before the factor had reached the loop
        no_factor = factor is not None and factor[1] < 0
        if not iterations or (requested is Kind.CHOLESKY and kind is not requested and no_factor):
            return
        new = SolveCost.of(iterations, cost, convergence)
        # The answer of a probe
        if self.candidate is not None and requested in (None, self.candidate):
            self._end_probe(kind, new, factor)
            return
        if requested not in (None, kind):
            if not fallbacks:
                return  # a late answer of an earlier probe: partly one kind, partly the other
            kind = Kind.CHOLESKY  # this is what asking for an abandoned factor costs
        if kind not in self.costs:
            return
        # Compare the methods of factorization
        method, step = factor or (None, -1)
        if method is not None and kind is Kind.CHOLESKY:
            shortfall = convergence.shortfall
            total = cost + waiting if shortfall == 0 else UNCONVERGED_WEIGHT * shortfall * (cost + waiting)
            if self.factorization.observe(method, step, total):  # this method is in use from now on
                self.costs[kind] = self._reference = new
            elif method != self.factorization.current:
                return  # a trial of a method tells nothing of the one in use
        # Begin a probe if one is due, or if solves have become harder
        mean = self.costs[kind] = self.costs[kind].with_solve(new)
        self.solves += 1
        self._reference = self._reference or mean
        if self.candidate is not None or kind is not self.current:
            return  # reported late
        if self._has_factor and (self.is_due() or mean.harder_than(self._reference)):
            self._begin_probe(self.following(self.current))

    def observe_steps(
        self, kinds: Sequence[int], iterations: Sequence[float], costs: Sequence[float], requested: Sequence[int],
        shortfall: Sequence[float], used: Sequence[float], fallbacks: Sequence[int], factors: Sequence[FactorId],
    ) -> None:  # fmt: skip
        """Takes note of many solves, as `observe` does of one."""
        columns = zip(kinds, iterations, costs, requested, shortfall, used, fallbacks, factors, strict=True)
        for kind, n, cost, begun, short, part, left, factor in columns:
            self.observe(KINDS[kind], n, cost, KINDS[begun], factor, 0.0, Convergence(short, part), left)

    def _begin_probe(self, other: Kind) -> None:
        limit = self._probe_limit(other)
        if limit is None:
            self.solves, self._reference = 0, self.costs[self.current]
        else:
            self.probe, self.candidate = limit, other

    def _probe_limit(self, other: Kind) -> int | None:
        """Iterations after which a probe of `other` goes over to the kind in use. 0: it does not, as nothing is lost.
        None: what a solve is allowed has no room for a probe."""
        known, probed = self.costs[self.current], self.costs[other]
        each = probed.per_iteration if probed.per_iteration > 0 else known.per_iteration
        if known.fails or known.cost <= 0 or each <= 0:
            return 0
        limit = max(2, int(known.cost / each))
        share = known.used * max(each, known.per_iteration) / known.cost  # of what is allowed, at most, per iteration
        if other is Kind.CHOLESKY or share <= 0:
            return limit  # where block Jacobi uses nearly all it is allowed, a factor is to be tried all the more
        room = int((1 - RESERVE * known.used) / share)
        return min(limit, room) if room >= 2 else None

    def _end_probe(self, kind: Kind, new: SolveCost, factor: FactorId | None) -> None:
        """The probe was answered by a solve that ended with `kind`."""
        probed, self.probe = self.candidate, 0
        assert probed is not None
        gained = False
        if kind is probed:
            self.costs[probed] = new
            gained = self.end_trial()
        else:  # it went over to the kind in use
            self.reject()
        if probed is Kind.CHOLESKY:
            if not gained:
                self.factorization.alternate()
            elif factor is not None and factor[0] is not None:
                self.factorization.use(factor[0])
        self._reference = self.costs[self.current]
