# SPDX-License-Identifier: MIT
"""A server for as long as asked, with all that users and operators do to it: what grows, and what becomes slower."""

import argparse
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from clients.client import Client
from clients.errors import BadInput, ClientError
from tests.bench.faults.__main__ import memory
from tests.bench.harness.report import Report, plots
from tests.support.stage import Progress, Stage, measured

TITLE = "A server over time"
SCENE = """
dt = 0.02
[effects]
gravity = { g = [0, -9.81, 0] }
contact = true
[solver]
preconditioner = "cholesky"
[[object]]
name = "beam"
mesh = { bar = [4, 4, 8], size = [0.1, 0.1, 0.2], split = "mirrored" }
elements = "linear"
pose = { rotate = [25, 30, 35], translate = [0, 0.3, 0] }
density = 1000
[object.effects]
corotational = { young = 1e5, poisson = 0.4 }
rayleigh = { stiffness = 0.002 }
touch = { max_force = 200 }
cutting = true
[[obstacle]]
name = "floor"
shape = "plane"
"""
WORDS = """A body of 768 tetrahedra on a floor, in real time, dt 20 ms, recorded. All the while clients come, look,
take hold, drag, push, set Young's modulus, and go, some without a word; every {kill:g} s the worker is
killed with -9 and another is started; every {cut:g} s a part is cut away, and every {reset:g} s all is put
back to the start. Sampled every {sample:g} s.

*an hour*: slope of a straight line through the samples of the last three quarters of the run. *step*:
median of the loop's own processor time for a step in that part of the run, from the log; a body that was
cut is smaller. *commands refused*: those that the server did not carry out; *unanswered*: those that had no
answer within the time that the client waits."""
RATES = {"sample": 5.0, "kill": 7.0, "cut": 20.0, "reset": 60.0}  # s
QUICK = {"sample": 0.5, "kill": 2.0, "cut": 2.0, "reset": 4.0}
PARTS = 4


class Doings:
    """What is done to the server, by turns; counts of it."""

    def __init__(self, stage: Stage, rates: dict[str, float], seed: int):
        self._stage, self._rates, self._random = stage, rates, random.Random(seed)
        self._due = {name: time.monotonic() + rate for name, rate in rates.items() if name != "sample"}
        self._worker = stage.worker("life-0")
        self._kept: list[Client] = []
        self.counts = dict.fromkeys(("clients", "commands", "refused", "unanswered", "killed", "cut", "reset"), 0)

    def round(self) -> None:
        """A client that comes and goes; and what is due."""
        self._visit()
        now = time.monotonic()
        for name, due in self._due.items():
            if now >= due:
                self._due[name] = now + self._rates[name]
                getattr(self, f"_{name}")()

    def _visit(self) -> None:
        rng, client = self._random, self._do(self._stage.client)
        if client is None:
            return
        self.counts["clients"] += 1
        self._do(lambda: client.set("beam.corotational.young", rng.choice((5e4, 1e5, 2e5))))
        self._do(lambda: client.push("beam", "top", force=(0, rng.uniform(0, 20), 0), duration=0.2))
        grab = self._do(lambda: client.grab("beam", "top", radius=0.05, stiffness=500.0))
        states = self._do(client.states)
        for _ in range(5):
            if grab is not None:
                self._do(lambda: grab.move((rng.uniform(-0.1, 0.1), rng.uniform(0.1, 0.4), 0.1)))
            time.sleep(0.05)
            if states is not None:
                states.newest()
        if grab is not None and rng.random() < 0.5:
            self._do(grab.release)  # else it ends with the client
        client.close()

    def _do(self, command: Any) -> Any:
        self.counts["commands"] += 1
        try:
            return command()
        except (ClientError, BadInput) as error:
            self.counts["unanswered" if "did not answer" in str(error) else "refused"] += 1
            return None

    def _kill(self) -> None:
        self._worker.kill()
        self._worker.wait()
        self.counts["killed"] += 1
        self._worker = self._stage.worker(f"life-{self.counts['killed'] % 2}")

    def _cut(self) -> None:
        low = self._random.uniform(0, 0.15)
        self._alone(lambda client: client.cut("beam", where=f"Z > {low} and Z < {low + 0.03} and Y > 0.06"))
        self.counts["cut"] += 1

    def _reset(self) -> None:
        self._alone(lambda client: client.reset())
        self.counts["reset"] += 1

    def _alone(self, command: Callable[[Client], Any]) -> None:
        """A command of a client that comes for it alone."""
        client = self._do(self._stage.client)
        if client is not None:
            self._do(lambda: command(client))
            client.close()


