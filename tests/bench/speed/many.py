# SPDX-License-Identifier: MIT
"""Factors a second of a real server of many small bodies, and how old they are, as its status tells them."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from clients.client import Client
from protocol import messages_pb2 as pb
from tests.bench.gpu.first_factor import PATIENCE, answering, client_of, ended
from tests.ports import free_endpoint

LOOKS = 8  # statuses in the time measured


def served(scene: Path, device: str, worker: str, seconds: float, first: float) -> dict[str, Any]:
    """Measures for `seconds` after all bodies have had two factors, or `first` seconds at most."""
    endpoint = free_endpoint()
    server = subprocess.Popen(
        [sys.executable, "-m", "sim_server", str(scene), "--device", device, "--free-run", "--workers", "1",
         "--worker-device", worker, "--listen", endpoint],
        stdout=sys.stderr,
    )  # fmt: skip
    try:
        with client_of(endpoint) as client:
            answering(client)
            return _watched(client, seconds, min(first, PATIENCE))
    finally:
        ended(server)


def _status(client: Client) -> pb.Status:
    client.command("status")
    return client.status()


def _watched(client: Client, seconds: float, first: float) -> dict[str, Any]:
    begun = time.monotonic()
    while min(body.factors_used for body in _status(client).objects) < 2 and time.monotonic() < begun + first:
        time.sleep(0.25)
    ready = time.monotonic() - begun
    start, before = time.monotonic(), _status(client)
    ages, host, after = list[int](), list[float](), before
    for k in range(LOOKS):
        time.sleep(max(0.0, start + seconds * (k + 1) / LOOKS - time.monotonic()))
        after = _status(client)
        host.append(1e6 * after.objects[0].last.cpu_seconds)
        ages += [body.factor_age for body in after.objects]
    lasted = time.monotonic() - start
    used = sum(body.factors_used for body in after.objects) - sum(body.factors_used for body in before.objects)
    aged = np.array([age for age in ages if age >= 0] or [np.nan])
    return {
        "ready s": ready, "without": sum(age < 0 for age in ages[-len(after.objects) :]), "factors/s": used / lasted,
        "steps/s": (after.step - before.step) / lasted, "step ms p50": 1e3 * after.step_p50,
        "host us": float(np.median(host)), "step ms p99": 1e3 * after.step_p99, "step ms max": 1e3 * after.step_max,
        "factor age": float(aged.mean()), "age p99": float(np.percentile(aged, 99)), "oldest": float(aged.max()),
    }  # fmt: skip
