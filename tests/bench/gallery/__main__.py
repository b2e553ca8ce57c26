# SPDX-License-Identifier: MIT
"""The scenes of the gallery while a hand drags them: steps a second, iterations, ages of factors; beside the paper."""

import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.log.reader import Log
from tests.bench.harness.pieces import Merged
from tests.bench.harness.report import ROOT, Report
from tests.ports import free_endpoint

TITLE = "Dragging the creature"
CREATURE = "creature"
SOLVERS = {"factors by a worker": (), "block Jacobi": ("solver.preconditioner=block_jacobi",),
           "no preconditioner": ("solver.preconditioner=none",)}  # fmt: skip
FACTORS = next(iter(SOLVERS))
HANDS = {  # object, nearest to which point at rest it is held [m], how far it is dragged [m], radius [m], N/m, N
    CREATURE: ("creature", (0.225, 0.283, 0.038), 0.2, 0.035, 400, 100),
    "liver": ("liver", (-0.09, -0.06, 0.04), 0.08, 0.025, 250, 30),
    "tentacle": ("tentacle", (0.19, 0.05, 0.0), 0.2, 0.03, 150, 25),
    "jelly": ("bottom", (0.06, 0.06, 0.0), 0.02, 0.02, 60, 5),
    "sheet": ("sheet", (0.0, 0.5, 0.34), 0.3, 0.05, 40, 15),
    "beam": ("beam", (0.5, 0.5, 4.2), 1.5, 0.5, 3e4, 1.2e4),
}
PERIOD = 2.0  # s of wall time in which a hand goes around
PATIENCE = 60.0  # s for a server to be there
# Section 8.4 and figure 5 (c) of the paper: an armadillo in non-homogeneous stiffness, moved and rotated by a user.
PAPER = {"scene": "the paper's armadillo", "solver": "asynchronous, warped", "tets": 4406, "steps a second": "50 to 80"}
COLUMNS = ("device", "scene", "solver", "tets", "steps a second", "step p50 ms", "step p99 ms", "iterations",
           "iterations p99", "age", "age, max", "not converged")  # fmt: skip
KEYS = ("device", "scene", "solver")  # what tells rows apart
EXPLAINED = (
    f"""\
Each scene runs as fast as it goes, `sim-server gallery/NAME --workers 1 --free-run`, with a log, while a client holds a
body and drags it around once in {PERIOD:g} s of wall time; server, worker and client are processes of one machine. The
steps before the hand takes hold, and while a first factor is awaited, do not count. *steps a second*: those that count
over the sum of their times; a step of 20 ms is in real time at 50. *age* of the factors used [steps], its mean. *not
converged*: steps whose solve used up its iterations. The committed page's runs on
a CPU had two cores, `taskset -c 0,1`.""",
    """\
The paper (Courtecuisse et al. 2010, section 8.4) says of its interactive armadillo how many elements it had, that it
ran at 50 to 80 frames a second on a Core i7 at 3.07 GHz with a GeForce GTX 480, and that without a preconditioner it
would not converge in a reasonable time. Stiffnesses, time step, tolerance and iterations of it are not told. Ours:
bones of 2 MPa in flesh of 0.04 MPa, time step 20 ms, true residual 1e-6.""",
)


def around(turns: float) -> NDArray[np.float64]:
    """Where a hand is that goes around, over how far it goes; it begins and ends at 0."""
    a = 2 * np.pi * turns
    return np.array([np.sin(a), 0.5 - 0.5 * np.cos(a), 0.6 * np.sin(2 * a)])


def drag(server: "subprocess.Popen[bytes]", endpoint: str, name: str, warm: int) -> int:
    """Takes hold of a body once `warm` steps are made, and drags it until the server ends; returns the step."""
    held, at, reach, radius, stiffness, force = HANDS[name]
    with _client(server, endpoint) as client:
        node = int(np.linalg.norm(client.meshes()[held].rest - np.array(at), axis=1).argmin())
        states, grab, begun, start, first = client.states([held]), None, 0.0, np.zeros(3), 0
        while server.poll() is None:
            time.sleep(0.01)
            frames = states.newest()
            if grab is None and frames and frames[-1].step >= warm:
                start, first, begun = frames[-1].x[node], frames[-1].step, time.monotonic()
                with suppress(BadInput):  # the body has moved on meanwhile: then with the next frame
                    grab = client.grab(held, tuple(start), radius=radius, stiffness=stiffness, max_force=force)
            elif grab is not None:
                grab.move(start + reach * around((time.monotonic() - begun) / PERIOD), wait=False)
    return first