def sampled(pid: int, began: float) -> dict[str, float]:
    """What a process holds now."""
    process = Path(f"/proc/{pid}")
    held = memory(pid)
    return {
        "minute": (time.monotonic() - began) / 60, "resident MB": held["server resident MB"],
        "descriptors": len(list((process / "fd").iterdir())), "threads": len(list((process / "task").iterdir())),
        "shared MB": held["zenoh in /dev/shm MB"],
    }  # fmt: skip


def drifts(samples: list[dict[str, float]]) -> list[dict[str, Any]]:
    """First, largest and last value of each, and its slope."""
    late = samples[len(samples) // 4 :]
    hours = np.array([s["minute"] / 60 for s in late])
    rows = []
    for name in ("resident MB", "descriptors", "threads", "shared MB"):
        values = np.array([s[name] for s in late])
        slope = float(np.polyfit(hours, values, 1)[0]) if len(late) > 2 else 0.0
        rows.append({
            "what": name, "at the start": samples[0][name], "after a quarter": late[0][name],
            "most": max(s[name] for s in samples), "at the end": samples[-1][name], "an hour": slope,
        })  # fmt: skip
    return rows


def parts(data: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Times of steps in each part of the run."""
    found = []
    for k, steps in enumerate(np.array_split(np.arange(len(data["step"])), PARTS)):
        cpu = 1e3 * data["cpu_seconds"][steps]
        found.append({
            "part": f"{k + 1} of {PARTS}", "steps": len(steps), "step p50 ms": float(np.median(cpu)),
            "step p99 ms": float(np.quantile(cpu, 0.99)), "step max ms": float(cpu.max()),
            "late steps": int(np.sum(data["late_seconds"][steps] > 1e-3)),
            "not converged": int(np.sum(data["status"][steps] != "converged")),
        })  # fmt: skip
    return found


def soaked(minutes: float, rates: dict[str, float], seed: int) -> dict[str, Any]:
    """Runs it; returns samples, counts and parts."""
    with Stage(scene=SCENE) as stage, stage.client() as client:
        progress, doings = Progress(stage, client), Doings(stage, rates, seed)
        progress.until(lambda: progress.factor_step > 0)
        began = time.monotonic()
        samples, due = [sampled(stage.server.pid, began)], began + rates["sample"]
        while time.monotonic() < began + 60 * minutes:
            doings.round()
            progress.look()
            if time.monotonic() >= due:
                samples.append(sampled(stage.server.pid, began))
                due += rates["sample"]
                if len(samples) % 12 == 0:
                    print(samples[-1], doings.counts, f"step {progress.step}", flush=True)
        status = client.status(fresh=True)
        data = stage.finish(client)
        row = measured(data, progress.step, None)
        whole = {"minutes": minutes, "steps": row["steps"], "steps missed": row["missed"],
                 "not converged": row["not converged"], "factors used": len(np.unique(data["factor_step"])) - 1,
                 "messages refused": status.refused, **doings.counts}  # fmt: skip
        return {"samples": samples, "whole": whole, "parts": parts(data)}


def main() -> None:
    parser = argparse.ArgumentParser(prog="deploy/run bench soak", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smoke run of seconds")
    parser.add_argument("--out", type=Path, help="folder for the results (default: out/bench/soak)")
    parser.add_argument("--minutes", type=float, default=10.0, help="how long [min]")
    parser.add_argument("--seed", type=int, default=0, help="of what clients do")
    options = parser.parse_args()
    minutes, rates = (0.15, QUICK) if options.quick else (options.minutes, RATES)
    report = Report("soak", TITLE, {"minutes": minutes, "seed": options.seed}, options.out, options.quick)
    found = soaked(minutes, rates, options.seed)
    held = drifts(found["samples"])
    report.say(WORDS.format(**rates))
    report.table([{name.replace("refused", "commands refused") if name == "refused" else name: value
                   for name, value in found["whole"].items()}])  # fmt: skip
    report.say("## What the server holds")
    report.table(held)
    report.say("## Steps")
    report.table(found["parts"])
    report.figure(picture(found["samples"]), "soak.png", "What the server holds, over time")
    report.data |= {"held": held, **found}
    report.write()


def picture(samples: list[dict[str, float]]) -> Any:
    """Each quantity against time."""
    plt = plots()
    figure, axes = plt.subplots(1, 4, figsize=(12, 3), layout="constrained")
    for ax, name in zip(axes, ("resident MB", "descriptors", "threads", "shared MB"), strict=True):
        ax.plot([s["minute"] for s in samples], [s[name] for s in samples])
        ax.set(title=name, xlabel="minutes", ylim=(0, 1.2 * max(s[name] for s in samples) + 1))
    return figure


if __name__ == "__main__":
    main()
