# SPDX-License-Identifier: MIT
"""How long a server on a GPU goes without a factor, and how long clients wait for answers meanwhile.

A server of its own runs a beam in real time with one worker on the same GPU. A client asks for a status all the time
from when the server answers a command for the first time. Kernels and orders of elimination are in their caches if an
earlier run has put them there.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from clients.client import Client
from clients.errors import ClientError
from tests.bench.gpu.problem import Problem
from tests.ports import free_endpoint

PATIENCE = 90.0  # s

Row = dict[str, Any]


def measure(tets: int, first: str = "go", device: str = "gpu", worker: str = "gpu", seconds: float = 10.0) -> Row:
    """Runs a server for some seconds after its first answer, in real time.

    first: solver.first_factor. Returns: steps and seconds until a step used a factor; of the status queries the number,
    how many failed, and the longest [ms]; of the factors in the last half their number a second and mean age [steps]
    """
    with tempfile.TemporaryDirectory() as folder:
        scene, endpoint = Problem(tets).write(Path(folder)), free_endpoint()
        server = subprocess.Popen(
            [sys.executable, "-m", "sim_server", str(scene), "--device", device, "--realtime", "--workers", "1",
             "--worker-device", worker, "--listen", endpoint, "--set", f"solver.first_factor={first}"],
            stdout=sys.stderr,
        )  # fmt: skip
        try:
            return {"tets": tets, "first factor": first, **_watched(endpoint, seconds)}
        finally:
            server.terminate()
            server.wait(30)


def _watched(endpoint: str, seconds: float) -> Row:
    client = _client(endpoint)
    with client:
        _answering(client)
        begun, used, waits, failed, ages = time.monotonic(), None, [], 0, []
        factors: list[tuple[float, int]] = []
        step_of_use = -1
        while (now := time.monotonic()) < begun + seconds or (used is None and now < begun + PATIENCE):
            try:
                client.command("status")
                status = client.status()
            except ClientError:
                failed += 1
                continue
            finally:
                waits.append(time.monotonic() - now)
            beam = status.objects[0]
            if used is None and beam.factor_age_max >= 0:
                used, step_of_use = time.monotonic() - begun, int(status.step)
            factors.append((time.monotonic(), int(beam.factors_used)))
            if time.monotonic() > begun + seconds / 2 and beam.last.factor_age >= 0:
                ages.append(int(beam.last.factor_age))
            time.sleep(0.005)
        late = [f for f in factors if f[0] > begun + seconds / 2]
        rate = (late[-1][1] - late[0][1]) / (late[-1][0] - late[0][0]) if len(late) > 1 else 0.0
        milliseconds = 1e3 * np.array(waits)
        return {
            "in use s": used, "in use step": step_of_use, "queries": len(waits), "failed": failed,
            "answer ms p50": float(np.percentile(milliseconds, 50)), "answer ms max": float(milliseconds.max()),
            "factors/s": rate, "factor age": float(np.mean(ages)) if ages else None,
            "step ms p50": 1e3 * status.step_p50, "step ms p99": 1e3 * status.step_p99,
            "step ms max": 1e3 * status.step_max, "late steps": int(status.late_steps),
        }  # fmt: skip


def _answering(client: Client) -> None:
    """Waits until the server answers commands: until then it has not begun."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            client.command("status")
            return
        except ClientError:
            if time.monotonic() > end:
                raise


def _client(endpoint: str) -> Client:
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return Client(connect=[endpoint], timeout=1.0)
        except ClientError:
            if time.monotonic() > end:
                raise
            time.sleep(0.01)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tets", type=int, nargs="*", default=[98304])
    parser.add_argument("--first", default="go")
    parser.add_argument("--device", default="gpu")
    parser.add_argument("--worker", default="gpu")
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    for tets in options.tets:
        print(json.dumps(measure(tets, options.first, options.device, options.worker, options.seconds)), flush=True)


if __name__ == "__main__":
    main()
