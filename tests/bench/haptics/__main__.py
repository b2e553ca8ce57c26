# SPDX-License-Identifier: MIT
"""How late forces are that a haptic client gets at 1 kHz: server, worker and `sim-client haptics` as processes."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from clients.client import Client
from clients.errors import ClientError
from tests.bench.harness.report import ROOT, Report, plots
from tests.ports import free_endpoint

SCENE = ROOT / "deploy" / "scenes" / "haptics.toml"
PATIENCE = 60.0  # s for the server, and for its first factor
COLUMNS = (
    "dt ms", "delay p50 ms", "delay p99 ms", "delay max ms", "delay p50 steps", "delay p99 steps", "delay max steps",
    "jitter p50 ms", "jitter p99 ms", "jitter max ms", "steps a second", "missing steps", "moves", "late periods",
    "late steps", "step p50 ms", "step p99 ms",
)  # fmt: skip
EXPLAINED = (
    "A scripted hand presses the tool of deploy/scenes/haptics.toml into soft tissue of 2304 tetrahedra and lifts it "
    "again, through a virtual coupling that is renewed each millisecond. Server, one worker and client are processes "
    "of one host, joined by loopback.",
    "*delay*: from a move that is sent to the first force that comes of a step made with it, or with a newer one; in "
    "milliseconds, and in steps since the newest one that the client knew when it sent the move. *jitter*: how far the "
    "time between two steps that come differs from that between them in the simulation. *late periods*: of the client, "
    "by more than half a period. *late steps*: of the server, by more than a time step. The head of the page has the "
    "load of the machine: delays far above the time step are waits for a processor.",
)


@contextmanager
def server(dt: float, folder: Path) -> Iterator[tuple[Client, str]]:
    """A server in real time with a worker whose factor is in use, and a client of it."""
    endpoint = free_endpoint()
    words = [str(SCENE), "--set", f"dt={dt}", "--listen", endpoint, "--workers", "1", "--device", "cpu", "--quiet"]
    with (folder / "server.log").open("ab") as out:
        process = subprocess.Popen([sys.executable, "-m", "sim_server", *words], cwd=ROOT, stdout=out, stderr=out)
    try:
        with _client(endpoint) as client:
            end = time.monotonic() + PATIENCE
            while not client.status().objects[0].factors_used and time.monotonic() < end:
                time.sleep(0.1)
            yield client, endpoint
            client.stop()
        process.wait(PATIENCE)
    finally:
        process.kill()
        process.wait()


def _client(endpoint: str) -> Client:
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return Client(connect=[endpoint])
        except ClientError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


def measured(dt: float, seconds: float) -> dict[str, Any]:
    """One row."""
    with tempfile.TemporaryDirectory(prefix="warpfactor-haptics-") as folder, server(dt, Path(folder)) as (client, at):
        late = client.status(fresh=True).late_steps
        words = ["haptics", "tool", "--press", "0", "-0.025", "0", "--seconds", str(seconds), "--connect", at, "--json"]
        command = [sys.executable, "-m", "clients", *words]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=seconds + PATIENCE)
        if done.returncode:
            raise RuntimeError(done.stdout + done.stderr)
        found, status = json.loads(done.stdout), client.status(fresh=True)
    row: dict[str, Any] = {"dt ms": 1e3 * dt}
    for what, key, unit in (("delay", "ms", "ms"), ("delay", "steps_late", "steps"), ("jitter", "jitter_ms", "ms")):
        row |= {f"{what} {p} {unit}": found[f"{key}_{p}"] for p in ("p50", "p99", "max")}
    return row | {
        "steps a second": found["steps_per_second"], "missing steps": found["missing"], "moves": found["moves"],
        "late periods": found["late_periods"], "late steps": status.late_steps - late,
        "step p50 ms": 1e3 * status.step_p50, "step p99 ms": 1e3 * status.step_p99,
    }  # fmt: skip


def picture(rows: list[dict[str, Any]]) -> Any:
    """Bars of the delays, in milliseconds and in steps."""
    figure, axes = plots().subplots(1, 2, figsize=(8, 3), layout="constrained")
    names = [f"{row['dt ms']:g} ms" for row in rows]
    for axis, unit in zip(axes, ("ms", "steps"), strict=True):
        for k, part in enumerate(("p50", "p99")):
            places = [place + 0.4 * k - 0.2 for place in range(len(rows))]
            axis.bar(places, [row[f"delay {part} {unit}"] for row in rows], 0.4, label=part)
        axis.set_xticks(range(len(rows)), names)
        axis.set_xlabel("time step")
        axis.set_ylabel(f"delay [{unit}]")
        axis.legend()
    return figure


def main(
    seconds: Annotated[float, typer.Option(min=1.0, help="Of each run")] = 20.0,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/haptics]")] = None,
) -> None:
    """From a move to the force that knows it, at time steps of 2 and 10 ms."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    seconds = 3.0 if quick else seconds
    report = Report("haptics", "How late forces are", {"seconds": seconds}, out, quick)
    rows = []
    for dt in (0.002, 0.01):
        rows.append(measured(dt, seconds))
        print(f"dt {1e3 * dt:g} ms done", flush=True)
    report.say(*EXPLAINED)
    report.table(rows, COLUMNS)
    report.figure(picture(rows), "haptics.png", "Delay of forces at each time step.")
    report.remember(rows, ("dt ms",), ("delay p50 ms", "delay p99 ms"))
    report.data["rows"] = rows
    report.write()


if __name__ == "__main__":
    typer.run(main)
