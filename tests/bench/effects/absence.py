# SPDX-License-Identifier: MIT
"""How far a scene without an effect is from a build in which the effect's files do not exist.

Both run in processes of their own by copies of the packages, one of which lacks the files, and make batches of steps in
turns.
"""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.effects import known_effects
from tests.bench.effects.cost import Row
from tests.support.absent_effect import ROOT, ask, copy_packages, start
from tests.support.effect_samples import Cells, files_of, write_scene

FIRST = 20  # steps whose results are compared
BATCH = 5  # steps: short, so that what else runs on the machine slows both of a round
SAME = ("state", "launches", "texts", "modules")


def absence(name: str, cells: Cells, rounds: int, starts: int, whole: Path, folder: Path) -> Row:
    """Returns what differs. starts: pairs of processes; rounds: batches of each. whole: a copy of the packages."""
    scene, without = folder / f"{name}.toml", folder / "without"
    write_scene(scene, name, cells, listed=False)
    there = [f.name for f in (ROOT / "sim_server" / "effects").iterdir() if f.is_file()]
    removed = files_of(name, there, known_effects())
    copy_packages(without, removed)
    seconds: list[list[float]] = []
    for _ in range(starts):
        with _runs(scene, whole, without) as (reports, processes):
            for k in range(rounds):
                found = {p: ask(processes[p], str(BATCH)) / BATCH for p in ((0, 1) if k % 2 else (1, 0))}
                seconds.append([found[0], found[1]])
    shutil.rmtree(without)
    one, other = reports
    times = np.array(seconds)
    ratio = times[:, 0] / times[:, 1]
    low, high = np.percentile(ratio, [10, 90])
    left = {key: one["counted"][key] - other["counted"][key] for key in one["counted"]}
    return {
        "effect": name, "files taken away": len(removed), **{what: _same(one[what], other[what]) for what in SAME},
        "kernels": left["kernels"], "bytes": left["bytes"], "keys and channels": left["network"] + left["log"],
        "ms": 1e3 * float(np.median(times[:, 0])), "without the files, ms": 1e3 * float(np.median(times[:, 1])),
        "ratio": float(np.median(ratio)), "10 … 90 %": f"{low:.3f} … {high:.3f}",
    }  # fmt: skip


def _same(one: Any, other: Any) -> str:
    return "equal" if one == other else "DIFFERENT"


@contextmanager
def _runs(scene: Path, *folders: Path) -> Iterator[tuple[list[dict[str, Any]], list["subprocess.Popen[str]"]]]:
    """Processes that run a scene by the packages of folders, and their reports."""
    with ExitStack() as closing:
        processes = [start(folder, str(scene), str(FIRST)) for folder in folders]
        for process in processes:
            closing.callback(_end, process)
        yield [ask(process) for process in processes], processes


def _end(process: "subprocess.Popen[str]") -> None:
    assert process.stdin is not None
    process.stdin.close()
    process.wait()
