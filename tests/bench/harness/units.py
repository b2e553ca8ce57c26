# SPDX-License-Identifier: MIT
"""Benchmarks whose tables are made a few rows at a time, in any order, on any machine, several processes at once."""

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from tests.bench.harness.pieces import Limit, Piece, Row, say


@dataclass(frozen=True)
class Unit:
    """rows: measures them. weight: seconds that it takes, about; they are dealt out by it."""

    table: str
    what: str
    weight: float
    rows: Callable[[], list[Row]]

    @property
    def name(self) -> str:
        return f"{self.table} {self.what}"


def arguments_of_units(parser: argparse.ArgumentParser, example: str) -> None:
    """--only, --share, --list."""
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help=f"what begins so, as {example}; --list tells all"
    )
    parser.add_argument("--share", type=share, default=(1, 1), metavar="K/N", help="the K-th of N parts of it")
    parser.add_argument("--list", action="store_true", help="only say what would be measured")


def share(text: str) -> tuple[int, int]:
    """K/N with 1 <= K <= N."""
    if not (found := re.fullmatch(r"(\d+)/(\d+)", text)) or not 1 <= int(found[1]) <= int(found[2]):
        raise argparse.ArgumentTypeError(f"{text}: allowed is K/N, K from 1 to N")
    return int(found[1]), int(found[2])


def asked_for(o: argparse.Namespace) -> dict[str, Any]:
    """What a report says of these options."""
    part = {"share": f"{o.share[0]}/{o.share[1]}"} if o.share[1] > 1 else {}
    return ({"only": o.only} if o.only else {}) | part


def chosen(all_units: Sequence[Unit], o: argparse.Namespace) -> list[Unit]:
    """What the options want of them. Ends the program: after --list, or if a word of --only means none."""
    for word in o.only:
        if not any(unit.name.startswith(word) for unit in all_units):
            raise SystemExit(f"--only {word!r}: nothing begins so; there are: {'; '.join(u.name for u in all_units)}")
    found = [unit for unit in all_units if not o.only or unit.name.startswith(tuple(o.only))]
    found = _dealt(found, *o.share) if o.share[1] > 1 else found
    if o.list:
        say("\n".join(unit.name for unit in found))
        raise SystemExit(0)
    return found


def _dealt(all_units: Sequence[Unit], k: int, n: int) -> list[Unit]:
    """The part of the k-th of n: the heaviest first, each to whoever has least."""
    loads, parts = [0.0] * n, [list[Unit]() for _ in range(n)]
    for unit in sorted(all_units, key=lambda unit: -unit.weight):
        least = loads.index(min(loads))
        loads[least] += unit.weight
        parts[least].append(unit)
    return parts[k - 1]


def measure(units: Sequence[Unit], limit: Limit, report: Piece) -> dict[str, list[Row]]:
    """Rows by table; what there is of them lies in the JSON at any time. Ends the program if there are none."""
    tables: dict[str, list[Row]] = {}
    for unit in units:
        if limit.reached(unit.name):
            continue
        try:
            rows = unit.rows()
        except Exception as error:  # the others are worth having
            say(f"FAILED: {unit.name}: {type(error).__name__}: {error}")
            continue
        tables.setdefault(unit.table, []).extend(rows)
        report.data |= tables
        report.keep()
        say(f"{unit.name}: done")
    limit.tell()
    if not tables:
        raise SystemExit(f"bench {report.name}: nothing was measured")
    return tables
