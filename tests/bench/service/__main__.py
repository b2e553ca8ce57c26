# SPDX-License-Identifier: MIT
"""What the thread that serves a loop takes in: factors a second of many small beams, and what each costs it.

    deploy/run bench service
    deploy/run bench service --name "an older commit" --out a        there, then
    deploy/run bench service --merge a/service.json b/service.json

The loop is a stand-in at the pace of a GPU and the worker answers at once (paced.py), so that what is measured is the
service thread.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from typing import Any

import numpy as np

from tests.bench.harness.pieces import Limit, Merged, Piece, arguments_of_pieces, say, shown
from tests.bench.harness.report import Report
from tests.bench.service.paced import Served

TITLE = "What the service thread takes in"
SIZES = (64, 256, 512, 1024)
FIRST = 150.0  # s until measuring begins, though not every beam has had two factors
KEYS = ("name", "objects", "begun")
COLUMNS = ("name", "objects", "factors/s", "us a factor", "calls a factor", "factors a round", "busy", "steps/s",
           "age p50", "age p99", "age max", "of a beam")  # fmt: skip
WORDS = """Beams of {tets} tetrahedra at {rate:g} steps a second. The loop is a stand-in that reports solves, whose
iterations grow with the age of the factor, and copies matrices; the worker, a process of its own, answers each matrix
at once with the factor that it has made of it before. Driver, network, shared memory, checks and mailboxes are the
product's. *us a factor*: processor time of the service thread, all that it does in its rounds but for the stand-in,
over the factors that the loop was given. *calls a factor*: calls of Python functions in it, which do not depend on the
machine. *busy*: part of the time in which the thread has a processor. Age: of the factor of a solve [steps],
from when every beam has had two, so that none waits for the others to get their first one. *of a beam*: factors that a
beam was given meanwhile, the least and the most of all beams. Several
rounds of one size follow one another; the median by *us a factor* is shown, and the least and largest beside it."""

Row = dict[str, Any]


def measure(objects: int, tets: int, rate: float, seconds: float, name: str) -> Row:
    """A row: measured for `seconds`, then half as long with calls counted."""
    with Served(objects, tets, rate) as served:
        used, loop = served.driver.table.used, served.loop
        end = time.monotonic() + FIRST
        while used.min() < 2 and time.monotonic() < end:
            served.round()
        rounds, found, before = 0, [], used.copy()
        posted, spent, busy, begun, step = loop.posted, loop.spent, time.thread_time(), time.monotonic(), loop.step
        while time.monotonic() < begun + seconds:
            found.append(served.round())
            rounds += 1
        lasted, busy = time.monotonic() - begun, time.thread_time() - busy - (loop.spent - spent)
        factors, steps, given = loop.posted - posted, loop.step - step, used - before
        calls = counted_calls(served, seconds / 2)
    r = np.concatenate(found)
    age = (r["step"] - 1 - r["factor_step"])[r["factor_step"] >= 0]
    return {
        "name": name, "objects": objects, "begun": int(time.time()), "factors/s": factors / lasted,
        "us a factor": 1e6 * busy / max(factors, 1), "calls a factor": calls, "factors a round": factors / rounds,
        "busy": busy / lasted, "steps/s": steps / lasted, "age p50": float(np.percentile(age, 50)),
        "age p99": float(np.percentile(age, 99)), "age max": int(age.max()),
        "of a beam": f"{given.min()} – {given.max()}",
    }  # fmt: skip


def counted_calls(served: Served, seconds: float) -> float:
    """Calls of Python functions, over the factors posted."""
    calls = [0]

    def count(frame: Any, event: str, argument: Any) -> None:
        calls[0] += event in ("call", "c_call") and not served.loop.stepping

    posted, end = served.loop.posted, time.monotonic() + seconds
    sys.setprofile(count)
    try:
        while time.monotonic() < end:
            served.round()
    finally:
        sys.setprofile(None)
    return calls[0] / max(served.loop.posted - posted, 1)


def medians(rows: list[Row]) -> list[Row]:
    """Of the rounds of each name and size the one in the middle by time of the thread, with the spread of that."""
    out = []
    for name, objects in sorted({(r["name"], r["objects"]) for r in rows}, key=lambda k: (k[1], k[0])):
        own = sorted((r for r in rows if (r["name"], r["objects"]) == (name, objects)), key=lambda r: r["us a factor"])
        middle, times = own[len(own) // 2], [r["us a factor"] for r in own]
        spread = f"{times[0]:.0f} – {times[-1]:.0f}" if len(own) > 1 else None
        out.append({**{k: middle[k] for k in COLUMNS}, "least – largest": spread, "rounds": len(own)})
    return out


def write(report: Report, rows: list[Row], tets: int, rate: float) -> None:
    """Page and JSON."""
    report.say(" ".join(WORDS.format(tets=tets, rate=rate).split("\n")))
    report.table(medians(rows))
    report.data["rows"] = rows
    report.remember(medians(rows), ("name", "objects"), ("us a factor", "calls a factor"))
    report.write()


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--objects", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--tets", type=int, default=540, choices=(540, 3000))
    parser.add_argument("--rate", type=float, default=400.0, help="steps a second of the loop")
    parser.add_argument("--seconds", type=float, default=4.0, help="measured for each row")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--name", default="now", help="of these rows, to tell them from others on one page")
    parser.add_argument("--quick", action="store_true", help="few beams, an instant")
    arguments_of_pieces(parser)
    o = parser.parse_args()
    if o.quick:
        o.objects, o.seconds, o.rounds = [8, 16], 0.5, 1
    return o


def main() -> None:
    o = options()
    if o.merge:
        merged = Merged("service", TITLE, o.merge, o.out)
        told = merged.parts[-1]["arguments"]
        write(merged, merged.rows("rows", KEYS), told["tets"], told["rate"])
        return
    arguments = {k: getattr(o, k) for k in ("objects", "tets", "rate", "seconds", "rounds", "name", "quick")}
    report, limit, rows = Piece("service", TITLE, arguments, o.out, o.quick), Limit(o.limit), []
    for number in range(o.rounds):
        for objects in o.objects:
            if limit.reached(f"{objects} objects, round {number}"):
                continue
            rows.append(measure(objects, o.tets, o.rate, o.seconds, o.name))
            say(shown(rows[-1]))
            report.data["rows"] = rows
            report.keep()
    limit.tell()
    if not rows:
        raise SystemExit("bench service: nothing was measured")
    write(report, rows, o.tets, o.rate)


if __name__ == "__main__":
    main()
