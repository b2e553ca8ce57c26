# SPDX-License-Identifier: MIT
"""What faults cost: workers killed, stopped and started again, networks cut, lossy and slow, hostile and slow clients.

    deploy/run bench faults                      a few seconds of each
    deploy/run bench faults --minutes 10 --lives 100 --cut 30
    deploy/run bench faults --only kill stop

Every process is a real one; a beam swings in real time, and its log is read afterwards. A step that is missing, or that
starts late, would show. "next factor" counts from the end of the fault.
"""

import argparse
import contextlib
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.bench._fault_net import ADDRESS, Cable, Unavailable
from tests.bench._fault_stage import DT, Progress, Stage, measured
from tests.bench.report import Report

SETTLE = 50  # steps before a fault, after the first factor
AFTER = 100  # steps after the first factor after it
RECOVERY = 30.0  # s that this factor is waited for

# Runs a fault; returns the step at which it was over, None if there was none.
Fault = Callable[[Stage, Progress, argparse.Namespace], int | None]

HOSTILE = """
import os, sys, time
from protocol.channels import key
from protocol.session import open_session
with open_session("client", connect=[sys.argv[1]], shared_memory=False) as session:
    end, junk, count = time.monotonic() + float(sys.argv[2]), os.urandom(1 << 20), 0
    while time.monotonic() < end:
        for channel in ("factor", "pattern", "worker"):
            name = {"worker": "evil"} if channel == "worker" else {"object": "beam"}
            session.zenoh.put(key(channel, **name), junk[: 1 << 10 * (count % 3)], attachment=junk[:100])
        count += 1
"""
SLEEPER = """
import sys, time
from clients.client import Client
with Client(connect=[sys.argv[1]]) as client:
    states, steps = client.states(["beam"]), client.steps()
    print("subscribed", flush=True)
    end = time.monotonic() + float(sys.argv[2])
    while time.monotonic() < end:
        time.sleep(1.0)
        states.newest()
"""


def quiet(stage: Stage, progress: Progress, o: argparse.Namespace) -> None:
    """Nothing happens for as long as a fault lasts."""
    progress.pause(5.0)


def kill(stage: Stage, progress: Progress, o: argparse.Namespace) -> int:
    """kill -9 while it factorizes (its jobs follow one another), another one is started at once."""
    o.worker.kill()
    o.worker.wait()
    progress.look()
    at = progress.step
    stage.worker("w2")
    return at


def stop(stage: Stage, progress: Progress, o: argparse.Namespace) -> int:
    """SIGSTOP for 5 s."""
    o.worker.send_signal(signal.SIGSTOP)
    progress.pause(5.0)
    o.worker.send_signal(signal.SIGCONT)
    return progress.step


def storm(stage: Stage, progress: Progress, o: argparse.Namespace) -> int:
    """kill -9 and a new one every few seconds."""
    end, worker, life = time.monotonic() + 60 * o.minutes, o.worker, 0
    while time.monotonic() < end:
        worker.kill()
        worker.wait()
        life += 1
        worker = stage.worker(f"life-{life % 2}")
        progress.pause(min(4.0, max(0.1, end - time.monotonic())))
    return progress.step


def sleeper(stage: Stage, progress: Progress, o: argparse.Namespace) -> int:
    """A client that subscribes to everything and sleeps."""
    stage.start([*python(SLEEPER), stage.endpoint, "5"])
    progress.pause(5.0)
    return progress.step


def flood(stage: Stage, progress: Progress, o: argparse.Namespace) -> int:
    """Garbage on the channels of workers, as fast as one process can, for 3 s."""
    stage.start([*python(HOSTILE), stage.endpoint, "3"]).wait()
    progress.look()
    return progress.step


def python(text: str) -> list[str]:
    """Command line of a small program."""
    return [sys.executable, "-c", text]


def while_it_lasts(begin: Callable[[], None], seconds: float | None, end: Callable[[], None]) -> Fault:
    """Something that is wrong with the cable for a while; None: as long as --cut says."""

    def fault(stage: Stage, progress: Progress, o: argparse.Namespace) -> int:
        begin()
        progress.pause(o.cut if seconds is None else seconds)
        end()
        return progress.step

    return fault


def cut(cable: Cable) -> Fault:
    """No packet passes for a while."""
    return while_it_lasts(lambda: cable.cut(True), None, lambda: cable.cut(False))


def lossy(cable: Cable) -> Fault:
    """Half of all packets are lost, for 5 s."""
    return while_it_lasts(lambda: cable.lose(50), 5.0, cable.mend)


def slow(cable: Cable) -> Fault:
    """100 ms in each direction, for 5 s."""
    return while_it_lasts(lambda: cable.delay(100), 5.0, cable.mend)


HERE: dict[str, tuple[Fault, str]] = {
    "quiet": (quiet, "nothing"),
    "kill": (kill, "kill -9 of the worker, another is started"),
    "stop": (stop, "SIGSTOP of the worker for 5 s"),
    "storm": (storm, "kill -9 and a new worker every 4 s"),
    "sleeper": (sleeper, "a client that subscribes and sleeps"),
    "flood": (flood, "garbage on all channels of workers"),
}
THERE: dict[str, tuple[Callable[[Cable], Fault], str]] = {
    "cut": (cut, "network between server and worker cut"),
    "lossy": (lossy, "50 % of the packets lost for 5 s"),
    "slow": (slow, "100 ms of delay each way for 5 s"),
}