def _client(server: "subprocess.Popen[bytes]", endpoint: str) -> Client:
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return Client(connect=[endpoint])
        except ClientError:
            if server.poll() is not None or time.monotonic() > end:
                raise
            time.sleep(0.05)


def measured(name: str, solver: str, device: str, steps: int) -> dict[str, Any]:
    """Returns a row."""
    warm = steps // 4
    with tempfile.TemporaryDirectory(prefix="warpfactor-gallery-") as folder:
        log, endpoint = Path(folder) / "run.mcap", free_endpoint()
        words = [f"gallery/{name}", "--free-run", "--workers", "1", "--steps", str(steps + warm), "--quiet"]
        words += ["--device", device, "--worker-device", "auto", "--record", str(log), "--listen", endpoint]
        words += [word for override in SOLVERS[solver] for word in ("--set", override)]
        server = subprocess.Popen([sys.executable, "-m", "sim_server", *words], cwd=ROOT)
        try:
            first = drag(server, endpoint, name, warm)
        finally:
            if server.poll() is None:
                server.kill()
            server.wait()
        if server.returncode:
            raise RuntimeError(f"gallery/{name}: exit code {server.returncode}")
        with Log(log) as opened:
            scalars = {body: opened.scalars(body) for body in opened.objects}
            tets = sum(len(found.meshes[1].tets) for found in opened.objects.values())
    one = next(iter(scalars.values()))
    counts = one["step"] > max(first, _with_a_factor(scalars) if solver == FACTORS else 0)
    iterations = np.max([found["iterations"] for found in scalars.values()], axis=0)[counts]
    age = np.concatenate([found["factor_age"][counts] for found in scalars.values()])
    ms = 1e3 * one["step_seconds"][counts]
    lost = sum(int((np.array(found["status"])[counts] == "max_iterations").sum()) for found in scalars.values())
    row = {"device": device, "scene": name, "solver": solver, "tets": tets, "steps a second": 1e3 / ms.mean()}
    row |= {"step p50 ms": np.percentile(ms, 50), "step p99 ms": np.percentile(ms, 99)}
    row |= {"iterations": iterations.mean(), "iterations p99": np.percentile(iterations, 99)}
    row |= {"age": _known(age, np.mean), "age, max": _known(age, np.max), "not converged": lost}
    return row


def _with_a_factor(scalars: dict[str, Any]) -> int:
    """Returns the first step in which an object had a factor; 0 if none ever had."""
    found = [columns["step"][columns["factor_age"] >= 0] for columns in scalars.values()]
    return int(min((steps[0] for steps in found if len(steps)), default=0))


def _known(age: NDArray[Any], what: Any) -> float | None:
    return float(what(age[age >= 0])) if (age >= 0).any() else None


def write(report: Report, rows: list[dict[str, Any]], others: list[dict[str, Any]]) -> None:
    """Makes the page. rows: of the creature"""
    report.say(*EXPLAINED, "## The creature")
    report.table([*rows, PAPER], COLUMNS)
    report.say("## The other scenes")
    report.table(others, COLUMNS)
    report.data |= {"creature": rows, "others": others}
    report.remember([*rows, *others], KEYS, ("steps a second", "iterations"))
    report.write()


def main(
    steps: Annotated[
        int, typer.Option(min=40, help="Steps of each run, after a quarter as many that do not count")
    ] = 1000,
    device: Annotated[str, typer.Option(metavar="cpu|gpu", help="Of the servers")] = "cpu",
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/gallery]")] = None,
    merge: Annotated[
        list[Path] | None, typer.Option(metavar="JSON", help="Only make one page of these results, as of both devices")
    ] = None,
) -> None:
    """Steps a second, iterations and ages of factors of the gallery's scenes while a hand drags them."""
    if device not in ("cpu", "gpu"):
        raise typer.BadParameter(f"--device {device}: allowed are cpu, gpu")
    if merge:
        merged = Merged("gallery", TITLE, merge, out)
        write(merged, merged.rows("creature", KEYS), merged.rows("others", KEYS))
        return
    steps = 60 if quick else steps
    report = Report("gallery", TITLE, {"steps": steps, "device": device}, out, quick)
    rows = []
    for solver in list(SOLVERS)[: 2 if quick else None]:
        rows.append(measured(CREATURE, solver, device, steps))
        print(f"{CREATURE}, {solver}: done", flush=True)
    others = []
    for name in ("tentacle",) if quick else [name for name in HANDS if name != CREATURE]:
        others.append(measured(name, FACTORS, device, steps))
        print(f"{name}: done", flush=True)
    write(report, rows, others)


if __name__ == "__main__":
    typer.run(main)
