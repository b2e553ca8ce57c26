# SPDX-License-Identifier: MIT
"""The page in a browser: how late it shows what the pointer does, frames a second, and what tabs cost the steps."""

import contextlib
import math
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from clients.client import Client
from clients.errors import ClientError
from clients.web.surfaces import MOST_VERTICES
from clients.web.view import home, up_of
from tests.bench.harness.report import ROOT, Report, plots
from tests.bench.web.player import Player
from tests.bench.web.watcher import frames, jump, still, watched
from tests.ports import free_endpoint, free_port
from tests.support.browser import browser, missing, on_screen

BEAM = ROOT / "deploy" / "scenes" / "beam.toml"
AT_REST = ("effects.gravity.g=[0, 0, 0]", "object.beam.effects.rayleigh.mass=5")  # nothing moves but by the pointer
PATIENCE = 60.0  # s for processes to start
JUMP = 40  # pixels that the pointer jumps
WARM = 5.0  # s until the motion is the same in all runs
SMALL = {"width": 700, "height": 360}  # window of tabs that are only to be there
TABS = (0, 1, 4)
SIDES = (32, 71, 122, 200)  # of sheets, vertices
EXPLAINED = (
    "Server, worker, page and a headless Chromium on one machine, joined by loopback. Chromium has no GPU here and "
    "draws in software, on the processors that the simulation uses: a browser with a GPU shows more frames, and takes "
    "nothing from the steps.",
    "*latency*: the pointer holds a patch of the beam of deploy/scenes/beam.toml (without gravity, damped) at rest "
    "and jumps; the time is from that event in the tab to the end of the first frame that shows the surface moved. It "
    "has in it: viser's event, the page, the command, the wait for the next step and the step, the wait for the next "
    "state (the server sends 30 a second), the page again, the browser's update and drawing; not the display. While a "
    "pointer keeps moving viser sends 20 events a second, which adds up to 50 ms.",
    "*frames*: a sheet waves 30 times a second by itself; frames that showed other positions than the one before. "
    f"Above {MOST_VERTICES} vertices the page shows a coarser surface.",
    "*steps*: of the same beam, with gravity, led around by its tip in real time, while so many tabs are open; the "
    "runs follow one another several times. *processor* is the processor time of the simulation thread for a step, "
    "which does not count the wait for a processor that a browser has taken.",
)


@contextlib.contextmanager
def process(package: str, *words: str, log: Path) -> Iterator[Any]:
    """One of our programs."""
    with log.open("ab") as out:
        started = subprocess.Popen([sys.executable, "-m", package, *words], cwd=ROOT, stdout=out, stderr=out)
    try:
        yield started
    finally:
        started.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            started.wait(10)
        started.kill()
        started.wait()


@contextlib.contextmanager
def page(endpoint: str, folder: Path) -> Iterator[str]:
    """The page of a server; its address."""
    port = free_port()
    log = folder / f"page-{port}.log"
    with process("clients", "web", "--connect", endpoint, "--port", str(port), log=log):
        end = time.monotonic() + PATIENCE
        while "the page is at" not in log.read_text() and time.monotonic() < end:
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}"


@contextlib.contextmanager
def served(folder: Path, *settings: str, scene: Path = BEAM) -> Iterator[tuple[Client, str]]:
    """A server with a worker whose factor is in use, and a client of it; its endpoint."""
    endpoint = free_endpoint()
    words = [word for setting in settings for word in ("--set", setting)]
    log = folder / "server.log"
    with process(
        "sim_server", str(scene), "--listen", endpoint, "--workers", "1", "--device", "cpu", "--quiet", *words, log=log
    ):
        end = time.monotonic() + PATIENCE
        while True:
            try:
                client = Client(connect=[endpoint])
                break
            except ClientError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.1)
        with client:
            while not client.status().objects[0].factors_used and time.monotonic() < end:
                time.sleep(0.1)
            yield client, endpoint


@contextlib.contextmanager
def stirred(client: Client, warm: float) -> Iterator[None]:
    """The tip of the beam is led around in a circle, so that steps have the same work at all times.

    warm: seconds until it has come down
    """
    stop = threading.Event()
    time.sleep(warm)
    with client.grab("beam", at="tip", stiffness=5e3, max_force=5e3) as held:
        at = held.interaction.point

        def lead() -> None:
            begun = time.monotonic()
            while not stop.wait(1 / 30):
                turn = 2 * math.pi * (time.monotonic() - begun) / 4
                held.move((at.x + 0.6 * math.cos(turn), at.y + 0.6 * math.sin(turn), at.z), wait=False)

        thread = threading.Thread(target=lead)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


def latency(chromium: Any, folder: Path, jumps: int) -> list[dict[str, Any]]:
    """Times from the pointer to the frame, one row of percentiles."""
    with served(folder, *AT_REST) as (client, endpoint), page(endpoint, folder) as address:
        tab = watched(chromium, address)
        mesh = client.meshes()["beam"]
        view = home(mesh.rest.min(axis=0), mesh.rest.max(axis=0), up_of(client.scene().resolved))
        x, y = on_screen(tab, view, (1.0, 0.4, 3.6))
        tab.mouse.move(x, y)
        tab.mouse.down()
        tab.mouse.move(x - JUMP, y, steps=5)
        found = []
        for number in range(jumps):
            still(tab)
            found.append(jump(tab, x - JUMP * (number % 2), y - JUMP))
        tab.mouse.up()
        tab.close()
    shown = [ms for ms in found if ms >= 0]
    if not shown:
        raise RuntimeError("no jump of the pointer was shown")
    p50, p99 = np.percentile(shown, [50, 99])
    return [
        {"jumps": jumps, "not shown": jumps - len(shown), "latency p50 ms": p50, "latency p99 ms": p99,
         "least ms": min(shown), "largest ms": max(shown)}
    ]  # fmt: skip