def run(name: str, fault: Fault, stage: Stage, o: argparse.Namespace, *options: str) -> dict[str, Any]:
    """One fault, SETTLE steps after the first factor, until AFTER steps after the first factor that follows it."""
    with stage:
        o.worker = stage.worker("w1", *options)
        with stage.client() as client:
            progress = Progress(client)
            progress.until(lambda: progress.factor_step > 0)
            begun = progress.step
            progress.past(begun + SETTLE)
            after = fault(stage, progress, o)
            with contextlib.suppress(TimeoutError):  # then there is none, which the table says
                progress.until(lambda: after is None or progress.factor_step > after, RECOVERY)
            progress.past(progress.step + AFTER)
            refused, data = client.status().refused, stage.finish(client)
        return {"fault": name, **measured(data, progress.step, after), "messages refused": refused}


def lives(o: argparse.Namespace) -> list[dict[str, Any]]:
    """Workers killed one after another, each after its first factor: what stays of them in the server's memory."""
    rows = []
    with Stage() as stage, stage.client() as client:
        progress = Progress(client)
        for life in range(1, o.lives + 1):
            worker, begun = stage.worker(f"life-{life}"), progress.step
            progress.until(lambda begun=begun: progress.factor_step > begun)
            worker.kill()
            worker.wait()
            if life in (1, 2, 5, o.lives) or life % 10 == 0:
                progress.pause(0.5)
                rows.append({"workers so far": life, **memory(stage.server.pid)})
    return rows


def memory(pid: int) -> dict[str, float]:
    """Of a process: resident and locked MB; in /dev/shm all of zenoh's MB."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    shared = sum(file.stat().st_size for file in Path("/dev/shm").glob("*.zenoh"))
    return {
        "server resident MB": int(lines["VmRSS"].split()[0]) / 1024,
        "server locked MB": int(lines["VmLck"].split()[0]) / 1024,
        "zenoh in /dev/shm MB": shared / 2**20,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=0.2, help="of killing workers every 4 s")
    parser.add_argument("--lives", type=int, default=10, help="workers killed one after another, for the memory")
    parser.add_argument("--cut", type=float, default=6.0, help="seconds without a network")
    parser.add_argument("--only", nargs="+", choices=[*HERE, *THERE, "lives"], help="these alone")
    parser.add_argument("--quick", action="store_true", help="kill alone, beside the quiet run")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that processes and namespaces go too
    chosen = options.only or [*HERE, *([] if options.quick else [*THERE, "lives"])]
    if options.quick:
        chosen = ["quiet", "kill"]
    arguments = {"minutes": options.minutes, "lives": options.lives, "cut": options.cut, "only": chosen}
    report = Report("faults", "What faults cost", arguments, options.out, options.quick)
    rows, skipped = table_of_faults([name for name in chosen if name != "lives"], options)
    report.data["rows"], report.data["skipped"] = rows, skipped
    say_faults(report, rows, skipped)
    if "lives" in chosen:
        report.data["lives"] = lives(options)
        report.say("## Memory", "Workers killed with -9 one after another, each after its first factor.")
        report.table(report.data["lives"])
    report.write()


def table_of_faults(names: list[str], o: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Rows, and what was skipped and why. What needs a network of its own has a quiet run on it beside it."""
    rows: list[dict[str, Any]] = []
    skipped: dict[str, str] = {}
    for name in (name for name in names if name in HERE):
        rows.append(run(name, HERE[name][0], Stage(), o))
        print(rows[-1], flush=True)
    there = [name for name in names if name in THERE]
    for name in (["quiet"] if there else []) + there:
        try:
            with Cable() as cable:
                fault = quiet if name == "quiet" else THERE[name][0](cable)
                stage = Stage(ADDRESS, cable.far)
                row = run(name, fault, stage, o, "--no-shared-memory")
                rows.append({**row, "fault": "quiet, over a network" if name == "quiet" else name})
                print(rows[-1], flush=True)
        except Unavailable as why:
            skipped[name] = str(why)
            print(f"skipped: {name}: {why}", flush=True)
    return rows, skipped


def say_faults(report: Report, rows: list[dict[str, Any]], skipped: dict[str, str]) -> None:
    """The table, with penalties against the quiet run of the same network."""
    plain = {"here": "quiet", "there": "quiet, over a network"}
    base = {place: next((r for r in rows if r["fault"] == name), None) for place, name in plain.items()}
    what = {name: text for name, (_, text) in {**HERE, **THERE}.items()}
    for row in rows:
        quiet_row = base["there" if row["fault"] in (*THERE, plain["there"]) else "here"]
        row["what"] = what.get(row["fault"], "nothing; the worker gets bytes through a cable")
        row["iterations, times quiet"] = row["iterations"] / quiet_row["iterations"] if quiet_row else None
    report.say(
        f"A beam of 1152 tetrahedra in real time, dt {1e3 * DT:g} ms. missed: steps that the log does not hold; latest "
        "start: the largest delay of a step after its time; late steps: by more than 1 ms; next factor: from the end "
        "of the fault to the first step with a factor made after it. Iterations of steps with a factor."
    )
    if rows:
        columns = [
            "what", "steps", "missed", "not converged", "step p50 ms", "step max ms", "latest start ms", "late steps",
            "iterations", "iterations, times quiet", "oldest factor", "next factor s", "messages refused",
        ]  # fmt: skip
        report.table(rows, columns)
    for name, why in skipped.items():
        report.say(f"Skipped: {what[name]}: {why}")


if __name__ == "__main__":
    main()
