# SPDX-License-Identifier: MIT
"""What a step costs on a GPU: bending beams of 540 to 1,029,000 tetrahedra, alone and many at once, beside others.

Beside ours with a factor at most 16 steps old: ours with plain CG and block Jacobi, cuSPARSE's triangular solves, a
sparse explicit inverse, CuPy's cg and cuDSS on the same matrices; and ours with a real worker process. A run may be cut
into pieces (--only, --sizes, --materials) whose results --merge makes into one page, where there need be no GPU.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from sim_server.errors import DeviceError
from tests.bench.gpu import page
from tests.bench.gpu.problem import BARS, BATCHES, MATERIALS, Problem
from tests.bench.harness.pieces import Piece
from tests.bench.harness.report import Report

SECTIONS = ("steps", "batches", "others", "served", "realtime", "linearizations")
REAL_TIME, REAL_DT = (24_000, 98_304), 0.01  # sizes; s
ROUNDS = {540: 20, 3000: 20, 7350: 20, 24_000: 12, 98_304: 6, 405_600: 3, 1_029_000: 2}
WITHOUT = {540: 4, 3000: 4, 7350: 2, 24_000: 2, 98_304: 2, 405_600: 1, 1_029_000: 1}  # steps of CG in each round

Rows = list[dict[str, Any]]
Data = dict[str, Any]


class Page(Report):
    """A report whose head is that of the run that made its figures."""

    def __init__(self, header: dict[str, Any], arguments: dict[str, Any], out: Path | None):
        super().__init__("gpu", TITLE, arguments, out, quick=True)
        self.quick, self._given = bool(arguments.get("quick")), header

    def header(self) -> dict[str, Any]:
        """As given."""
        return self._given


TITLE = "A step on a GPU"


def beams(problem: Problem, o: argparse.Namespace, external: bool) -> dict[str, Rows]:
    """Row of one scene, rows of others on its last matrix."""
    from tests.bench.gpu.others import compared
    from tests.bench.gpu.rows import row
    from tests.bench.gpu.steps import Beams, rounds

    begin = time.perf_counter()
    scene = Beams(problem, o.library, overrides=tuple(o.set))
    ready = time.perf_counter()
    count = ROUNDS[problem.tets] if problem.beams == 1 else 4 if problem.beams < 256 else 2
    found = rounds(scene, 2 if o.quick else count, WITHOUT[problem.tets] if problem.beams == 1 else 1)
    rows = [row(scene, found)]
    print(rows[0], flush=True)
    others: Rows = []
    if external and found.sample is not None:
        sample = found.sample
        del scene, found  # their memory
        others = compared(sample, problem.tets, problem.material, 10 if o.quick else 50)
    print(f"{problem.name}: {ready - begin:.1f} s to load, {time.perf_counter() - ready:.1f} s", flush=True)
    return {"steps": rows, "others": others}


def with_workers(problem: Problem, o: argparse.Namespace) -> dict[str, Rows]:
    """Rows with each kind of worker, and with matrices leaving."""
    from tests.bench.gpu.served import measure as served

    rows, publishing = served(problem, 1.0, overrides=tuple(o.set))
    return {"served": rows, "publishing": publishing}


def searched(tets: int, o: argparse.Namespace) -> dict[str, Rows]:
    """Rows with several linearizations, and of what it takes to know that one is enough."""
    return {"linearizations": searches(tets, o), "trial": trial(tets, o)}


def searches(tets: int, o: argparse.Namespace) -> Rows:
    """Rows of a beam with several linearizations a step."""
    from tests.bench.gpu.rows import search_row
    from tests.bench.gpu.steps import SEARCHES, Beams, rounds

    problem, found = Problem(tets, law="stable_neo_hookean", dt=0.02), []
    for search in SEARCHES:
        overrides = ("solver.projection=clamp", *search.overrides, *o.set)
        scene = Beams(problem, o.library, overrides=overrides)
        found.append(search_row(scene, search, rounds(scene, 2 if o.quick else ROUNDS[tets], 0)))
        print(found[-1], flush=True)
    return found


def trial(tets: int, o: argparse.Namespace) -> Rows:
    """Row of what it takes to know that one linearization is enough."""
    from tests.bench.gpu.trial import parts

    found = parts(tets, 2 if o.quick else ROUNDS[tets], o.library, tuple(o.set))
    print(found, flush=True)
    return [found]


def in_real_time(tets: int, o: argparse.Namespace) -> dict[str, Rows]:
    """Row of a server in real time with a worker on the same GPU."""
    from tests.bench.gpu.first_factor import measure as real_time

    row = real_time(tets, seconds=2.0 if o.quick else 4.0, dt=REAL_DT)
    print(row, flush=True)
    return {"realtime": [row]}


def measure(o: argparse.Namespace, keep: Callable[[Data], None]) -> Data:
    """All sections asked for, and what the device is. keep: gets what there is so far after each scene."""
    from tests.bench.gpu.cudss import version
    from tests.bench.gpu.device import described

    data: Data = {name: [] for name in page.KEYS}
    data["device"] = described() | {"cuDSS": version()}
    print(data["device"], flush=True)
    for name, run in scenes(o):
        for section, rows in guarded(name, run).items():
            data[section] += [{"settings": " ".join(o.set), **row} for row in rows]
        keep(data)
    return data


def scenes(o: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Rows]]]]:
    """Name of each scene asked for, and what measures it: rows of sections."""
    from tests.bench.gpu.served import SIZES
    from tests.bench.gpu.steps import SEARCHED

    problems = [Problem(tets, m) for tets in o.sizes for m in o.materials] if {"steps", "others"} & {*o.only} else []
    if "batches" in o.only:
        problems += [Problem(tets, MATERIALS[0], n) for n, tets in BATCHES if 1 < n <= o.beams]
    for problem in problems:
        external = problem.beams == 1 and problem.material == MATERIALS[0] and "others" in o.only
        yield problem.name, partial(beams, problem, o, external)
    for tets in (t for t in o.sizes if "served" in o.only and t in SIZES):
        for problem in (Problem(tets, material) for material in o.materials):
            yield problem.name, partial(with_workers, problem, o)
    for tets in (t for t in o.sizes if "realtime" in o.only and t in REAL_TIME):
        yield f"{tets} tets in real time", partial(in_real_time, tets, o)
    for tets in (t for t in o.sizes if "linearizations" in o.only and t in SEARCHED):
        yield f"{tets} tets", partial(searched, tets, o)


def guarded(name: str, run: Callable[[], dict[str, Rows]]) -> dict[str, Rows]:
    """What `run` returns; where it fails, a line that says so, and nothing, so that the rest goes on."""
    try:
        return run()
    except Exception as error:
        print(f"FAILED {name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return {}


def merge(files: list[Path], out: Path | None) -> None:
    """One page of the results of several runs; the head is that of the last."""
    parts = [json.loads(file.read_text()) for file in files]
    last, several = parts[-1], len(parts) > 1
    report = Page(last["header"], {"pieces": len(parts)} if several else last["arguments"], out)
    if several:
        report.say("Put together of several runs, the last one described above:")
        report.table(
            [
                {**{k: part["header"][k] for k in ("date", "commit")}, "gpu": part["data"]["device"]["gpu"]}
                | _words(part["arguments"])
                for part in parts
            ]
        )
    page.write(report, page.merged([part["data"] for part in parts]))


def _words(arguments: dict[str, Any]) -> dict[str, str]:
    return {k: " ".join(map(str, v)) if isinstance(v, list) else str(v) for k, v in arguments.items()}


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--sizes", type=int, nargs="+", choices=list(BARS), help="of one beam [default: all]")
    parser.add_argument("--materials", nargs="+", choices=MATERIALS, default=list(MATERIALS))
    parser.add_argument("--beams", type=int, default=1024, help="largest batch")
    parser.add_argument("--library", default="auto", help="that factorizes: auto, gpu, cholmod, supernodal")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of every scene")
    parser.add_argument(
        "--quick", action="store_true", help="two rounds; 540 and 3000 tets unless --sizes; batches up to 16"
    )
    parser.add_argument("--merge", type=Path, nargs="+", metavar="JSON", help="only make one page of these results")
    parser.add_argument("--out", type=Path)
    o = parser.parse_args()
    o.sizes = o.sizes or ([540, 3000] if o.quick else list(BARS))
    o.beams = min(o.beams, 16) if o.quick else o.beams
    return o


def main() -> None:
    o = options()
    if o.merge:
        merge(o.merge, o.out)
        return
    try:
        from sim_server.backends.gpu.device import cupy

        cupy()
    except DeviceError as error:
        print(f"bench gpu: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    words = {k: getattr(o, k) for k in ("only", "sizes", "materials", "beams", "library")}
    words |= {k: getattr(o, k) for k in ("set", "quick") if getattr(o, k)}
    report = Piece("gpu", TITLE, words, o.out, o.quick)

    def keep(data: Data) -> None:
        report.data |= page.merged([data])
        report.keep()

    page.write(report, page.merged([measure(o, keep)]))


if __name__ == "__main__":
    main()
