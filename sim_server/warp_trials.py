# SPDX-License-Identifier: MIT
"""warp = "auto" at work: what warping.py wants of each body becomes settings of the loop, whose records come back."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.engine import HELD, NOTE_ALWAYS, NOTE_COPIES, Kind
from sim_server.simulation import Simulation
from sim_server.track import Track
from sim_server.warping import Warping


class WarpTrials:
    """Of those bodies of a simulation that are warped. free: the loop runs beside, and does not wait for settings.

    A loop is exact (Engine.exact) if it reckons frames from the very step of the factor; else it is told which one,
    which it cannot be while it runs freely: then there are no trials, as frames that follow again would not fit factors
    whose matrices were copied while they were held.
    """

    def __init__(self, simulation: Simulation, tracks: Sequence[Track], free: bool):
        self._simulation, self._engine = simulation, simulation.engine
        self._tracks = [t for t in tracks if t.body.index in simulation.warped]
        self._indices = [t.body.index for t in self._tracks]
        for t in self._tracks:
            t.warping = Warping()
            if free:
                self._engine.settings(t.body.index).note = NOTE_COPIES

    def note(self, fresh: Sequence[Track]) -> None:
        """Before a step of a policy that waits: whose matrices of it become factors."""
        for t in self._tracks:
            settings = self._engine.settings(t.body.index)
            settings.note = NOTE_ALWAYS if t in fresh else 0
            if not self._engine.exact:
                settings.adopt = int(t.newest == t.noted != t.made)
                t.made = t.noted if settings.adopt else t.made
            t.noted = self._engine.step if t in fresh else t.noted

    def tried(self, t: Track, record: Any) -> bool:
        """The solve was part of a trial: what it took is no fault of the factor."""
        return t.warping is not None and bool(record["warping"] & HELD) != t.warping.decided

    def tried_in(self, r: NDArray[Any]) -> NDArray[np.bool_]:
        """The same of records (steps, bodies) of all bodies."""
        tried = np.zeros(r.shape, bool)
        if self._tracks:
            bodies, decided = self._indices, [t.warping is not None and t.warping.decided for t in self._tracks]
            tried[:, bodies] = (r["warping"][:, bodies] & HELD != 0) != np.array(decided)
        return tried

    def observe(self, t: Track, record: Any) -> None:
        """A solve was made; if with a factor alone, it says something of the warp."""
        if t.warping is None or not telling(record):
            return
        step, held = int(record["step"]) - 1, bool(record["warping"] & HELD)
        t.warping.observe(step, int(record["factor_step"]), int(record["iterations"]), held)
        self._set(t, t.warping)

    def begin_anew(self, t: Track) -> None:
        """Factors are made in another way from now on."""
        if t.warping is not None:
            t.warping.begin_anew()
            self._set(t, t.warping)

    def wait(self, t: Track) -> None:
        """While other factors are tried out: one thing at a time."""
        if t.warping is not None:
            self._engine.settings(t.body.index).hold = int(t.warping.decided)

    def observe_steps(self, r: NDArray[Any], others: NDArray[np.bool_]) -> None:
        """As `observe` of each, of records (steps, bodies) of all bodies; what follows is set once. others: solves with
        factors that are not like those in use, which are left out."""
        if not self._tracks:
            return
        r = r[:, self._indices]
        usable = telling(r) & ~others[:, self._indices]
        whole = usable.all(axis=0).tolist()
        columns = (r["step"] - 1, r["factor_step"], r["iterations"], r["warping"] & HELD != 0)
        rows = zip(*(column.T.tolist() for column in columns), strict=True)
        for k, (t, solves) in enumerate(zip(self._tracks, rows, strict=True)):
            if not whole[k]:
                chosen = np.flatnonzero(usable[:, k]).tolist()
                solves = tuple([column[i] for i in chosen] for column in solves)
            if solves[0]:
                assert t.warping is not None
                t.warping.observe_steps(*solves)
                self._set(t, t.warping)
            if others[-1, t.body.index]:
                self.wait(t)

    def _set(self, t: Track, warping: Warping) -> None:
        warping.consider(lambda: self._simulation.system.turned(t.body.nodes))
        self._engine.settings(t.body.index).hold = int(warping.hold)


def telling(record: Any) -> Any:
    """Whether a solve (or each of many) began and ended with a factor, which alone says something of the warp."""
    with_factor = (record["kind"] == Kind.CHOLESKY) & (record["asked"] == Kind.CHOLESKY)
    return with_factor & (record["probe"] == 0) & (record["fallbacks"] == 0)