def rates(chromium: Any, folder: Path, seconds: float, sides: tuple[int, ...]) -> list[dict[str, Any]]:
    """Frames a second, a row for each size."""
    rows = []
    for side in sides:
        with Player(side) as player, page(player.endpoint, folder) as address:
            tab = watched(chromium, address)
            time.sleep(1.0)
            begun, before = time.monotonic(), frames(tab)
            time.sleep(seconds)
            count, took = frames(tab) - before, time.monotonic() - begun
            tab.close()
        vertices = side * side
        rows.append({"vertices": vertices, "shown": min(vertices, MOST_VERTICES), "frames a second": count / took})
        print(f"{vertices} vertices done", flush=True)
    return rows


def costs(
    chromium: Any, folder: Path, seconds: float, rounds: int, numbers: tuple[int, ...], warm: float = WARM
) -> list[dict[str, Any]]:
    """Times of steps with so many tabs open, a row for each number of tabs. warm: as of `stirred`."""
    wall: dict[int, list[float]] = {n: [] for n in numbers}
    processor: dict[int, list[float]] = {n: [] for n in numbers}
    late = dict.fromkeys(numbers, 0)
    with served(folder) as (client, endpoint), page(endpoint, folder) as address, stirred(client, warm):
        steps = client.steps()
        time.sleep(warm)
        for _ in range(rounds):
            for count in numbers:
                tabs = [watched(chromium, address, SMALL) for _ in range(count)]
                time.sleep(1.0)
                steps.new()
                before, end = client.status(fresh=True).late_steps, time.monotonic() + seconds
                while time.monotonic() < end:
                    time.sleep(0.5)
                    for step in steps.new():
                        wall[count].append(step.step_seconds)
                        processor[count].append(step.cpu_seconds)
                late[count] += client.status(fresh=True).late_steps - before
                for tab in tabs:
                    tab.close()
    rows = []
    for count in numbers:
        row: dict[str, Any] = {"tabs": count, "steps": len(wall[count]), "late": late[count]}
        for what, of in (("step", wall), ("processor", processor)):
            p50, p99 = 1e3 * np.percentile(of[count], [50, 99])
            row |= {f"{what} p50 ms": p50, f"{what} p99 ms": p99}
        rows.append(row)
    for row in rows:
        row["p50 over none"] = row["processor p50 ms"] / rows[0]["processor p50 ms"]
        row["p99 over none"] = row["processor p99 ms"] / rows[0]["processor p99 ms"]
    return rows


def picture(frames_of: list[dict[str, Any]], cost: list[dict[str, Any]]) -> Any:
    """Frames a second against vertices, and processor time of steps against tabs."""
    figure, (left, right) = plots().subplots(1, 2, figsize=(8, 3), layout="constrained")
    left.plot([row["vertices"] for row in frames_of], [row["frames a second"] for row in frames_of], "o-")
    left.set(xlabel="vertices of the surface", ylabel="frames a second", xscale="log", ylim=(0, 32))
    for k, part in enumerate(("p50", "p99")):
        places = [place + 0.4 * k - 0.2 for place in range(len(cost))]
        right.bar(places, [row[f"processor {part} ms"] for row in cost], 0.4, label=part)
    right.set_xticks(range(len(cost)), [str(row["tabs"]) for row in cost])
    right.set(xlabel="tabs", ylabel="processor time of a step [ms]")
    right.legend()
    return figure


def main(
    seconds: Annotated[float, typer.Option(min=1.0, help="Of each run")] = 20.0,
    jumps: Annotated[int, typer.Option(min=1, help="Of the pointer")] = 100,
    rounds: Annotated[int, typer.Option(min=1, help="Of 0, 1 and 4 tabs")] = 3,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/web]")] = None,
) -> None:
    """Latency, frames a second and cost of the page."""
    if why := missing():
        raise SystemExit(why)
    sides = SIDES[:1] if quick else SIDES
    if quick:
        seconds, jumps, rounds = 1.0, 2, 1
    report = Report("web", "The page in a browser", {"seconds": seconds, "jumps": jumps, "rounds": rounds}, out, quick)
    with tempfile.TemporaryDirectory(prefix="warpfactor-web-") as name, browser() as chromium:
        folder = Path(name)
        late = latency(chromium, folder, jumps)
        print("latency done", flush=True)
        shown = rates(chromium, folder, seconds, sides)
        cost = costs(chromium, folder, seconds, rounds, TABS[:2] if quick else TABS, 0.5 if quick else WARM)
    report.say(*EXPLAINED)
    for title, rows in (("From pointer to frame", late), ("Frames a second", shown), ("What tabs cost", cost)):
        report.say(f"## {title}")
        report.table(rows)
    report.figure(picture(shown, cost), "web.png", "Frames a second, and processor time of steps with tabs.")
    report.remember(late, ("jumps",), ("latency p50 ms", "latency p99 ms"))
    report.remember(cost, ("tabs",), ("processor p50 ms", "processor p99 ms"))
    report.data |= {"latency": late, "frames": shown, "cost": cost}
    report.write()


if __name__ == "__main__":
    typer.run(main)
