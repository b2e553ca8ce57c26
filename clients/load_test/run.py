# SPDX-License-Identifier: MIT
"""Runs a load test: starts or finds a server, lets clients push and grab its bodies, and reports its steps."""

from __future__ import annotations

import contextlib
import json
import random
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.load_test.options import LoadOptions
from clients.load_test.processes import ClientProcesses, free_endpoint, server
from clients.load_test.report import StatusSamples, report
from clients.load_test.scene import scene_text
from clients.log.frames import Mesh
from clients.log.reader import Log
from clients.log.scalars import Columns, columns, row
from clients.progress import progress_bar
from protocol import messages_pb2 as pb

STATUS_ATTEMPTS = 5  # requests for a fresh status before one of the last second is taken
POLL = 0.05  # s between readings of the steps of a running server


def run(load: LoadOptions) -> dict[str, Any]:
    """Runs the load test and returns its report (report.py). Files are left in load.out alone."""
    with _folder(load.out) as folder:
        if load.connect is not None:
            return _on_running_server(load, load.connect)
        scene, log, endpoint = folder / "load.toml", folder / "load.mcap", free_endpoint()
        scene.write_text(scene_text(load.objects, load.tets, load.seed))
        with server(scene, log, load.server, endpoint, load.workers, load.device):
            samples, clients, _ = _drive(load, [endpoint], watch=False)
        with Log(log) as recorded:  # it is whole once the server has ended
            steps = {name: recorded.scalars(name) for name in recorded.objects}
        return report(load, samples, clients, steps)


def _on_running_server(load: LoadOptions, connect: list[str]) -> dict[str, Any]:
    samples, clients, seen = _drive(load, connect, watch=True)
    rows: dict[str, list[tuple]] = {o.object: [] for o in samples.end.objects}
    for step in seen:
        rows.setdefault(step.header.object, []).append(row(step))
    steps: dict[str, Columns] = {name: columns(found) for name, found in rows.items()}
    return report(load, samples, clients, steps)


def _drive(
    load: LoadOptions, connect: list[str], watch: bool
) -> tuple[StatusSamples, list[dict[str, Any]], list[pb.ObjectStep]]:
    """Returns samples of the status, the report of each client and, if `watch` is set, the steps received."""
    with Client(load.server, connect) as client:
        plans = plan(client.scene(), client.meshes(), load.clients, load.rate, load.seed)
        with ClientProcesses(plans, load.server, connect, load.seconds) as processes:
            batches = client.steps() if watch else None
            seen: list[pb.ObjectStep] = []

            def wait(seconds: float, what: str = "") -> pb.Status:
                deadline = time.monotonic() + seconds
                with progress_bar(what, seconds) as progress:
                    while (left := deadline - time.monotonic()) > 0:
                        time.sleep(min(left, POLL))
                        seen.extend(batches.new() if batches else [])
                        progress(seconds - left)
                return _status(client)

            before = wait(0)
            begin = wait(load.quiet, "without clients") if load.clients and load.quiet else before
            processes.begin()
            end = wait(load.seconds, "with clients")
            return StatusSamples(before, begin, end), processes.reports(), seen


def _status(client: Client) -> pb.Status:
    """Returns a fresh status; a server under load may drop some requests. Raises ClientError."""
    for _ in range(STATUS_ATTEMPTS):
        with contextlib.suppress(BadInput, ClientError):
            client.command("status")
            return client.status()
    return client.status()


def plan(scene: pb.Scene, meshes: dict[str, Mesh], clients: int, rate: float, seed: int) -> list[dict[str, Any]]:
    """Plans what each client does: every second one grabs, the others push, at the free end of a body with `touch`.

    Raises ClientError if there is no such body.
    """
    forces = {
        found["name"]: float(found["effects"]["touch"]["max_force"])
        for found in json.loads(scene.resolved)["object"]
        if "touch" in found.get("effects", {})
    }
    if clients and not forces:
        raise ClientError("no object of this server lists the effect touch: --clients 0 only looks on")
    draw, names = random.Random(f"{seed} clients"), sorted(forces)
    plans = []
    for number in range(clients):
        name = names[number % len(names)]
        mesh = meshes[name]
        plans.append({
            "object": name, "at": free_end(mesh), "force": forces[name], "rate": rate,
            "reach": 0.1 * float(np.ptp(mesh.rest, axis=0).max()), "grabs": number // len(names) % 2 == number % 2,
            "seed": draw.randrange(2**32),
        })  # fmt: skip
    return plans


def free_end(mesh: Mesh) -> list[float]:
    """Returns the position [m] of the node farthest from the fixed ones; of the first node where none is fixed."""
    if not len(mesh.fixed):
        return mesh.rest[0].tolist()
    held = mesh.rest[mesh.fixed].mean(axis=0)
    return mesh.rest[int(np.linalg.norm(mesh.rest - held, axis=1).argmax())].tolist()


@contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """Yields the folder `out`, or a temporary one."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="warpfactor-load-") as folder:
            yield Path(folder)
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"--out {out}: cannot be made: {error.strerror}") from None
    yield out
