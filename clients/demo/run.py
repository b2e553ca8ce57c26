# SPDX-License-Identifier: MIT
"""The demonstration: a server with a worker simulates the creature, a client pushes and drags it, the log is read."""

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.grab import Grab
from clients.load_test.processes import free_endpoint, server
from clients.log.reader import Log

SCENE, BODY, NAME = Path("gallery/creature"), "creature", "demo"
HAND = (0.225, 0.283, 0.038)  # of the creature, at rest [m]
RADIUS = 0.035  # of what is grabbed of it [m]
ATTEMPTS = 10
PULL = (-0.1, 0.15, 0.2)  # how far the hand is dragged [m]
SECONDS = 2.0  # that it is dragged for
PATIENCE = 10.0  # s for positions to come


def run(record: Path | None) -> None:
    """Runs it, and prints what was done and what the log says. Raises ClientError where the server fails."""
    began, endpoint = time.monotonic(), free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        log = record or Path(folder) / "demo.mcap"
        with ExitStack() as closing:
            with _timed("a server and a worker start"):
                closing.enter_context(server(SCENE, log, NAME, endpoint, workers=1, device="cpu"))
            with _timed("a client pushes the creature's head, drags its hand and lets go"):
                client = closing.enter_context(Client(NAME, [endpoint]))
                _play(client)
        with _timed("the log is read"):
            shown = summary(log)
    Console().print(shown)
    print(f"{time.monotonic() - began:.1f} s in all" + (f"; the log: {record}" if record else ""))
    if find_spec("viser") is not None:
        print("drag it in a browser: sim-server gallery/creature --workers 1 --web")
    print("more scenes: sim-server --list")


def _play(client: Client) -> None:
    """Pushes the head, then moves the hand along a line and back, 50 times a second."""
    client.push(BODY, at="top", force=(0, 0, -12), radius=0.1, duration=0.2)
    time.sleep(0.6)
    rest = client.meshes()[BODY].rest
    grab, start = take_hand(client, int(np.linalg.norm(rest - HAND, axis=1).argmin()), lambda: _now(client))
    began = time.monotonic()
    while (part := (time.monotonic() - began) / SECONDS) < 1:
        grab.move(start + np.sin(np.pi * part) * np.array(PULL), wait=False)
        time.sleep(0.02)
    grab.release()
    time.sleep(0.6)


def take_hand(
    client: Client, node: int, positions: Callable[[], NDArray[np.float64]]
) -> tuple[Grab, NDArray[np.float64]]:
    """Grabs the creature's hand, and returns the grab and where it began [m]. node: its middle; positions: those of all
    nodes now. What moves fast on a slow machine is elsewhere when the command comes: then it is tried again, at last
    with the node that is nearest, wherever that is."""
    for radius in (*[RADIUS] * ATTEMPTS, 0.0):
        start = positions()[node]
        try:
            return client.grab(BODY, at=tuple(start), radius=radius, stiffness=400, max_force=100), start
        except BadInput:  # no node is there
            if not radius:
                raise
            time.sleep(0.1)
    raise AssertionError("the last attempt returns or raises")


def _now(client: Client) -> NDArray[np.float64]:
    """Returns the positions of its nodes now (n, 3) [m]. Raises ClientError if the server sends none."""
    states, end = client.states([BODY]), time.monotonic() + PATIENCE
    while time.monotonic() < end:
        for frame in states.newest():
            return frame.x
        time.sleep(0.01)
    raise ClientError(f"the server has sent no positions for {PATIENCE:g} s")


@contextmanager
def _timed(what: str) -> Iterator[None]:
    """Prints what is done, and how long it took."""
    print(f"{what} ...", end=" ", flush=True)
    began = time.monotonic()
    try:
        yield
    except BaseException:
        print()
        raise
    print(f"{time.monotonic() - began:.1f} s", flush=True)


def summary(log: Path) -> Table:
    """Returns a table of what a log says of the creature."""
    with Log(log) as read:
        data = read.scalars(BODY)
        rest = read.mesh(BODY, read.object_log(BODY).epochs[0]).rest
        farthest = max(float(np.linalg.norm(frame.x - rest, axis=1).max()) for frame in read.frames(BODY))
    iterations, aged = data["iterations"], data["factor_age"] >= 0
    milliseconds = 1e3 * data["step_seconds"][1:]
    table = Table("what the log says", "")
    table.add_row("steps", str(len(iterations)))
    table.add_row("farthest that a node was from its place at rest", f"{farthest:.3f} m")
    table.add_row("iterations with a factor, mean", f"{iterations[aged].mean():.1f}" if aged.any() else "none came")
    table.add_row("largest true residual", f"{data['residual'].max():.1e}")
    table.add_row("steps, p50 / p99", " / ".join(f"{v:.2f}" for v in np.percentile(milliseconds, [50, 99])) + " ms")
    return table
