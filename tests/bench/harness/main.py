# SPDX-License-Identifier: MIT
"""The main program of a benchmark whose tables are made of units: its options, its pieces, its page."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from tests.bench.harness.pieces import Limit, Merged, Piece, Row, arguments_of_pieces
from tests.bench.harness.report import Report
from tests.bench.harness.units import Unit, arguments_of_units, asked_for, chosen, measure


@dataclass(frozen=True)
class Bench:
    """name: of the benchmark; title: of its page; keys: by table what tells its rows apart; write: makes the page."""

    name: str
    title: str
    keys: dict[str, tuple[str, ...]]
    write: Callable[[Report, dict[str, list[Row]]], None]

    def options(
        self, description: str | None, example: str, sizes: Sequence[int] = (), usual: Sequence[int] = (),
        sizes_of: str = "",
    ) -> argparse.ArgumentParser:  # fmt: skip
        """The options that all have. example: of --only; sizes_of: the tables that --sizes is for, if there are any."""
        parser = argparse.ArgumentParser(description=(description or "").split("\n\n")[0])
        parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
        if sizes:
            parser.add_argument("--sizes", type=int, nargs="+", choices=list(sizes), default=list(usual), help=sizes_of)
        arguments_of_units(parser, f"{', '.join(self.keys)}, {example}")
        parser.add_argument("--quick", action="store_true", help="a small smoke run")
        arguments_of_pieces(parser)
        return parser

    def run(self, o: argparse.Namespace, arguments: dict[str, Any], units: Callable[[], Sequence[Unit]]) -> None:
        """Measures, or with --merge puts pieces together. arguments: what the page says that it was made with."""
        if o.merge:
            merged = Merged(self.name, self.title, o.merge, o.out)
            self.write(merged, {name: merged.rows(name, keys) for name, keys in self.keys.items()})
            return
        told = {"device": o.device} | arguments | ({"quick": True} if o.quick else {})
        wanted = chosen(units(), o)
        report = Piece(self.name, self.title, told | asked_for(o), o.out, o.quick)
        self.write(report, measure(wanted, Limit(o.limit), report))
