# SPDX-License-Identifier: MIT
"""How long a server on a GPU goes without a factor, how old factors are later, and how long clients wait for answers.

A server of its own runs a beam in real time with one worker on the same GPU. A client asks for a status all the time
from when the server answers a command for the first time. Kernels, orders of elimination and patterns of factors are in
their caches if an earlier run has put them there: `new in caches` tells how many files this run has made. A short time
step tells more closely after what time a factor is in use.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clients.client import Client
from clients.errors import ClientError
from protocol import messages_pb2 as pb
from tests.bench.gpu.problem import Problem
from tests.ports import free_endpoint

PATIENCE = 90.0  # s

Row = dict[str, Any]


def measure(
    tets: int, first: str = "go", device: str = "gpu", worker: str = "gpu", seconds: float = 10.0, dt: float = 0.03
) -> Row:  # fmt: skip
    """Runs a server for some seconds after its first answer, in real time; at least half of them with a factor.

    first: solver.first_factor. Returns: files that were new in the caches; seconds from the start of the process to the
    first answer; steps and seconds until a step used a factor; of the status queries the number, how many failed, and
    the longest [ms]; of the factors in the last half their number a second, mean age [steps] and time from the step of
    the matrix to the first step that uses it [ms]; times of the steps in that half [ms];
    matrices and factors that stayed in memory of the device
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = Problem(tets, dt=dt).write(Path(folder))
        row = served(scene, first, device, worker, seconds, dt)
    return {"tets": tets, "worker": worker, "dt": dt, "first factor": first, **row}


def served(scene: Path, first: str, device: str, worker: str, seconds: float, dt: float) -> Row:
    """The same for a scene of one body in a file. first: "" for servers that know no other than to go."""
    endpoint, chosen = free_endpoint(), ["--set", f"solver.first_factor={first}"] if first else []
    kept, started = _kept(), time.monotonic()
    server = subprocess.Popen(
        [sys.executable, "-m", "sim_server", str(scene), "--device", device, "--realtime", "--workers", "1",
         "--worker-device", worker, "--listen", endpoint, *chosen],
        stdout=sys.stderr,
    )  # fmt: skip
    try:
        row = _watched(endpoint, seconds, dt, started)
        return {"new in caches": len(_kept() - kept), **row}
    finally:
        ended(server)


def ended(server: subprocess.Popen[bytes], patience: float = 30.0) -> None:
    """Ends a server; kills it where it does not end within `patience` seconds, as older ones that plan an inverse."""
    server.terminate()
    try:
        server.wait(patience)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()


def _kept() -> set[Path]:
    """Returns the files in the caches of compiled kernels, orders and patterns, of a checkout of any commit."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    ours = Path(os.environ.get("WARPFACTOR_CACHE") or home / "warpfactor")
    kernels = Path(os.environ.get("CUPY_CACHE_DIR") or Path.home() / ".cupy" / "kernel_cache")
    return {path for folder in (ours, kernels) for path in folder.rglob("*") if path.is_file()}


def _watched(endpoint: str, seconds: float, dt: float, started: float) -> Row:
    client = client_of(endpoint)
    with client:
        answering(client)
        begun, used, waits, failed = time.monotonic(), None, [], 0
        half = begun + seconds / 2
        subscribed, steps = client.steps(), list[pb.ObjectStep]()
        step_of_use = -1
        while (now := time.monotonic()) < begun + (PATIENCE if used is None else max(seconds, used + seconds / 2)):
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
            new = subscribed.new()
            steps += new if time.monotonic() > half else []
            time.sleep(0.005)
        milliseconds = 1e3 * np.array(waits)
        return {
            "answers after s": begun - started,
            "in use s": used, "in use step": step_of_use, "queries": len(waits), "failed": failed,
            "answer ms p50": float(np.percentile(milliseconds, 50)), "answer ms max": float(milliseconds.max()),
            **_of_steps(steps, dt), "late steps": int(status.late_steps),
            "arrays on device": int(getattr(status, "bulk_on_device", 0)),  # 0 of older checkouts
        }  # fmt: skip


def _of_steps(steps: Sequence[pb.ObjectStep], dt: float) -> Row:
    """Sums up steps that follow one another in real time, so that their numbers tell when they began."""
    aged = [step for step in steps if step.factor_age >= 0]
    if not aged:
        return {}
    first = {step.factor_step: step for step in reversed(aged)}
    new = [1e3 * dt * step.factor_age for step in list(first.values())[::-1][1:]]
    whole = 1e3 * np.array([step.step_seconds for step in aged])
    p50, p99 = np.percentile(whole, [50, 99]).tolist()
    return {
        "factors/s": len(new) / (dt * len(aged)), "factor age": float(np.mean([step.factor_age for step in aged])),
        "in use after ms": float(np.median(new)) if new else None, "at most ms": max(new, default=None),
        "step ms p50": p50, "step ms p99": p99, "step ms max": float(whole.max()),
    }  # fmt: skip


def answering(client: Client) -> None:
    """Waits until the server answers commands: until then it has not begun."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            client.command("status")
            return
        except ClientError:
            if time.monotonic() > end:
                raise


def client_of(endpoint: str) -> Client:
    """Connects to a server that may still be starting."""
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
    parser.add_argument("--dt", type=float, default=0.03, help="[s]")
    options = parser.parse_args()
    for tets in options.tets:
        row = measure(tets, options.first, options.device, options.worker, options.seconds, options.dt)
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
