# SPDX-License-Identifier: MIT
"""Factors a second that one worker makes for many small beams, and how old they are, as fast as steps go."""

import argparse
import json
import os
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.bench.gpu.problem import Problem

Row = dict[str, Any]
ROUND_PERIOD = 1e-3  # s, as in servers of all commits
PATIENCE = 120.0  # s for the first factor
LEAST = 1.0  # us a factor of a thread that is named
KEPT = ["body", "step", "factor_step", "iterations", "whole"]  # of records; all of them would fill memory


def thread_seconds() -> dict[str, float]:
    """Processor time [s] of each thread of this process so far, by name; those of one name, as the workers of OpenMP,
    together. In ticks of the system, 10 ms mostly."""
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    found: Counter[str] = Counter()
    for task in Path("/proc/self/task").iterdir():
        try:
            name, fields = (task / "comm").read_text().strip(), (task / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended meanwhile
            continue
        found[names.get(int(task.name), name)] += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


def measure(
    beams: int, tets: int, device: str, worker: str, first: float, seconds: float, schedule: str = "excess"
) -> Row:  # fmt: skip
    """Measures (`watched`) beams that are put back to their start every 100 steps."""
    from sim_server.recording import messages
    from sim_server.simulation import Simulation
    from tests.bench.gpu.served import Served

    with tempfile.TemporaryDirectory() as folder:
        scene = Problem(tets, beams=beams).write(Path(folder))
        sim = Simulation.load(scene, [f"solver.schedule={schedule}"], device=device)
    with Served(sim, worker) as served:
        for body in sim.world.bodies[1:]:
            served.link.announce(messages.topology(sim, body))
        table = served.driver.table
        row = watched(served.driver.pump, lambda: int(table.used.sum()), beams, first, seconds)
    return {"beams": beams, "tets": tets, "worker": worker, "schedule": schedule, **row}


def watched(
    pump: Callable[[], NDArray[Any]], adopted: Callable[[], int], beams: int, first: float, seconds: float
) -> Row:
    """Measures for `seconds`, once each beam has got two factors more since all had one: those before are old, as they
    waited for others, for kernels and for memory. Begins `first` seconds at most after a first factor came, for which
    a worker on a GPU may compile its kernels, as the server does those that build inverses. pump: what the thread
    beside the loop does in each round; returns records. adopted: returns how many factors the loop was given."""
    begun, came, cpu = time.monotonic(), float("nan"), 0.0
    used, uses = np.full(beams, -1), np.zeros(beams, int)  # step of the factor in use, and how many were since `ready`
    ready = float("nan")
    while uses.min() < 2 and time.monotonic() < (came + first if came == came else begun + PATIENCE):
        r = pump()
        time.sleep(ROUND_PERIOD)
        if adopted() and came != came:
            came = time.monotonic()
        for body, step in zip(*np.unique(np.stack([r["body"], r["factor_step"]]), axis=1), strict=True):
            uses[body] += step > used[body]
            used[body] = max(used[body], step)
        if uses.min() and ready != ready:
            ready, uses[:] = time.monotonic() - came, 0
    without = int((used < 0).sum())
    end, records, count, threads = time.monotonic() + seconds, [], adopted(), thread_seconds()
    while time.monotonic() < end:
        busy = time.thread_time()
        found = pump()
        cpu += time.thread_time() - busy
        records.append({name: found[name].copy() for name in KEPT})
        time.sleep(ROUND_PERIOD)
    count = adopted() - count
    spent = {name: 1e6 * (lasted - threads.get(name, 0.0)) / max(count, 1) for name, lasted in thread_seconds().items()}
    r = {name: np.concatenate([each[name] for each in records]) for name in KEPT}
    own = {name: column[r["factor_step"] >= 0] for name, column in r.items()}
    age = own["step"] - 1 - own["factor_step"]
    taken_up = len(np.unique(np.stack([own["body"], own["factor_step"]]), axis=1).T) - len(np.unique(own["body"]))
    return {
        "first factor after s": came - begun, "all use one after s": ready, "without": without,
        "factors/s": count / seconds, "used/s": taken_up / seconds,
        "service us/factor": 1e6 * cpu / max(count, 1), "steps/s": len(r["step"]) / beams / seconds,
        "us p50": 1e6 * float(np.percentile(r["whole"], 50)), "us p99": 1e6 * float(np.percentile(r["whole"], 99)),
        "factor age": float(age.mean()) if len(age) else None,
        "age p99": float(np.percentile(age, 99)) if len(age) else None, "oldest": int(age.max()) if len(age) else None,
        "iterations": float(r["iterations"].mean()),
        "threads us/factor": {name: round(each, 1) for name, each in sorted(spent.items()) if each >= LEAST},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("beams", type=int)
    parser.add_argument("tets", type=int)
    parser.add_argument("--device", default="gpu")
    parser.add_argument("--worker", default="gpu")
    parser.add_argument("--first", type=float, default=15.0, help="s after the first factor, at most")
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--schedule", default="excess", choices=("excess", "round_robin"))
    o = parser.parse_args()
    row = measure(o.beams, o.tets, o.device, o.worker, o.first, o.seconds, o.schedule)
    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
