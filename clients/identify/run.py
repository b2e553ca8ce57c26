# SPDX-License-Identifier: MIT
"""Runs the command: servers at tried values, the comparison with the curves, the overlay with what was found."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.accuracy.axes import SceneValues
from clients.accuracy.runs import Run, Task, run_point
from clients.accuracy.study import check_scene, probe
from clients.errors import BadInput
from clients.identify.curves import Curves, read
from clients.identify.fits import Fit, fits
from clients.identify.search import Found, Search
from clients.plan import overlay
from clients.progress import titled_progress_bar

MARK = "Parameters by sim-client identify"
MOST_RUNS = 10_000
TIMEOUT = 3600.0  # s, of a run


@dataclass(frozen=True)
class Question:
    """What is asked for: a scene, what was measured, what is looked for."""

    scene: Path
    curves: Curves
    fits: list[Fit]
    device: str


def identify(
    scene: Path, csv: Path, fit: list[str], runs: int, seed: int, to: Path | None, where: Path | None, device: str,
    as_json: bool,
) -> None:  # fmt: skip
    """Fits parameters, writes them as an overlay and prints them.

    to: overlay, None: SCENE.identified.toml beside the scene; where: file of runs, None: identify-SCENE.journal in this
    folder. Raises BadInput, ClientError.
    """
    check_scene(scene)
    if not 1 <= runs <= MOST_RUNS:
        raise BadInput(f"--runs {runs}: allowed is 1 to {MOST_RUNS:,}")
    question = Question(scene, read(csv), fits(fit), device)
    to = to or (scene if scene.is_file() else Path(scene.name)).with_suffix(".identified.toml")
    overlay.check_path(to, MARK)
    where = where or Path(f"identify-{scene.stem}.journal")
    probed, scene_digest = probe(scene, device)
    search = Search(where, question.fits, seed, _digest(question, scene_digest))
    try:
        with titled_progress_bar(runs) as progress:
            found = search.run(Attempts(question, probed), runs, lambda n, m: progress(n, f"{n} runs, misfit {m:.2g}"))
    except KeyboardInterrupt:
        print(f"sim-client: the runs made so far are in {where}; the same command goes on", file=sys.stderr)
        raise
    settings = {key: f"{value:.8g}" for key, value in found.values.items()}
    use = shlex.join(["sim-server", str(scene), "--set", f"@{to}"])
    overlay.write(to, settings, [MARK, *_lines(question, found), f"use: {use}"])
    if as_json:
        print(json.dumps({
            "values": found.values, "misfit": found.misfit, "runs": found.runs, "converged": found.converged,
            "overlay": str(to), "use": use, "journal": str(where),
        }))  # fmt: skip
        return
    for key, value in settings.items():
        print(f"{key} = {value}")
    print("\n".join(_lines(question, found)))
    print(f"wrote {to}:\n  {use}")


class Attempts:
    """Runs the scene at values, each time in a process of its own, and compares the run with the curves."""

    def __init__(self, question: Question, probed: Run):
        values = SceneValues(probed.scene, probed.device)
        self._question, self._workers = question, int(values.wants_workers({}))
        steps = max(1, math.ceil(question.curves.duration / values.dt - 1e-9))
        self._task = Task(question.scene, values.dt, steps * values.dt, values.dt, question.device)
        self._begun = False

    def __call__(self, values: dict[str, float]) -> NDArray[np.float64] | str:
        """Returns the residual of a run, or why there is none. Raises BadInput if the first one is refused."""
        curves = self._question.curves
        settings = {key: repr(value) for key, value in values.items()}
        run = run_point(self._task, settings, self._workers, TIMEOUT, read=curves.simulated)
        if run.status == "refused" and not self._begun:
            raise BadInput(run.reason)
        self._begun = True
        if run.status != "done":
            return f"{run.status}: {run.reason}"
        residual = curves.residual(run.read)
        return residual if np.isfinite(residual).all() else "the run has no finite values at all measured times"


def _digest(question: Question, scene: str) -> str:
    """Returns what names the scene, the curves and the bounds."""
    curves = question.curves
    parts = [scene, question.device, *(c.title for c in curves.columns), *map(repr, question.fits)]
    content = "\n".join(parts).encode() + curves.times.tobytes() + curves.values.tobytes()
    return hashlib.sha256(content).hexdigest()


def _lines(question: Question, found: Found) -> list[str]:
    """Returns how good it is, and what is to be known of it."""
    curves = question.curves
    words = "1 column" if len(curves.columns) == 1 else f"{len(curves.columns)} columns"
    lines = [
        f"misfit {found.misfit:.2g} of the largest value of each column (root mean square), "
        f"{found.runs} runs, {words} of {curves.path.name}"
    ]
    for fit in question.fits:
        if min(share := fit.share(found.values[fit.key]), 1 - share) < 1e-3:
            lines.append(f"{fit.key} is at a bound of {fit.low:g}:{fit.high:g}: wider ones may fit better")
    if not found.converged:
        lines.append("further runs may fit better: the same command with more --runs goes on")
    return lines
