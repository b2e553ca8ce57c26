# SPDX-License-Identifier: MIT
"""How fast this checkout is beside another one, on the same machine in one run and where it can be in turns.

Units: threads:TETS[:TURNS], sofa:TETS, steps:TETS[:heterogeneous|:BEAMS], real_time:TETS, many:TETS:BEAMS,
swinging:TETS:BEAMS, vbd:TETS.
--other names a checkout of another commit (`git worktree add DIR COMMIT`); without it this one is measured alone.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.bench.gpu.problem import Problem
from tests.bench.harness.pieces import Limit, Merged, Piece, arguments_of_pieces, say, shown
from tests.bench.harness.report import ROOT
from tests.bench.speed import page, turns
from tests.bench.speed.turns import Row, Sides

TITLE, SIDES = "Speed, before and after", ("before", "after")
TURNS = {540: 24, 3000: 24, 24000: 24, 98304: 4}  # of threads, by size
ROUNDS = {540: 20, 3000: 20, 24_000: 16, 98_304: 8, 405_600: 4, 1_029_000: 2}  # of one beam on a GPU
BATCH_ROUNDS, LONG = 4, 256  # of many beams; steps without a pause
QUICK = ("threads:540:2", "sofa:540", "steps:540", "real_time:540", "many:540:2", "swinging:540:2", "vbd:540")
UNITS = (
    "threads:24000", "threads:98304", "sofa:540", "sofa:3000", "sofa:7350", "sofa:24000", "steps:24000",
    "steps:24000:heterogeneous", "steps:98304", "steps:405600", "steps:1029000", "steps:540:512", "steps:540:1024",
    "steps:3000:256", "real_time:24000", "real_time:98304", "many:540:512", "many:540:1024",
    "swinging:540:512", "swinging:540:1024", "vbd:3000",
)  # fmt: skip
ONE_BY_ONE = ("real_time", "many", "swinging")
DT, VBD_DT = 0.03, 0.02  # s, of steps in real time; of the scene of Newton's VBD


def measured(sides: Sides, unit: str, o: argparse.Namespace) -> list[Row]:
    """Rows of one unit."""
    kind, size, *rest = unit.split(":")
    tets, gpu = int(size), o.device == "gpu"
    devices: dict[str, Any] = {"device": o.device, "worker": o.device}
    if kind == "threads":
        return turns.threads(sides, tets, o.threads, int(rest[0]) if rest else TURNS[tets])
    if kind == "sofa":
        return turns.sofa(sides, tets, 1 if o.quick else o.rounds)
    if kind == "steps":
        beams = next((int(word) for word in rest if word.isdigit()), 1)
        material = next((word for word in rest if word.isalpha()), "homogeneous")
        rounds = 1 if o.quick else ROUNDS[tets] if beams == 1 else BATCH_ROUNDS
        library = "gpu" if gpu and tets >= 24_000 else "auto"
        long = 0 if beams == 1 else LONG
        return turns.steps(sides, Problem(tets, material, beams), rounds, library, o.device, long, o.set)
    if kind == "real_time":
        order = {"text": Problem(tets, dt=DT).text(), "seconds": o.seconds, "dt": DT}
        return turns.in_turn(sides, kind, {"tets": tets}, **order, **devices)
    if kind == "many":
        beams = int(rest[0])
        order = {"text": Problem(tets, beams=beams).text(), "seconds": o.seconds, "first": o.first}
        return turns.in_turn(sides, kind, {"tets": tets, "beams": beams}, **order, **devices)
    if kind == "swinging":
        beams = int(rest[0])
        order = {"beams": beams, "tets": tets, "seconds": o.seconds, "first": o.first}
        return turns.in_turn(sides, kind, {"tets": tets}, **order, **devices)
    if kind == "vbd":
        now = {SIDES[1]: sides[SIDES[1]]}  # older checkouts do not know such scenes
        text = Problem(tets, law="stable_neo_hookean", dt=VBD_DT).text().replace("rayleigh = { mass = 0.1 }\n", "")
        ours = ["integrator.linearizations=2", "solver.tolerance=1e-3"]
        exact = ["integrator.linearizations=20", "integrator.tolerance=1e-10", "solver.tolerance=1e-8"]
        return turns.motion(now, {"tets": tets}, text, ours, exact, o.device)
    raise SystemExit(f"bench speed: unit {unit!r}; allowed: {' '.join(UNITS)} and the like")


def groups(sides: Sides, unit: str) -> list[Sides]:
    """Those that are measured at once: servers one after the other, so that one is kept if the other fails."""
    if unit.startswith(ONE_BY_ONE):
        return [{name: side} for name, side in sides.items()]
    return [sides]


def commit_of(checkout: Path) -> str:
    """Of a checkout, as git tells it; "" where there is no git."""
    found = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=checkout, capture_output=True, text=True)
    return found.stdout.strip()


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="deploy/run bench speed", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--other", type=Path, metavar="DIR", help="checkout to compare with")
    parser.add_argument("--commit", help="of that checkout [default: as git says]")
    parser.add_argument("--units", nargs="+", default=list(UNITS), metavar="UNIT", help="[default: all]")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="gpu", help="of all but threads and sofa")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the scenes of steps")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2, 4, 8, 12])
    parser.add_argument("--rounds", type=int, default=2, help="of sofa")
    parser.add_argument("--seconds", type=float, default=4.0, help="of servers, each")
    parser.add_argument(
        "--first", type=float, default=10.0, help="s until each of many bodies has had two factors, at most"
    )
    parser.add_argument("--quick", action="store_true", help="a smoke run: this checkout beside itself on the CPU")
    arguments_of_pieces(parser)
    o = parser.parse_args()
    if o.quick:
        o.other, o.units, o.device, o.threads, o.seconds, o.first = ROOT, list(QUICK), "cpu", [1], 0.5, 1.0
    return o


def main() -> None:
    o = options()
    if o.merge:
        merged = Merged("speed", TITLE, o.merge, o.out)
        page.of_runs(merged.parts)
        page.write(merged, merged.rows("rows", page.KEYS))
        return
    checkouts = dict(zip(SIDES, (o.other, ROOT), strict=True)) if o.other else {SIDES[1]: ROOT}
    other = {"beside": o.commit or commit_of(o.other)} if o.other else {}
    report, limit = (
        Piece("speed", TITLE, {**other, "units": o.units, **({"set": o.set} if o.set else {})}, o.out, o.quick),
        Limit(o.limit),
    )
    machine = report.head()["machine"]
    place = {"cpu": f"{machine['cpu']}, {machine['cores']} cores", "gpu": machine["gpu"]}
    rows: list[Row] = []
    with turns.sides_of(checkouts) as sides:
        for unit in o.units:
            if limit.reached(unit):
                continue
            for group in groups(sides, unit):
                try:
                    found = measured(group, unit, o)
                except RuntimeError as error:
                    print(f"FAILED {unit} {' '.join(group)}: {error}", file=sys.stderr, flush=True)
                    continue
                on_cpu = o.device == "cpu" or unit.startswith(("threads", "sofa"))
                rows += [{**row, "on": place["cpu" if on_cpu else "gpu"]} for row in found]
                report.data["rows"] = rows
                report.keep()
                for row in found:
                    say(shown(row))
    limit.tell()
    page.write(report, rows)


if __name__ == "__main__":
    main()
