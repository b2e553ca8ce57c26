# SPDX-License-Identifier: MIT
"""Logs of earlier versions are still read and repeated: they hold the wire format, the scene format and the physics of
the version that recorded them (data/README.md says how they were made)."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.compiler import compiler
from sim_server.replay.log import Recording
from sim_server.replay.report import Comparison, Pair
from sim_server.replay.run import Replay

DATA = Path(__file__).parent / "data"
STEPS, EVERY, OBJECTS = 120, 5, 2
TOLERANCE = 1e-6  # m; solves were recorded with a relative tolerance of 1e-10
EXACT = ("status", "kind", "factor_step", "fallbacks", "linearizations")  # what rounding must not change


def machine() -> dict[str, str]:
    """What the bits of a run depend on beside its log: the compiler and the instructions of the processor."""
    version = subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True).stdout
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    flags = next(line for line in lines if line.startswith(("flags", "Features"))).split(":")[1].split()
    digest = hashlib.sha256(" ".join(sorted(flags)).encode()).hexdigest()[:16]
    return {"compiler": version.splitlines()[0], "processor": digest}


class Differences(Comparison):
    """Collects by how much solves and frames differ, too.

    more, fewer: iterations than recorded, at most; distance [m]: largest difference of positions; exact: entries of
    EXACT that differ
    """

    def __init__(self, recording: Recording):
        super().__init__(recording)
        self.more, self.fewer, self.distance = 0, 0, 0.0
        self.exact: list[tuple[int, str]] = []

    def solves(self, records: NDArray[Any], rows: list[Any]) -> None:
        super().solves(records, rows)
        for record, row in zip(records, rows, strict=True):
            difference = int(record["iterations"]) - int(row["iterations"])
            self.more, self.fewer = max(self.more, difference), max(self.fewer, -difference)
            self.exact += [(int(row["step"]), name) for name in EXACT if record[name] != row[name]]

    def frame(self, step: int, name: str, recorded: Pair, now: Pair) -> None:
        super().frame(step, name, recorded, now)
        self.distance = max(self.distance, float(np.linalg.norm(recorded[0] - now[0], axis=1).max()))


@pytest.mark.parametrize("log", sorted(DATA.glob("*.mcap")), ids=lambda path: path.stem)
def test_a_log_of_an_earlier_version_is_repeated(log: Path) -> None:
    """The same bit for bit where it was recorded; elsewhere the last digits of sums differ, and with them iterations
    by one. Where solves start from a guess (mechanics/guess.py) that did not when they were recorded they take fewer
    iterations, to the same tolerance. If a change is meant to alter bits, record logs anew (data/README.md) beside
    these."""
    with Recording(log) as recording:
        replay = Replay(recording)
        found = Differences(recording)
        found.notes = replay.compared.notes
        replay.compared = found
        replay.run()
    assert not recording.notes and len(recording.touch) > 5
    assert (recording.steps, found.solves_compared) == (STEPS, OBJECTS * STEPS)
    assert found.frames_compared == OBJECTS * (STEPS // EVERY + 1)
    recorded_on = json.loads((DATA / "recorded_on.json").read_text())[log.stem]
    recorded_here = machine() == {name: recorded_on[name] for name in ("compiler", "processor")}
    guessed = replay.simulation.system.guess is not None and not recorded_on["guess"]
    other_build = [note for note in found.notes if note.startswith("another build")]
    assert not guessed or any("iterations, and positions within the tolerance" in note for note in other_build)
    if recorded_here and not guessed and not any("here by another" in note for note in found.notes):
        assert found.same, found.lines()
    assert not found.exact, found.lines()
    assert found.more <= 1 and (guessed or found.fewer <= 1), found.lines()
    assert found.distance < TOLERANCE, found.lines()


def test_a_difference_is_seen() -> None:
    """A tenth of a newton more: the comparison above fails."""
    with Recording(DATA / "factorized_in_the_step.mcap") as recording:
        for taken in recording.touch:
            for interaction in taken.interactions:
                interaction.force.x += 0.1 if interaction.kind == "push" else 0.0
        replay = Replay(recording)
        found = replay.compared = Differences(recording)
        replay.run()
    assert not found.same and found.distance > TOLERANCE


def test_without_the_library_of_the_log_another_makes_the_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("sksparse", "sksparse.cholmod"):
        monkeypatch.setitem(sys.modules, module, None)
    with Recording(DATA / "factorized_in_the_step.mcap") as recording:
        replay = Replay(recording)
        found = replay.compared
        replay.run()
    assert any("made by cholmod" in note and "here by another" in note for note in found.notes)
    assert found.solves_compared == OBJECTS * STEPS and found.largest and found.largest["distance"] < TOLERANCE
