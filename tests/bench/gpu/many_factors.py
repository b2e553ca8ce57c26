# SPDX-License-Identifier: MIT
"""Factors a second that one worker makes for many small beams, and how old they are, as fast as steps go."""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.recording import messages
from sim_server.service.service import ROUND_PERIOD
from sim_server.simulation import Simulation
from tests.bench.gpu.problem import Problem
from tests.bench.gpu.served import Served

Row = dict[str, Any]
PATIENCE = 120.0  # s for the first factor


def measure(
    beams: int, tets: int, device: str, worker: str, first: float, seconds: float, schedule: str = "excess"
) -> Row:  # fmt: skip
    """Measures for `seconds`, from when all beams use their second factor: some of the first ones are old, as they
    waited for the others. Begins `first` seconds at most after a first factor came, for which a worker on a GPU may
    compile its kernels, as the server does those that build inverses."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Problem(tets, beams=beams).write(Path(folder))
        sim = Simulation.load(scene, [f"solver.schedule={schedule}"], device=device)
    with Served(sim, worker) as served:
        driver, adopted, cpu = served.driver, [0], 0.0
        for body in sim.world.bodies[1:]:
            served.link.announce(messages.topology(sim, body))
        driver.on_adopt.append(lambda factor: adopted.__setitem__(0, adopted[0] + 1))
        begun, came = time.monotonic(), float("nan")
        used, uses = np.full(beams, -1), np.zeros(beams, int)  # step of the factor in use, and how many were
        ready = float("nan")
        while uses.min() < 2 and time.monotonic() < (came + first if came == came else begun + PATIENCE):
            r = driver.pump()
            time.sleep(ROUND_PERIOD)
            if adopted[0] and came != came:
                came = time.monotonic()
            for body, step in zip(*np.unique(np.stack([r["body"], r["factor_step"]]), axis=1), strict=True):
                uses[body] += step > used[body]
                used[body] = max(used[body], step)
            if uses.min() and ready != ready:
                ready = time.monotonic() - came
        without = int((uses == 0).sum())
        end, records, count = time.monotonic() + seconds, [], adopted[0]
        while time.monotonic() < end:
            busy = time.thread_time()
            found = driver.pump()
            cpu += time.thread_time() - busy
            records.append(found)
            time.sleep(ROUND_PERIOD)
        count = adopted[0] - count
        r = np.concatenate(records)
    own = r[r["factor_step"] >= 0]
    age = own["step"] - 1 - own["factor_step"]
    taken_up = len(np.unique(np.stack([own["body"], own["factor_step"]]), axis=1).T) - len(np.unique(own["body"]))
    steps = len(r) / beams
    return {
        "beams": beams, "tets": tets, "worker": worker, "schedule": schedule, "first factor after s": came - begun,
        "all use one after s": ready, "without": without,
        "factors/s": count / seconds, "used/s": taken_up / seconds,
        "service us/factor": 1e6 * cpu / max(count, 1), "steps/s": steps / seconds,
        "us p50": 1e6 * float(np.percentile(r["whole"], 50)), "us p99": 1e6 * float(np.percentile(r["whole"], 99)),
        "factor age": float(age.mean()) if len(age) else None,
        "age p99": float(np.percentile(age, 99)) if len(age) else None, "oldest": int(age.max()) if len(age) else None,
        "iterations": float(r["iterations"].mean()),
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
