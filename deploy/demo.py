# SPDX-License-Identifier: MIT
"""The demonstration of `deploy/run demo`: a beam bends, clients push and grab it, and a log and a picture remain.

Every process is started as a user would start it: sim-server with one precond-worker, then sim-client. What it leaves
lies under out/demo: the log (beam.mcap), a rerun recording (beam.rrd), a picture (beam.png) and the arrays (beam.npz).
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from clients.client import Client
from clients.errors import ClientError

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "out" / "demo"
SCENE = ROOT / "deploy" / "scenes" / "beam.toml"
STEPS = 430  # of 20 ms each; it ends while the beam hangs low
ENDPOINT = "tcp/127.0.0.1:7451"  # not the default one: a server of the user's may be running there
PUSH_AT, GRAB_AT, RELEASE_AT = 200, 320, 400  # steps

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
    """Pushes the free end sideways, later grabs and releases it; shows the progress of the run."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with connected(server) as client, Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("simulating in real time", total=STEPS)
        states, touched, grab = client.states(["beam"]), set[int](), None
        while server.poll() is None:
            time.sleep(0.02)
            for frame in states.newest():
                progress.update(task, completed=frame.step)
                end = frame.x[-36:].mean(axis=0)  # the last layer of nodes
                if frame.step >= PUSH_AT and PUSH_AT not in touched:
                    touched.add(PUSH_AT)
                    taken = client.push("beam", at=end, force=(9000, 0, 0), radius=0.8, duration=0.3)
                    progress.console.print(f"step {frame.step}: a client pushes {taken.nodes} nodes of the free end")
                if frame.step >= GRAB_AT and GRAB_AT not in touched:
                    touched.add(GRAB_AT)
                    grab = client.grab("beam", at=end, target=(0.5, 0.5, 3.5), radius=0.8, stiffness=2e4, max_force=1e4)
                    progress.console.print(f"step {frame.step}: a client grabs the free end and pulls it up")
                if grab is not None and frame.step >= RELEASE_AT:
                    grab.release()
                    grab = None
        progress.update(task, completed=STEPS)


def summary(arrays: Path) -> Table:
    """Makes a table of the run from its log."""
    data = np.load(arrays)
    iterations, age = data["scalars/iterations"], data["scalars/factor_age"]
    milliseconds, residual = 1e3 * data["scalars/step_seconds"], data["scalars/residual"]
    without, with_factor = iterations[age < 0], iterations[age >= 0]
    table = Table("what the log says", "")
    table.add_row("steps", f"{len(iterations)}")
    table.add_row("iterations before the first factor", f"{without.mean():.0f}" if len(without) else "-")
    used = len(with_factor) > 0
    shown = f"{with_factor.mean():.1f} / {with_factor.max()}" if used else "no factor came in time"
    table.add_row("iterations with a factor, mean / max", shown)
    table.add_row("age of the factor, mean / max", f"{age[age >= 0].mean():.1f} / {age.max()} steps" if used else "-")
    table.add_row("largest true residual", f"{residual.max():.1e}")
    percentiles = np.percentile(milliseconds, [50, 99, 100])
    table.add_row("step time, p50 / p99 / max", " / ".join(f"{v:.2f}" for v in percentiles) + " ms")
    return table


def main() -> int:
    """Runs the demonstration; returns the exit code of the server."""
    OUT.mkdir(parents=True, exist_ok=True)
    log = OUT / "beam.mcap"
    console.print("a beam in real time: a server, a worker, a client that pushes and grabs it")
    run = [str(SCENE), "--workers", "1", "--steps", str(STEPS), "--record", str(log), "--listen", ENDPOINT]
    server = subprocess.Popen(tool("sim_server", *run), cwd=ROOT)
    try:
        play(server)
    finally:
        if server.poll() is None:
            server.terminate()
            server.wait(10)
    if server.returncode:
        return server.returncode
    made = {"recording": OUT / "beam.rrd", "picture": OUT / "beam.png", "arrays": OUT / "beam.npz"}
    sim_client("making the recording for rerun", "view", str(log), "--save", str(made["recording"]))
    sim_client("drawing the picture", "view", str(log), "--screenshot", str(made["picture"]))
    sim_client("writing the arrays", "export", str(log), "--object", "beam", "--to", str(made["arrays"]))
    console.print(summary(made["arrays"]))
    for what, path in {"log": log, **made}.items():
        console.print(f"{what:10} {path.relative_to(ROOT)}  ({path.stat().st_size / 1e6:.1f} MB)", highlight=False)
    console.print("look at it with: .venv/bin/sim-client view out/demo/beam.mcap", highlight=False)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
