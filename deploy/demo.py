# SPDX-License-Identifier: MIT
"""The demonstration of `deploy/run demo`: a creature that can be dragged, in a browser, or else in a film.

Every process is started as a user would start it: sim-server with one precond-worker, then sim-client. On a machine
with a display a page opens on which the creature is dragged with the mouse, until Ctrl-C; nothing is recorded.
Elsewhere a client pushes and drags it; what that leaves lies under out/demo: the log (creature.mcap), a film
(creature.gif), a rerun recording (creature.rrd), a picture (creature.png) and the arrays (creature.npz).
"""

import importlib.util
import os
import socket
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from clients.client import Client
from clients.demo.run import HAND, take_hand
from clients.errors import ClientError
from clients.log.frames import Frame
from clients.log.reader import Log
from clients.subscriptions import States

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "out" / "demo"
SCENE = "gallery/creature"
STEPS = 340  # of 20 ms each
ENDPOINT = "tcp/127.0.0.1:7451"  # not the default one: a server of the user's may be running there
PAGE = 8085  # port of the page, not the default one
PUSH_AT, GRAB_AT, RELEASE_AT = 60, 125, 265  # steps
FILM = 2.3, 6.5  # s of simulation: first and last picture
WAY = np.array(
    [(0, 0, 0), (0.1, 0.16, 0.1), (-0.2, 0.18, 0.24), (-0.12, -0.14, 0.22), (0.12, -0.04, 0.04)]
)  # of the hand that is dragged [m]

TEXT_BROWSERS = {"www-browser", "links", "links2", "elinks", "lynx", "w3m"}  # show no page of WebGL
MADE = {"film": "gif", "recording": "rrd", "picture": "png", "arrays": "npz"}  # suffixes of what the log becomes

WAYS_ON = """look at it: .venv/bin/sim-client view out/demo/creature.mcap
drag it: .venv/bin/sim-server gallery/creature --workers 1 --web, then http://127.0.0.1:8080 in a browser
  (on another machine: there, first, ssh -L 8080:127.0.0.1:8080 HOST, where HOST is this one)"""
console = Console()


def tool(package: str, *arguments: str) -> list[str]:
    """Returns the command line of one of the programs."""
    return [sys.executable, "-m", package, *arguments]


@contextmanager
def shown(what: str) -> Iterator[None]:
    """Prints what is being done and for how long: on a terminal in a line that is removed, elsewhere once before."""
    if not console.is_terminal:
        console.print(f"{what} ...")
        yield
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        progress.add_task(what, total=None)
        yield


def sim_client(what: str, *arguments: str) -> None:
    """Runs sim-client, which must succeed. what: shown meanwhile."""
    with shown(what):
        result = subprocess.run(tool("clients", *arguments), capture_output=True, text=True, cwd=ROOT)
    if result.returncode:
        raise SystemExit(f"sim-client {' '.join(arguments)} failed:\n{result.stdout}{result.stderr}")


def connected(server: "subprocess.Popen[bytes]") -> Client:
    """Returns a client of the server, once it is up."""
    while True:
        try:
            return Client(connect=[ENDPOINT])
        except ClientError:
            if server.poll() is not None:
                raise


