# SPDX-License-Identifier: MIT
"""Hostile inputs for as long as asked: scenes, meshes, logs and wire messages by seed; what is found is kept.

Inputs are made and read in batches, each in a process of its own: one that crashes or hangs is a finding,
too. The input of a finding goes to tests/fuzz/cases, where it is a test of its own; so mend what it shows
before you commit it.
"""

import argparse
import logging
import multiprocessing
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tests.bench.harness.report import Report, plots
from tests.fuzz import inputs, targets
from tests.fuzz.found import keep

TITLE = "Hostile inputs"
BATCH = {"scene": 200, "mesh": 400, "log": 400, "wire": 2000}
LONGEST = 120.0  # s of a batch, in which SIGALRM may wait for native code
COLUMNS = ("kind", "inputs", "accepted", "refused", "findings", "seconds", "inputs/s", "longest ms")
WORDS = """*scene*: a scene of deploy/scenes with one to three values, keys or tables changed, at times bytes, too;
read as by `sim-server`. *mesh*: a box in six formats, text and binary, bytes changed or numbers replaced;
read and checked. *log*: bytes of a log changed, by each compression; all frames read as by `sim-client
export`, and compared with those that were written. *wire*: messages of the schema whose fields are left out
or replaced by what their types can hold, at times bytes; read as by who receives them, patterns of factors
checked, commands carried out on a beam and a step made after each.

*refused*: in words for users. A finding is anything else: another exception, a message that does not name
the file, a wrong frame, a position that is not finite, more than {patience} s, a crash. Seeds run from
{seed} on; an input is that of its kind and seed, each time."""


def batch(kind: str, first: int, count: int, seeds: Any, result: "Connection") -> None:
    """Runs in a process of its own. seeds: a shared number, the seed in hand; result: gets what came of them."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    outcomes: Counter[bool] = Counter()
    found: list[tuple[int, str]] = []
    longest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, first + count):
            seeds.value, start = seed, time.perf_counter()
            try:
                outcomes[targets.accepted(kind, inputs.made(kind, seed), Path(folder))] += 1
            except (Exception, targets.TooLong):
                found.append((seed, traceback.format_exc(limit=-3)))
            longest = max(longest, time.perf_counter() - start)
    result.send((outcomes[True], outcomes[False], found, longest))
    result.close()


def tried(kind: str, first: int, count: int) -> dict[str, Any]:
    """Tries some seeds; returns counts and findings."""
    context = multiprocessing.get_context("fork")
    seed = context.Value("q", first)
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=batch, args=(kind, first, count, seed, there), daemon=True)
    start = time.perf_counter()
    process.start()
    there.close()
    try:
        accepted, refused, found, longest = here.recv() if here.poll(LONGEST) else _ended(process, "hangs", seed.value)
    except EOFError:
        process.join()
        accepted, refused, found, longest = _ended(process, _why(process.exitcode), seed.value)
    process.join()
    return {
        "accepted": accepted, "refused": refused, "found": found, "longest": longest,
        "inputs": accepted + refused + len(found), "seconds": time.perf_counter() - start,
    }  # fmt: skip


def _why(code: int | None) -> str:
    return f"ended by {signal.Signals(-code).name}" if code is not None and code < 0 else f"ended with {code}"


def _ended(process: Any, why: str, seed: int) -> tuple[int, int, list[tuple[int, str]], float]:
    process.kill()
    return 0, 0, [(seed, why)], 0.0


def main() -> None:
    parser = argparse.ArgumentParser(prog="deploy/run bench fuzz", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smoke run of few inputs")
    parser.add_argument("--out", type=Path, help="folder for the results (default: out/bench/fuzz)")
    parser.add_argument("--minutes", type=float, default=5.0, help="how long [min]")
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    parser.add_argument("--only", nargs="+", choices=inputs.KINDS, default=list(inputs.KINDS), help="kinds of inputs")
    options = parser.parse_args()
    rows = {kind: dict.fromkeys(COLUMNS, 0) | {"kind": kind} for kind in options.only}
    arguments = {"minutes": options.minutes, "seed": options.seed, "kinds": options.only}
    report = Report("fuzz", TITLE, arguments, options.out, options.quick)
    end, findings, rounds = time.monotonic() + 60 * options.minutes, [], 0
    while rounds == 0 or (time.monotonic() < end and not options.quick):
        for kind in options.only:
            count = 20 if options.quick else BATCH[kind]
            got = tried(kind, options.seed + rounds * count, count)
            row = rows[kind]
            for name in ("inputs", "accepted", "refused", "seconds"):
                row[name] += got[name]
            row["longest ms"] = max(row["longest ms"], 1e3 * got["longest"])
            for seed, why in got["found"]:
                row["findings"] += 1
                file = keep(kind, seed, options.out)
                findings.append({"kind": kind, "seed": seed, "what": why.strip().splitlines()[-1][:200]})
                print(f"FOUND {kind} {seed}, kept as {file}:\n{why}", flush=True)
        rounds += 1
    for row in rows.values():
        row["inputs/s"] = row["inputs"] / row["seconds"]
    report.say(WORDS.format(patience=targets.PATIENCE, seed=options.seed))
    report.table(list(rows.values()), COLUMNS)
    report.say("## What was found")
    if findings:
        report.table(findings)
    else:
        report.say("Nothing.")
    report.figure(picture(list(rows.values())), "fuzz.png", "Inputs of each kind, and what became of them")
    report.data |= {"kinds": list(rows.values()), "findings": findings}
    report.write()


def picture(rows: list[dict[str, Any]]) -> Any:
    """Inputs by kind, accepted and refused."""
    plt = plots()
    figure, ax = plt.subplots(figsize=(7, 2.5), layout="constrained")
    left = [0] * len(rows)
    for name in ("accepted", "refused", "findings"):
        ax.barh([row["kind"] for row in rows], [row[name] for row in rows], left=left, label=name)
        left = [a + row[name] for a, row in zip(left, rows, strict=True)]
    ax.set(xlabel="inputs")
    ax.legend()
    return figure


if __name__ == "__main__":
    main()
