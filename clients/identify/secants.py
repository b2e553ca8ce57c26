# SPDX-License-Identifier: MIT
"""Where to try next: a Gauss-Newton step with derivatives from the runs so far (several secants at once).

Ralston and Jennrich, DUD, a derivative-free algorithm for nonlinear least squares, Technometrics 20, 1978: the runs
next to the best one give a linear model of the residual, whose least square within the bounds is tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
CONVERGED = 1e-5  # largest step, as a share of the bounds, that is not worth a run
SAME = 1e-7  # two points are one


@dataclass(frozen=True)
class Tried:
    """A run: shares (d,) of the bounds, residual (m,)."""

    shares: Values
    residual: Values

    @property
    def misfit(self) -> float:
        """Norm of the residual."""
        return float(np.linalg.norm(self.residual))


@dataclass(frozen=True)
class Proposal:
    """shares (d,) of the next run, None where these runs do not tell; converged: no run would better the best one."""

    shares: Values | None
    converged: bool = False


def first(number: int, parameters: int) -> Values | None:
    """Returns the shares of run `number` of those that come first: the middle, then each parameter alone moved."""
    if number > parameters:
        return None
    shares = np.full(parameters, 0.5)
    if number:
        shares[number - 1] = 0.75
    return shares


def propose(tried: list[Tried]) -> Proposal:
    """Returns where to try next. tried: runs in their order, with residuals of one length."""
    best = min(tried, key=lambda each: each.misfit)
    if best.misfit == 0:
        return Proposal(None, True)
    d = len(best.shares)
    near = sorted((t for t in tried if t is not best), key=lambda t: float(np.linalg.norm(t.shares - best.shares)))
    near = [t for t in near if np.abs(t.shares - best.shares).max() > SAME][: 2 * d]
    steps = np.array([t.shares - best.shares for t in near]).reshape(-1, d)
    if np.linalg.matrix_rank(steps, tol=1e-9) < d:
        return Proposal(None)
    changes = np.array([t.residual - best.residual for t in near])
    weight = (1 / np.linalg.norm(steps, axis=1))[:, None]  # secants, each of length 1
    jacobian = np.linalg.lstsq(weight * steps, weight * changes, rcond=None)[0].T
    step = _step(best, jacobian, 0.5 * 0.5 ** _failures(tried))
    if np.abs(step).max() < CONVERGED:
        return Proposal(None, True)
    shares = np.clip(best.shares + step, 0, 1)
    if any(np.abs(t.shares - shares).max() < SAME for t in tried):
        return Proposal(None)
    return Proposal(shares)


def _step(best: Tried, jacobian: Values, radius: float) -> Values:
    """Returns the step to the least square within the bounds and a distance in each parameter."""
    from scipy.optimize import lsq_linear

    low, high = np.maximum(-best.shares, -radius), np.minimum(1 - best.shares, radius)
    tight = 1e-12
    found = lsq_linear(jacobian, -best.residual, (low - tight, high + tight), tol=1e-14)
    step: Values = np.clip(found.x, low, high)
    return step


def _failures(tried: list[Tried]) -> int:
    """Returns how many of the last runs were no better than the best one before them; the first runs do not count."""
    misfits = [t.misfit for t in tried]
    return len(misfits) - 1 - max(misfits.index(min(misfits)), min(len(tried[0].shares), len(misfits) - 1))
