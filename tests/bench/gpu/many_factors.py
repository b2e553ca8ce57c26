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


def measure(beams: int, tets: int, device: str, worker: str, first: float, seconds: float) -> Row:
    """Measures for `seconds` after all beams have had two factors, or `first` seconds at most: when all have had one,
    some of these are old, as they waited for the others."""
    with tempfile.TemporaryDirectory() as folder:
        sim = Simulation.load(Problem(tets, beams=beams).write(Path(folder)), device=device)
    with Served(sim, worker) as served:
        driver, adopted, cpu = served.driver, [0], 0.0
        used_factors = driver.table.used
        for body in sim.world.bodies[1:]:
            served.link.announce(messages.topology(sim, body))
        driver.on_adopt.append(lambda factor: adopted.__setitem__(0, adopted[0] + 1))
        begun = time.monotonic()
        ready = float("nan")
        while used_factors.min() < 2 and time.monotonic() < begun + first:
            driver.pump()
            time.sleep(ROUND_PERIOD)
            if used_factors.min() and ready != ready:
                ready = time.monotonic() - begun
        without = int((used_factors == 0).sum())
        end, records, count = time.monotonic() + seconds, [], adopted[0]
        while time.monotonic() < end:
            busy = time.thread_time()
            found = driver.pump()
            cpu += time.thread_time() - busy
            records.append(found)
            time.sleep(ROUND_PERIOD)
        count = adopted[0] - count
        r = np.concatenate(records)
    used = r[r["factor_step"] >= 0]
    age = used["step"] - 1 - used["factor_step"]
    steps = len(r) / beams
    return {
        "beams": beams, "tets": tets, "worker": worker, "all have one after s": ready, "without": without,
        "factors/s": count / seconds, "service us/factor": 1e6 * cpu / max(count, 1), "steps/s": steps / seconds,
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
    parser.add_argument("--first", type=float, default=15.0)
    parser.add_argument("--seconds", type=float, default=4.0)
    o = parser.parse_args()
    print(json.dumps(measure(o.beams, o.tets, o.device, o.worker, o.first, o.seconds)), flush=True)


if __name__ == "__main__":
    main()
