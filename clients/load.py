# SPDX-License-Identifier: MIT
"""`sim-client load`: many bodies, many clients, and what becomes of the steps."""

from __future__ import annotations

import contextlib
import json
import random
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clients import load_scene
from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.frames import Mesh
from clients.load_processes import Drivers, free_endpoint, server
from clients.load_report import Looks, report
from clients.log import Log
from clients.progress import progress_bar
from clients.scalars import Columns, columns, row
from protocol import messages_pb2 as pb

ASKED = 5  # times that the server is asked for a fresh status before one of its last second will do
POLL = 0.05  # s between looks at the steps of a server that somebody else runs
DEVICES = ("auto", "cpu", "gpu")


@dataclass(frozen=True)
class Load:
    """What is asked for. connect: load this server instead of one of our own."""

    objects: int
    tets: tuple[int, int]
    clients: int
    rate: float  # commands a second of each client
    seconds: float
    workers: int
    seed: int
    device: str
    out: Path | None
    connect: list[str] | None
    server: str
    quiet: float = 3.0  # s that steps are watched before the clients begin

    def __post_init__(self) -> None:
        low, high = self.tets
        _within("--objects", self.objects, 1, 4096)
        _within("--clients", self.clients, 0, 256)
        _within("--rate", self.rate, 0.1, 2000.0)
        _within("--seconds", self.seconds, 0.5, 86_400.0)
        _within("--quiet", self.quiet, 0.0, 3600.0)
        _within("--workers", self.workers, 0, 64)
        _within("--seed", self.seed, 0, 2**63)
        if not 6 <= low <= high <= 100_000:
            raise BadInput(f"--tets {low}..{high}: allowed are two numbers of 6 to 100000, the smaller one first")
        if self.device not in DEVICES:
            raise BadInput(f"--device {self.device}: allowed are {', '.join(DEVICES)}")


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise BadInput(f"{name} {value:g}: allowed is {low:g} to {high:g}")


def span(text: str) -> tuple[int, int]:
    """Of "200..3000", or one number for both. Raises BadInput."""
    low, dots, high = text.partition("..")
    try:
        return int(low), int(high if dots else low)
    except ValueError:
        raise BadInput(f"--tets {text}: allowed is a number, or two as in 200..3000") from None


def run(load: Load) -> dict[str, Any]:
    """Carries it out; returns the report (load_report.py). Files are left in load.out alone."""
    with _folder(load.out) as folder:
        if load.connect is not None:
            return _on_a_running_server(load, load.connect)
        scene, log, endpoint = folder / "load.toml", folder / "load.mcap", free_endpoint()
        scene.write_text(load_scene.scene(load.objects, load.tets, load.seed))
        with server(scene, log, load.server, endpoint, load.workers, load.device):
            looks, clients, _ = _drive(load, [endpoint], watch=False)
        with Log(log) as recorded:  # it is whole once the server has ended
            steps = {name: recorded.scalars(name) for name in recorded.objects}
        return report(load, looks, clients, steps)


def _on_a_running_server(load: Load, connect: list[str]) -> dict[str, Any]:
    looks, clients, seen = _drive(load, connect, watch=True)
    rows: dict[str, list[tuple]] = {o.object: [] for o in looks[-1].objects}
    for step in seen:
        rows.setdefault(step.header.object, []).append(row(step))
    steps: dict[str, Columns] = {name: columns(found) for name, found in rows.items()}
    return report(load, looks, clients, steps)


def _drive(load: Load, connect: list[str], watch: bool) -> tuple[Looks, list[dict[str, Any]], list[pb.ObjectStep]]:
    """Looks at the status, what became of each client's commands, and the steps seen if asked for."""
    with Client(load.server, connect) as client:
        plans = plan(client.scene(), client.meshes(), load.clients, load.rate, load.seed)
        with Drivers(plans, load.server, connect, load.seconds) as drivers:
            batches = client.steps() if watch else None
            seen: list[pb.ObjectStep] = []

            def watched(seconds: float, what: str = "") -> pb.Status:
                deadline = time.monotonic() + seconds
                with progress_bar(what, seconds) as progress:
                    while (left := deadline - time.monotonic()) > 0:
                        time.sleep(min(left, POLL))
                        seen.extend(batches.new() if batches else [])
                        progress(seconds - left)
                return _status(client)

            before = watched(0)
            begun = watched(load.quiet, "without clients") if load.clients and load.quiet else before
            drivers.begin()
            return (before, begun, watched(load.seconds, "with clients")), drivers.reports(), seen


def _status(client: Client) -> pb.Status:
    """A fresh one; a server under load may drop the question now and then. Raises ClientError."""
    for _ in range(ASKED):
        with contextlib.suppress(BadInput, ClientError):
            client.command("status")
            return client.status()
    return client.status()


def plan(scene: pb.Scene, meshes: dict[str, Mesh], clients: int, rate: float, seed: int) -> list[dict[str, Any]]:
    """What each client does: every second one grabs, the others push, at the free end of a body that may be touched.

    Raises ClientError if there is none.
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
    """The node farthest from the fixed ones [m]; the first where none is fixed."""
    if not len(mesh.fixed):
        return mesh.rest[0].tolist()
    held = mesh.rest[mesh.fixed].mean(axis=0)
    return mesh.rest[int(np.linalg.norm(mesh.rest - held, axis=1).argmax())].tolist()


@contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """The folder asked for, or one that goes away."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="warpfactor-load-") as folder:
            yield Path(folder)
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"--out {out}: cannot be made: {error.strerror}") from None
    yield out
