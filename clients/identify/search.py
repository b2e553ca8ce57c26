# SPDX-License-Identifier: MIT
"""The runs of an identification, kept by Optuna in a file: what is known, what is tried next, how it goes on.

First come runs that tell derivatives, then Gauss-Newton steps (secants.py). Where these lead nowhere, or runs fail,
Optuna's sampler of Parzen estimators (TPE) tries elsewhere. A seed and the runs so far decide what comes next, so that
one that was interrupted goes on as if it had not been.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.errors import BadInput, ClientError
from clients.identify.fits import Fit
from clients.identify.secants import Tried, first, propose

STUDY = "identify"
ENOUGH = 1e-9  # misfit, relative: rounding

Attempt = Callable[[dict[str, float]], "NDArray[np.float64] | str"]  # a residual (m,), or why there is none


@dataclass(frozen=True)
class Found:
    """The best values by key, their misfit, how many runs there are in all, whether no further one would better it."""

    values: dict[str, float]
    misfit: float
    runs: int
    converged: bool


class Search:
    """Looks for the values of parameters with the least residual.

    path: of the file of runs; question: what the runs depend on. Raises BadInput if the file has runs of another one.
    """

    def __init__(self, path: Path, fits: Sequence[Fit], seed: int, question: str):
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._optuna, self.fits, self.seed = optuna, list(fits), seed
        self._space: dict[str, Any] = {
            f.key: optuna.distributions.FloatDistribution(f.low, f.high, log=f.log) for f in fits
        }
        try:
            storage = JournalStorage(JournalFileBackend(str(path)))
            self.study = optuna.create_study(study_name=STUDY, storage=storage, load_if_exists=True)
        except (OSError, ValueError, KeyError, json.JSONDecodeError) as error:
            raise BadInput(f"{path}: cannot be used as the file of runs: {error}") from None
        known = self.study.user_attrs.get("question")
        if known is None:
            self.study.set_user_attr("question", question)
        elif known != question:
            raise BadInput(
                f"{path}: has runs of another scene, other curves or bounds; --journal FILE takes another name"
            )

    def run(self, attempt: Attempt, runs: int, tick: Callable[[int, float], None] = lambda n, misfit: None) -> Found:
        """Makes runs until there are `runs` in all, or no further one would better the best; returns what was found.

        tick: is told the number of runs and the least misfit after each. Raises ClientError if all have failed.
        """
        reason, converged = "", False
        while True:
            tried = self._tried()
            least = min((t.misfit for t in tried), default=math.nan)
            tick(self._number, least)
            shares, converged = self._next(tried)
            if converged or self._number >= runs:
                break
            reason = self._make(attempt, shares) or reason
        if not tried:
            raise ClientError(f"none of {self._number} runs has come to its end; the last: {reason or 'see above'}")
        best = min(tried, key=lambda each: each.misfit)
        values = {f.key: f.value(share) for f, share in zip(self.fits, best.shares.tolist(), strict=True)}
        return Found(values, best.misfit, self._number, converged)

    @property
    def _number(self) -> int:
        done = self._optuna.trial.TrialState.COMPLETE, self._optuna.trial.TrialState.FAIL
        return len(self.study.get_trials(deepcopy=False, states=done))

    def _tried(self) -> list[Tried]:
        states = (self._optuna.trial.TrialState.COMPLETE,)
        trials = self.study.get_trials(deepcopy=False, states=states)
        return [
            Tried(
                np.array([f.share(t.params[f.key]) for f in self.fits]), np.array(t.user_attrs["residual"], dtype=float)
            )
            for t in trials
        ]

    def _next(self, tried: list[Tried]) -> tuple[NDArray[np.float64] | None, bool]:
        """Returns the shares of the next run, None to let the sampler choose, and whether there is to be none."""
        if (shares := first(self._number, len(self.fits))) is not None:
            return shares, bool(tried) and tried[-1].misfit < ENOUGH
        if not tried:
            return None, False
        found = propose(tried)
        return found.shares, found.converged or min(t.misfit for t in tried) < ENOUGH

    def _make(self, attempt: Attempt, shares: NDArray[np.float64] | None) -> str:
        """Makes a run and keeps it; returns why it failed, or nothing."""
        study, states = self.study, self._optuna.trial.TrialState
        study.sampler = self._optuna.samplers.TPESampler(seed=self.seed + self._number)
        waits = study.get_trials(deepcopy=False, states=(states.WAITING,))  # of one that was killed before it began
        if shares is not None and not waits:
            given = {f.key: f.value(share) for f, share in zip(self.fits, shares.tolist(), strict=True)}
            study.enqueue_trial(given)
        trial = study.ask(self._space)
        try:
            residual = attempt({f.key: float(trial.params[f.key]) for f in self.fits})
        except BaseException:
            study.tell(trial, state=states.PRUNED)  # it counts as none
            raise
        if isinstance(residual, str):
            study.tell(trial, state=states.FAIL)
            return residual
        trial.set_user_attr("residual", residual.tolist())
        study.tell(trial, float(np.linalg.norm(residual)))
        return ""
