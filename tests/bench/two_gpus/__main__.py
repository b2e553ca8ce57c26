# SPDX-License-Identifier: MIT
"""One large body on one GPU and on two of a host: the same steps in turns, with a factor 1 to 16 steps old.

The beams are those of `bench gpu`. A run may be cut into pieces (--sizes) whose results --merge makes into one page.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.errors import InputError
from tests.bench.gpu.problem import BARS, Problem
from tests.bench.harness.pieces import Piece
from tests.bench.harness.report import Report

TITLE = "One body on two GPUs"
WORDS = (
    "The homogeneous beams of [a step on a GPU](gpu.md), `solver.gpus` 1 and 2 in turns: a round of 16 steps of one, "
    "with a factor 1 to 16 steps old, then one of the other; the first round warms up. Times are those of single steps "
    "on the device, iterations the mean. An iteration: solve over iterations, with the two true residuals of a "
    "solve. Factor: MB of the inverse, of which each GPU reads its part. Faster: p50 of a step on one GPU over that on "
    "two. Apart: largest distance of a node's two positions at the end."
)
SIZES = (98_304, 405_600, 1_029_000)
ROUNDS = 3

Row = dict[str, Any]


def compared(tets: int, rounds: int, library: str) -> list[Row]:
    """Rows of a beam on one GPU and on two."""
    from tests.bench.gpu.steps import STEPS, Beams, Found, renewed

    scenes = {gpus: Beams(Problem(tets), library, overrides=(f"solver.gpus={gpus}",)) for gpus in (1, 2)}
    found = {gpus: Found() for gpus in scenes}
    for gpus, scene in scenes.items():
        renewed(scene, found[gpus])
    for k in range(rounds + 1):
        for gpus, scene in scenes.items():
            records = scene.run(STEPS)
            if k:
                found[gpus].records.append(records)
            if k < rounds:
                renewed(scene, found[gpus])
    rows = [row(scene, np.concatenate(found[gpus].records), gpus) for gpus, scene in scenes.items()]
    rows[1]["faster"] = rows[0]["us p50"] / rows[1]["us p50"]
    x = [scene.sim.fetch().x for scene in scenes.values()]
    rows[1]["apart m"] = float(np.linalg.norm(x[0] - x[1], axis=1).max())
    return rows


def row(scene: Any, records: np.ndarray, gpus: int) -> Row:
    """Figures of one of them."""
    from protocol import messages_pb2 as pb

    whole, solve = 1e6 * records["whole"], 1e6 * records["solve"]
    p50, p99, most = (float(np.percentile(whole, q)) for q in (50, 99, 100))
    return {
        "tets": scene.problem.tets, "GPUs": gpus, "us p50": p50, "us p99": p99, "us max": most,
        "solve us": float(np.median(solve)), "iterations": float(records["iterations"].mean()),
        "us an iteration": float(np.median(solve / records["iterations"])), "faster": None,
        "factor MB": scene.engine.factor_bytes(0) / 1e6,
        "unconverged": int((records["status"] != pb.CONVERGED).sum()), "apart m": None,
    }  # fmt: skip


def write(report: Report, data: dict[str, Any]) -> None:
    """The page. data: device, rows; notes: of how some were measured"""
    device, rows = data["device"], data["rows"]
    report.data |= data
    report.say(
        f"Two {device['gpu']} of one host, driver {device['driver']}, CUDA {device['CUDA']}.",
        WORDS,
        *data.get("notes", []),
    )
    report.say("## Steps")
    report.table(rows)
    report.remember([r for r in rows if r["GPUs"] == 2], ("tets",), ("us p50", "faster"))
    report.write()


def merge(files: list[Path], out: Path | None) -> None:
    """One page of several runs; the head is that of the last."""
    parts = [json.loads(file.read_text()) for file in files]

    class Merged(Report):
        def header(self) -> dict[str, Any]:
            return parts[-1]["header"]

    rows = {
        (r["tets"], r["GPUs"]): {**r, "commit": part["header"]["commit"]}
        for part in parts
        for r in part["data"]["rows"]
    }
    report = Merged("two_gpus", TITLE, {"pieces": len(parts)}, out, quick=True)
    report.quick = False
    notes = [note for part in parts for note in part["data"].get("notes", [])]
    device = parts[-1]["data"]["device"]
    write(report, {"device": device, "rows": [rows[key] for key in sorted(rows)], "notes": notes})


def main() -> None:
    """Measures, or merges."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", choices=list(BARS), default=list(SIZES))
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="of 16 steps, that count")
    parser.add_argument("--library", default="gpu", help="that factorizes")
    parser.add_argument("--merge", type=Path, nargs="+", metavar="JSON", help="only make one page of these results")
    parser.add_argument("--out", type=Path)
    o = parser.parse_args()
    if o.merge:
        merge(o.merge, o.out)
        return
    try:
        from sim_server.backends.gpu.device import cupy
        from sim_server.backends.gpu.helper import connect

        connect(cupy(), 0, 1)
    except InputError as error:
        print(f"bench two_gpus: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    from tests.bench.gpu.device import described

    report, device = Piece("two_gpus", TITLE, {"sizes": o.sizes, "rounds": o.rounds}, o.out), described()
    rows = list[Row]()
    for tets in o.sizes:
        rows += compared(tets, o.rounds, o.library)
        print(*rows[-2:], sep="\n", flush=True)
        report.data |= {"device": device, "rows": rows}
        report.keep()
    write(report, {"device": device, "rows": rows})


if __name__ == "__main__":
    main()
