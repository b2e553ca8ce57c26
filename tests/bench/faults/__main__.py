# SPDX-License-Identifier: MIT
"""What faults cost: workers killed, stopped and started again, networks cut, hostile and slow clients.

    deploy/run bench faults                      a few seconds of each
    deploy/run bench faults --minutes 10 --lives 100 --cut 30
    deploy/run bench faults --only kill stop --device gpu --worker-device gpu --limit 500 --out a
    deploy/run bench faults --merge a/faults.json b/faults.json

Every process is a real one; a beam swings in real time, and its log is read afterwards. A step that is missing, or that
starts late, would show. What needs root, network namespaces or a GPU is skipped with a message where that is missing.
"""

import argparse
import contextlib
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.bench.faults import page
from tests.bench.faults.net import ADDRESS, Cable, Unavailable
from tests.bench.harness.pieces import Limit, Merged, Piece, arguments_of_pieces, say, shown
from tests.support.stage import Progress, Stage, measured

TITLE = "What faults cost"
SETTLE = 50  # steps before a fault, after the first factor
AFTER = 100  # steps after the first factor after it
RECOVERY = 30.0  # s that this factor is waited for

Row = dict[str, Any]
# Runs a fault; returns the step at which it was over, None if there was none.
Fault = Callable[[Stage, Progress, argparse.Namespace], int | None]

HOSTILE = """
import os, sys, time
from protocol.channels import key
from protocol.network.session import open_session
with open_session("client", connect=[sys.argv[1]], shared_memory=False) as session:
    end, junk, count = time.monotonic() + float(sys.argv[2]), os.urandom(1 << 20), 0
    while time.monotonic() < end:
        for channel in ("factor", "pattern", "worker"):
            name = {"worker": "evil"} | ({} if channel == "worker" else {"object": "beam"})
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
    stage.worker("w2", *of_worker(o))
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
        worker = stage.worker(f"life-{life % 2}", *of_worker(o))
        progress.pause(min(o.every, max(0.1, end - time.monotonic())))
        if life % 15 == 0:
            say(f"storm: {life} workers killed, step {progress.step}")
    o.killed = life
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


def cut(cable: Cable) -> Fault:
    """No packet passes for as long as --cut says."""

    def fault(stage: Stage, progress: Progress, o: argparse.Namespace) -> int:
        cable.cut(True)
        progress.pause(o.cut)
        cable.cut(False)
        return progress.step

    return fault


HERE: dict[str, Fault] = {
    "quiet": quiet, "kill": kill, "stop": stop, "storm": storm, "sleeper": sleeper, "flood": flood,
}  # fmt: skip
THERE: dict[str, Callable[[Cable], Fault]] = {"cut": cut}


def of_worker(o: argparse.Namespace) -> list[str]:
    """Options of every worker."""
    return ["--device", o.worker_device]


def run(name: str, fault: Fault, stage: Stage, o: argparse.Namespace, *options: str) -> Row:
    """One fault, SETTLE steps after the first factor, until AFTER steps after the first factor that follows it."""
    o.killed = 0
    with stage:
        o.worker = stage.worker("w1", *of_worker(o), *options)
        with stage.client() as client:
            progress = Progress(stage, client)
            progress.until(lambda: progress.factor_step > 0)
            begun = progress.step
            progress.past(begun + SETTLE)
            after = fault(stage, progress, o)
            with contextlib.suppress(TimeoutError):  # then there is none, which the table says
                progress.until(lambda: after is None or progress.factor_step > after, RECOVERY)
            progress.past(progress.step + AFTER)
            refused, data = client.status().refused, stage.finish(client)
        found = {**measured(data, progress.step, after), "messages refused": refused, "workers killed": o.killed}
    return {"fault": name, "server": o.device, "workers on": o.worker_device, **found}


def lives(o: argparse.Namespace, limit: Limit) -> list[Row]:
    """Workers killed one after another, each after its first factor: what stays of them in the server's memory."""
    rows: list[Row] = []
    with Stage(device=o.device) as stage, stage.client() as client:
        progress = Progress(stage, client)
        for life in range(1, o.lives + 1):
            if limit.reached(f"lives from {life} on"):
                break
            worker, begun = stage.worker(f"life-{life}", *of_worker(o)), progress.step
            progress.until(lambda begun=begun: progress.factor_step > begun)
            worker.kill()
            worker.wait()
            if life in (1, 2, 5, o.lives) or life % 10 == 0:
                progress.pause(0.5)
                what = {"workers so far": life, "server": o.device, "workers on": o.worker_device}
                rows.append({**what, **memory(stage.server.pid)})
                say(shown(rows[-1]))
    return rows


