# SPDX-License-Identifier: MIT
"""A body of any size as a service: a server with a local worker, free-running; a line for each step that was seen.

`python -m tests.bench.factors.service --cells 35 35 140 --seconds 1600`: the beam of 1,029,000 tets of the GPU's
benchmark, whose factor travels in parts; on two cores it comes after about a quarter of an hour, and server and worker
take 10 GB. Of each step: iterations, age of the factor [steps], time [s], and the memory of server and worker [GiB].
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from clients.client import Client
from clients.errors import ClientError
from tests.bench.gpu.problem import BARS, Problem
from tests.ports import free_endpoint

Row = dict[str, Any]


def steps(cells: Sequence[int], seconds: float, options: Sequence[str] = ()) -> Iterator[Row]:
    """Yields rows of steps for so many seconds. cells: of the bar. options: of sim-server"""
    with tempfile.TemporaryDirectory() as folder:
        usual = next(iter(BARS))
        scene = Problem(usual).write(Path(folder))
        endpoint = free_endpoint()
        server = subprocess.Popen(
            [sys.executable, "-m", "sim_server", str(scene), "--device", "cpu", "--free-run", "--workers", "1",
             "--listen", endpoint, "--set", f"object.beam0.mesh.bar={list(cells)}", "--set", "solver.first_factor=go",
             *options],
            stdout=sys.stderr, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        try:
            yield from _watched(endpoint, server, seconds)
        finally:
            server.terminate()
            server.wait(60)


def _watched(endpoint: str, server: "subprocess.Popen[bytes]", seconds: float) -> Iterator[Row]:
    begun, seen, client = time.monotonic(), 0, None
    while time.monotonic() < begun + seconds and server.poll() is None:
        time.sleep(0.2)
        try:
            client = client or Client(connect=[endpoint], timeout=5.0)
            status = client.status()
        except ClientError:
            continue
        if status.step == seen:
            continue
        seen, body = status.step, status.objects[0]
        processes = {"server": server.pid, **{w.worker: w.pid for w in status.local_workers}}
        yield {
            "s": round(time.monotonic() - begun, 1), "step": seen, "iterations": body.last.iterations,
            "age": body.last.factor_age, "step s": round(body.last.step_seconds, 2), "factors": body.factors_used,
            **{f"{name} GiB": round(_resident(pid), 2) for name, pid in processes.items()},
        }  # fmt: skip
    if client is not None:
        client.close()


def _resident(pid: int) -> float:
    """Memory of a process [GiB]; 0: it is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs=3, default=BARS[98304], help="of the bar, six tets each")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("options", nargs="*", help="of sim-server, behind --")
    o = parser.parse_args()
    for row in steps(o.cells, o.seconds, o.options):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