def play(server: "subprocess.Popen[bytes]") -> None:
    """Pushes the creature's head, later drags its hand about and lets go; shows the progress of the run."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with connected(server) as client, Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("simulating in real time", total=STEPS)
        hand = int(np.linalg.norm(client.meshes()["creature"].rest - HAND, axis=1).argmin())
        states, pushed, grab, start = client.states(["creature"]), False, None, np.zeros(3)
        while server.poll() is None:
            time.sleep(0.02)
            for frame in states.newest():
                progress.update(task, completed=frame.step)
                if frame.step >= PUSH_AT and not pushed:
                    pushed = True
                    taken = client.push("creature", at="top", force=(0, 0, -12), radius=0.1, duration=0.2)
                    progress.console.print(f"step {frame.step}: a client pushes {taken.nodes} nodes of the head")
                if GRAB_AT <= frame.step < RELEASE_AT and grab is None:
                    grab, start = take_hand(client, hand, partial(newest, states, frame))
                    progress.console.print(f"step {frame.step}: a client takes its hand and drags it about")
                if grab is not None and frame.step < RELEASE_AT:
                    grab.move(start + way((frame.step - GRAB_AT) / (RELEASE_AT - GRAB_AT)))
                elif grab is not None and not grab.released:
                    grab.release()
        progress.update(task, completed=STEPS)


def newest(states: States, known: Frame) -> NDArray[np.float64]:
    """Returns the positions of the newest frame that has come, else of one that is known [m]."""
    return [known, *states.newest()][-1].x


def way(part: float) -> NDArray[np.float64]:
    """Returns how far the hand is dragged at a part of the time, from 0 to 1 [m]: smooth from place to place of WAY."""
    at = min(max(part, 0.0), 1.0) * (len(WAY) - 1)
    k = min(int(at), len(WAY) - 2)
    s = at - k
    s = s * s * (3 - 2 * s)
    there: NDArray[np.float64] = (1 - s) * WAY[k] + s * WAY[k + 1]
    return there


def summary(arrays: Path) -> Table:
    """Makes a table of the run from its log."""
    data = np.load(arrays)
    iterations, age = data["scalars/iterations"], data["scalars/factor_age"]
    milliseconds, residual = 1e3 * data["scalars/step_seconds"], data["scalars/residual"]
    without, with_factor = iterations[age < 0], iterations[age >= 0]
    table = Table("what the log says", "")
    table.add_row("steps", f"{len(iterations)}")
    if len(without):  # the first step waits for its factor, within limits
        table.add_row("iterations before the first factor", f"{without.mean():.0f}")
    used = len(with_factor) > 0
    shown = f"{with_factor.mean():.1f} / {with_factor.max()}" if used else "no factor came in time"
    table.add_row("iterations with a factor, mean / max", shown)
    table.add_row("age of the factor, mean / max", f"{age[age >= 0].mean():.1f} / {age.max()} steps" if used else "-")
    table.add_row("largest true residual", f"{residual.max():.1e}")
    percentiles = np.percentile(milliseconds, [50, 99, 100])
    table.add_row("time of a step, p50 / p99 / max", " / ".join(f"{v:.2f}" for v in percentiles) + " ms")
    return table


def has_browser() -> bool:
    """True if there are a display and a browser for it, and a page to show in it."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    if not (importlib.util.find_spec("clients.web") and importlib.util.find_spec("viser")):
        return False
    try:
        return Path(webbrowser.get().name).name not in TEXT_BROWSERS
    except webbrowser.Error:
        return False


def start(scene: str, *arguments: str) -> "subprocess.Popen[bytes]":
    """Starts a server with a scene and a worker."""
    run = [scene, "--workers", "1", "--listen", ENDPOINT, *arguments]
    return subprocess.Popen(tool("sim_server", *run), cwd=ROOT)


def answers(port: int) -> bool:
    """True if something of this machine listens there."""
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True


def ended(process: "subprocess.Popen[bytes]") -> None:
    """Ends a process if it runs."""
    if process.poll() is None:
        process.terminate()
        process.wait(10)


def show() -> int:
    """Opens the page on the creature, until Ctrl-C or the server ends; returns the exit code of what ended first."""
    address = f"http://127.0.0.1:{PAGE}"
    server = start(SCENE)
    page = None
    try:
        with connected(server):
            page = subprocess.Popen(tool("clients", "web", "--connect", ENDPOINT, "--port", str(PAGE)), cwd=ROOT)
        opened = False
        while server.poll() is None and page.poll() is None:
            time.sleep(0.1)
            if not opened and answers(PAGE):
                opened = True
                console.print(f"drag the creature: {address} (Ctrl-C ends)", highlight=False)
                threading.Thread(target=webbrowser.open, args=[address], daemon=True).start()  # some wait for its end
        return page.returncode if server.poll() is None else server.returncode
    finally:
        for process in (page, server):
            if process is not None:
                ended(process)


def record() -> int:
    """Plays with the creature and leaves a log, a film, a picture and arrays; returns the exit code of the server."""
    OUT.mkdir(parents=True, exist_ok=True)
    console.print("a creature in real time: a server, a worker, a client that pushes it and drags it by its hand")
    log = OUT / "creature.mcap"
    server = start(SCENE, "--record", str(log), "--steps", str(STEPS))
    try:
        play(server)
    finally:
        ended(server)
    if server.returncode:
        return server.returncode
    made = {what: log.with_suffix(f".{end}") for what, end in MADE.items()}
    with shown("drawing the film"):
        film(log, made["film"])
    sim_client("making the recording for rerun", "view", str(log), "--save", str(made["recording"]))
    sim_client("drawing the picture", "view", str(log), "--screenshot", str(made["picture"]))
    sim_client("writing the arrays", "export", str(log), "--object", "creature", "--to", str(made["arrays"]))
    console.print(summary(made["arrays"]))
    for what, path in {"log": log, **made}.items():
        console.print(f"{what:10} {path.relative_to(ROOT)}  ({path.stat().st_size / 1e6:.1f} MB)", highlight=False)
    console.print(WAYS_ON, highlight=False, soft_wrap=True)
    return 0


def film(log: Path, to: Path) -> None:
    """Writes the film of the creature being dragged."""
    from clients.viewer.film import gif

    with Log(log) as opened:
        to.write_bytes(gif(opened, *FILM))


def main() -> int:
    """Runs the demonstration; returns its exit code."""
    return show() if has_browser() else record()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
