# SPDX-License-Identifier: MIT
"""Tables 1, 2 and 5 and figure 4 of Courtecuisse et al. 2010, measured here, each beside the paper's own figures.

    deploy/run bench paper                                           all of it
    deploy/run bench paper --only table1 "table2 bend, springs" --limit 500 --out a
    deploy/run bench paper --share 3/16 --limit 500 --out 3          the third of 16 processes that run at once
    deploy/run bench paper --merge a/paper.json 3/paper.json

Pieces that are made at once share the memory and the clock of the machine: iterations are the same, times may not be.
`publishing` sets its threads and its worker on cores of their own, the first of those that it may use: best run alone,
or under taskset.
"""

import argparse
from typing import Any

from tests.bench.harness.pieces import Limit, Merged, Piece, arguments_of_pieces
from tests.bench.harness.units import arguments_of_units, asked_for, chosen, measure
from tests.bench.paper import page
from tests.bench.paper.tables import Setting
from tests.bench.paper.units import KEYS, units

TITLE = "The tables of Courtecuisse et al. 2010"
MEASURED = ("steps", "rounds", "latency", "tolerance")  # arguments of a setting


def devices(wanted: str) -> list[str]:
    """auto: the CPU and, where there is one, the GPU."""
    if wanted in ("cpu", "gpu"):
        return [wanted]
    from sim_server.startup.device import choose_device

    return ["cpu"] if choose_device("auto", print) == "cpu" else ["cpu", "gpu"]


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=150, help="of each run")
    parser.add_argument("--rounds", type=int, default=3, help="repetitions, the schemes taking turns")
    parser.add_argument("--latency", type=int, default=3, help="steps from a matrix to its factor, tables 2 and 5")
    parser.add_argument("--tolerance", type=float, default=1e-6, help="of the true residual")
    parser.add_argument("--device", choices=("auto", "cpu", "gpu"), default="auto", help="auto: both, if there")
    arguments_of_units(parser, f"{', '.join(KEYS)}, 'table2 bend, springs'")
    parser.add_argument("--quick", action="store_true", help="a small smoke run")
    arguments_of_pieces(parser)
    o = parser.parse_args()
    if o.steps < 2 or o.rounds < 1 or o.latency < 1 or not 0 < o.tolerance < 1:
        parser.error("allowed: --steps 2 or more, --rounds and --latency 1 or more, --tolerance between 0 and 1")
    return o


def setting_of(arguments: dict[str, Any]) -> Setting:
    """As given, or as in the JSON of a piece."""
    return Setting(*(arguments[name] for name in MEASURED), bool(arguments.get("quick")))


def merge(o: argparse.Namespace) -> None:
    """One page of several pieces; where two have measured the same, the later one counts."""
    merged = Merged("paper", TITLE, o.merge, o.out)
    settings = {setting_of(part["arguments"]) for part in merged.parts}
    if len(settings) > 1:
        raise SystemExit(f"bench paper: the pieces differ in {', '.join(MEASURED)} or --quick: {settings}")
    page.write(merged, settings.pop(), {name: merged.rows(name, keys) for name, keys in KEYS.items()})


def main() -> None:
    o = options()
    if o.merge:
        merge(o)
        return
    arguments: dict[str, Any] = {name: getattr(o, name) for name in (*MEASURED, "device")}
    if o.quick:
        arguments |= {"steps": 12, "rounds": 2, "quick": True}
    setting = setting_of(arguments)
    wanted = chosen(units(setting, devices(o.device), processes=not o.quick or bool(o.only)), o)
    report = Piece("paper", TITLE, arguments | asked_for(o), o.out, o.quick)
    page.write(report, setting, measure(wanted, Limit(o.limit), report))


if __name__ == "__main__":
    main()