def memory(pid: int) -> dict[str, float]:
    """Of a process: resident and locked MB; of zenoh's files in /dev/shm the MB that it maps."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    maps = [line.split(maxsplit=5) for line in Path(f"/proc/{pid}/maps").read_text().splitlines()]
    ranges = [m[0].split("-") for m in maps if len(m) == 6 and m[5].startswith("/dev/shm/") and ".zenoh" in m[5]]
    shared = sum(int(end, 16) - int(begin, 16) for begin, end in ranges)
    return {
        "server resident MB": int(lines["VmRSS"].split()[0]) / 1024,
        "server locked MB": int(lines["VmLck"].split()[0]) / 1024,
        "zenoh in /dev/shm MB": shared / 2**20,
    }


def faults(o: argparse.Namespace, limit: Limit, keep: Callable[[Row], None]) -> dict[str, str]:
    """Rows to `keep`; returns what was skipped and why. What needs a network of its own has a quiet run on it too."""
    skipped: dict[str, str] = {}
    there = [name for name in o.only if name in THERE]
    for name in [n for n in o.only if n in HERE] + ([page.QUIET_THERE] if there else []) + there:
        if limit.reached(name):
            continue
        try:
            if name in HERE:
                keep(run(name, HERE[name], Stage(device=o.device), o))
                continue
            with Cable() as cable:
                fault = quiet if name == page.QUIET_THERE else THERE[name](cable)
                keep(run(name, fault, Stage(ADDRESS, cable.far, o.device), o, "--no-shared-memory"))
        except Unavailable as why:
            skipped[name] = str(why)
            say(f"skipped: {name}: {why}")
        except Exception as error:  # the others are worth having
            say(f"FAILED: {name}: {type(error).__name__}: {error}")
    return skipped


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=0.2, help="of killing workers one after another")
    parser.add_argument("--every", type=float, default=4.0, help="seconds from one of these to the next")
    parser.add_argument("--lives", type=int, default=10, help="workers killed one after another, for the memory")
    parser.add_argument("--cut", type=float, default=6.0, help="seconds without a network")
    parser.add_argument("--only", nargs="+", choices=[*HERE, *THERE, "lives"], help="these alone")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu", help="of the server")
    parser.add_argument("--worker-device", choices=("cpu", "gpu"), default="cpu", help="of its workers")
    parser.add_argument("--quick", action="store_true", help="kill alone, beside the quiet run")
    arguments_of_pieces(parser)
    o = parser.parse_args()
    o.only = o.only or (["quiet", "kill"] if o.quick else [*HERE, *THERE, "lives"])
    return o


def main() -> None:
    o = options()
    if o.merge:
        merged = Merged("faults", TITLE, o.merge, o.out)
        page.write(merged, *page.merged([part["data"] for part in merged.parts]))
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that processes and namespaces go too
    if "gpu" in (o.device, o.worker_device):
        from sim_server.backends.gpu.device import cupy
        from sim_server.errors import DeviceError

        try:
            cupy()
        except DeviceError as error:
            raise SystemExit(f"bench faults: skipped: {error}") from None
    names = ("minutes", "every", "lives", "cut", "only", "device", "worker_device", *(["quick"] if o.quick else []))
    report, limit = Piece("faults", TITLE, {name: getattr(o, name) for name in names}, o.out, o.quick), Limit(o.limit)
    rows: list[Row] = []
    report.data.update(rows=rows, lives=[], skipped={})

    def keep(row: Row) -> None:
        rows.append(row)
        say(shown(row))
        report.keep()

    skipped = faults(o, limit, keep)
    found = lives(o, limit) if "lives" in o.only and not limit.reached("lives") else []
    limit.tell()
    page.write(report, rows, found, skipped)


if __name__ == "__main__":
    main()
